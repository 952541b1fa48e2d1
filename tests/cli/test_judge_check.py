"""`steady check`: what it prints, writes and refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small import only_start, rewritten, simulated, steady, written

from steady_ppl import read_table, write_table

FAST = ("--simulations", 20)


@pytest.mark.slow
def test_it_prints_the_verdict_first_and_writes_the_same_figures_and_a_picture(work: Path, tmp_path: Path, capsys):
    json_file, picture = tmp_path / "check.json", tmp_path / "check.png"
    options = (*FAST, "--json", json_file, "--picture", picture)
    assert steady("check", work / "hand", work / "valid.parquet", *options) == 0
    said = capsys.readouterr().out
    figures = json.loads(json_file.read_text(), parse_constant=lambda name: pytest.fail(name))
    assert said.splitlines()[0] == figures["verdict"] and figures["run"] == str(work / "hand")
    assert picture.read_bytes().startswith(b"\x89PNG") and picture.stat().st_size > 10_000
    assert sorted(path.name for path in tmp_path.iterdir()) == ["check.json", "check.png"]


@pytest.mark.slow
def test_one_drive_is_enough(work: Path, tmp_path: Path, capsys):
    table = written(tmp_path / "one.csv", simulated(trajectories=1, rows=33))
    assert steady("check", work / "hand", table, *FAST) == 0
    assert "this trajectory" in capsys.readouterr().out.splitlines()[0]


def test_what_it_cannot_read_is_one_line_and_writes_nothing(work: Path, tmp_path: Path, refused):
    table = written(tmp_path / "table.csv", only_start(simulated()))
    lacking = rewritten(written(tmp_path / "lacking.csv"), "y.bearing_2", "y.bearing_9")
    empty = tmp_path / "empty.csv"
    empty.write_text(table.read_text().splitlines()[0] + "\n")
    more = (*FAST, "--json", tmp_path / "out.json", "--picture", tmp_path / "out.png")
    refused(2, "there is no such file", "check", work / "hand", tmp_path / "none.csv", *more)
    refused(2, "the table has no rows", "check", work / "hand", empty, *more)
    refused(2, "no column y.bearing_2", "check", work / "hand", lacking, *more)
    refused(2, "is not a run", "check", tmp_path / "none", table, *more)
    refused(2, "a picture's name that ends in", "check", work / "hand", table, *FAST, "--picture", tmp_path / "a.doc")
    refused(2, "is the table itself", "check", work / "hand", table, *FAST, "--mask", table)
    refused(2, "there is no folder", "check", work / "hand", table, *FAST, "--mask", tmp_path / "none" / "kept.csv")
    refused(2, "greater than or equal to 20", "check", work / "hand", table, "--simulations", 5)


@pytest.mark.slow
def test_a_stretch_that_nobody_measured_is_named_and_masked(work: Path, tmp_path: Path, capsys):
    data = simulated(trajectories=3, rows=33)
    states = data.states.clone()
    share = torch.linspace(0, 1, 16, dtype=states.dtype)[:, None]
    states[10:26, 1, :2] = states[10, 1, :2] + share * (states[25, 1, :2] - states[10, 1, :2])
    table, kept, figures = (tmp_path / name for name in ("gap.csv", "kept.csv", "check.json"))
    write_table(replace(data, states=states), table)
    assert steady("check", work / "hand", table, *FAST, "--mask", kept, "--json", figures) == 0
    said = capsys.readouterr()
    assert "the table: trajectory 2 between 1.00 and 2.50 s: x.x, x.y on a straight line" in said.out
    assert f"{kept}: gap.csv without 1 unmeasured stretch and 0 wrong readings" in said.err
    (one,) = json.loads(figures.read_text())["stuck"]
    assert one["trajectory"] == "2" and one["seconds"] == pytest.approx([1.0, 2.5])
    again = read_table(kept)
    assert not again.observed[10:26, 1].any() and int((~again.observed).sum()) == 16 * 4


@pytest.mark.slow
def test_wrong_readings_are_named_marked_and_masked(work: Path, tmp_path: Path, capsys):
    data = simulated(trajectories=3, rows=33)
    readings = data.measurements.clone()
    readings[10:13, 1, 2] += 2.5
    table, kept, figures, picture = (tmp_path / name for name in ("jump.csv", "kept.csv", "check.json", "check.png"))
    write_table(replace(data, measurements=readings), table)
    files = ("--mask", kept, "--json", figures, "--picture", picture)
    assert steady("check", work / "hand", table, *FAST, *files) == 0
    said = capsys.readouterr()
    assert "3 readings left out as wrong" in said.out
    assert "trajectory 2 between 1.00 and 1.20 s: y.bearing_2" in said.out
    assert f"{kept}: jump.csv without 0 unmeasured stretches and 3 wrong readings" in said.err
    (one,) = json.loads(figures.read_text())["outliers"]
    assert (one["trajectory"], one["columns"]) == ("2", ["y.bearing_2"]) and picture.stat().st_size > 10_000
    again = read_table(kept)
    assert (~again.observed).nonzero().tolist() == [[row, 1, 2] for row in (10, 11, 12)]


def test_a_mask_that_cannot_be_written_is_refused_before_anything_is_computed(work: Path, tmp_path: Path, refused):
    table = written(tmp_path / "table.csv", simulated())
    refused(2, "there is no folder", "check", work / "hand", table, *FAST, "--mask", tmp_path / "no" / "kept.csv")
    refused(2, "a .csv or .parquet file", "check", work / "hand", table, *FAST, "--mask", tmp_path / "kept.txt")
