"""The report: what it says, and that it is whole and harmless."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from examples import example
from report_pages import EVIL, FOUND, Elements, content, content_of, six_drives, two_run_report, two_runs, unpacked
from small import steady

import steady_ppl as st
from steady_ppl.reporting.report import said

MOST = 6_000_000  # bytes


@pytest.fixture(scope="module", name="runs")
def _runs() -> dict[str, st.Fit]:
    return two_runs()


@pytest.fixture(scope="module", name="data")
def _data() -> st.Trajectories:
    return six_drives()


@pytest.fixture(scope="module")
def found() -> st.Report:
    return two_run_report()


@pytest.fixture(scope="module")
def page(found, tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("report") / "report.html"
    found.write(file)
    return file


@pytest.mark.slow
def test_it_has_every_verdict_and_loads_nothing(found, page):
    text = page.read_text()
    for verdict in [found.proof.figures["verdict"], *(one.figures["verdict"] for one in found.checks.values())]:
        assert str(said(verdict)) in text
    assert FOUND["sentence"] in text and "a note" in text and "steady report before after" in text
    elements = Elements(text)
    assert not elements.of("src") and all(link.startswith("#") for link in elements.of("href"))
    assert "default-src &#39;none&#39;" in text or "default-src 'none'" in text
    assert page.stat().st_size <= MOST


def test_names_of_a_table_or_a_program_are_no_page(page):
    text = page.read_text()
    assert EVIL not in text and "&lt;/script&gt;&lt;script&gt;" in text
    assert content(page)["labels"][2] == EVIL


def test_every_label_of_a_section_a_select_and_a_table_is_there(page):
    elements = Elements(page.read_text())
    sections = [attributes for tag, attributes in elements.tags if tag == "section"]
    assert len(sections) == 8 and {s["aria-labelledby"] for s in sections} <= set(elements.of("id"))
    assert {"#verdict", "#drives", "#where", "#missing", "#gain", "#program", "#again"} <= set(elements.of("href"))
    assert all("scope" in attributes for tag, attributes in elements.tags if tag == "th")
    assert ("html", {"lang": "en"}) in elements.tags


@pytest.mark.slow
def test_what_is_drawn_is_what_was_computed(found, page, runs, data):
    drawn = content(page)
    check = found.checks["before"]
    measured = unpacked(drawn["runs"][0]["measured"]).transpose(2, 0, 1)
    np.testing.assert_allclose(measured, data.measurements.numpy(), atol=1e-3)
    middle = unpacked(drawn["runs"][0]["predictions"][0]["middle"]).transpose(2, 0, 1)
    error = check.predictions[1].error.numpy()
    there = ~np.isnan(middle[1:])
    np.testing.assert_allclose((measured[1:] - middle[1:])[there], error[there], atol=2e-3)
    assert there.mean() > 0.9
    posterior = runs["after"].posterior(data, draws=5)["posterior"]
    for index, name in enumerate(data.state_names):
        for key, level in {"low": 0.05, "middle": 0.5, "high": 0.95}.items():
            shown = unpacked(drawn["runs"][1]["posterior"][key])[:, index]
            np.testing.assert_allclose(shown, posterior[name].quantile(level, ("chain", "draw")).values, atol=1e-3)
    np.testing.assert_allclose(unpacked(drawn["runs"][0]["truth"]).transpose(2, 0, 1), data.states.numpy(), atol=1e-3)
    z = found.checks["before"].misfit
    strongest = max(abs(z.z[i]) for i, cell in enumerate(z.cells) if cell.map == "drive and time")
    shown = unpacked(drawn["runs"][0]["strips"]["z"])
    assert np.nanmax(abs(shown)) == pytest.approx(strongest, abs=0.001)


@pytest.mark.slow
def test_one_run_alone_is_a_report_without_a_proof(runs, data, tmp_path):
    found = st.report({"only": runs["before"]}, data, simulations=20, draws=5)
    assert isinstance(found.proof, str) and "one run only" in found.html
    assert "Nobody has looked yet" in found.html
    with pytest.raises(st.UsageError, match="cannot be written"):
        found.write(tmp_path / "none" / "report.html")
    with pytest.raises(st.UsageError, match="at least one run"):
        st.report({}, data)


def test_it_begins_with_what_is_suspicious_in_the_table(found, runs, data):
    assert "nothing is suspicious in them" in found.html
    controls = data.controls.clone()
    controls[..., 0] = 0.5
    still = st.report({"only": runs["before"]}, replace(data, controls=controls), simulations=20, draws=5)
    (one,) = still.table.findings
    assert one.kind == "constant" and one.mend in still.html
    assert (
        still.html.index('<section id="table"') < still.html.index(one.mend) < still.html.index('<section id="verdict"')
    )


def test_a_system_that_is_no_vehicle_has_a_report(tmp_path):
    program = example("pendulum", torch.float32).requires_grad_(False)
    program.duration = 40 * program.step
    table = st.simulate(program, 5, seed=0)
    found = st.report({"pendulum": st.Fit(program, "hand")}, table, simulations=20, draws=5)
    assert found.drives["runs"][0]["plane"] == [0, 1] and len(found.html) < MOST


class Turned(type(example("hovercraft"))):
    """The same vehicle, its states and landmarks in another order."""

    landmarks = type(example("hovercraft")).landmarks[::-1]
    measurements = tuple(f"bearing_{i} [rad]" for i in reversed(range(4)))


@pytest.mark.slow
def test_every_run_is_drawn_against_its_own_components(runs, data):
    """Not against the first run's, which may measure the same in another order; and without a known start a heading is
    on the truth's turn."""
    other = st.Fit(Turned().float().requires_grad_(False), "hand", known_start=False)
    found = st.report({"before": runs["before"], "turned": other}, data, simulations=20, draws=5)
    drawn = content_of(found.html)
    first, second = drawn["runs"]
    assert [one["name"] for one in second["measurements"]] == [f"bearing_{i}" for i in reversed(range(4))]
    np.testing.assert_allclose(unpacked(second["measured"])[:, ::-1], unpacked(first["measured"]), atol=1e-3)
    error = unpacked(second["measured"]) - unpacked(second["predictions"][0]["middle"])
    assert np.nanstd(error) < 0.3
    heading = unpacked(second["truth"])[:, 2] - unpacked(second["posterior"]["middle"])[:, 2]
    assert np.nanmax(abs(heading)) < np.pi
    assert "cannot be compared" in found.html


def test_the_last_command_of_a_drive_acts_on_nothing(page):
    controls = unpacked(content(page)["controls"])
    assert np.isnan(controls[:, :, -1]).all() and not np.isnan(controls[:, :, :-1]).any()


def test_the_command_writes_it(work: Path, tmp_path: Path, capsys, refused):
    table = work / "valid.parquet"
    page = tmp_path / "report.html"
    some = ("--simulations", 20)
    refused(2, "ends in .html", "report", work / "hand", table, "--out", tmp_path / "report.pdf")
    refused(2, "no folder", "report", work / "hand", table, "--out", tmp_path / "none" / "report.html")
    refused(2, "at least one RUN", "report", table, "--out", page)
    refused(2, "neither a RUN", "report", work / "hand", table, *some, "--out", page, "--discovery", work / "steady")
    broken = work / "broken.json"
    broken.write_text("{}")
    refused(
        2, "not what `steady discover` writes", "report", work / "hand", table, "--discovery", broken, "--out", page
    )
    discovery = tmp_path / "found.json"
    discovery.write_text(json.dumps(FOUND))
    assert steady("report", work / "hand", table, *some, "--discovery", discovery, "--out", page) == 0
    assert "report.html" in capsys.readouterr().out and FOUND["sentence"] in page.read_text()
    assert not list(tmp_path.glob("*.partial"))


@pytest.mark.slow
def test_the_command_that_is_shown_is_the_one_that_was_given(work: Path, tmp_path: Path):
    page, table = tmp_path / "report.html", work / "valid.parquet"
    asked = ("--simulations", 20, "--title", "my page", "--seed", 3)
    assert steady("report", work / "hand", table, *asked, "--out", page) == 0
    text = page.read_text()
    given = f"steady report {work / 'hand'} {table} --title &#39;my page&#39; --simulations 20 --seed 3 --out {page}"
    assert given in text
    assert "Hovercraft, recipe hand, seed 0, without a known start\nsteady fit " in text  # and by what it was fitted
    assert f"# {table}: sha256 of its trajectories " in text


@pytest.mark.slow
def test_what_was_discovered_is_among_what_is_to_be_repeated(work: Path, tmp_path: Path):
    shutil.copytree(work / "hand", tmp_path / "found")
    (tmp_path / "found" / "discovery.json").write_text(json.dumps(FOUND))
    record = json.loads((tmp_path / "found" / "run.json").read_text())
    record["command"] = "steady discover runs/hand train.csv --out found"
    (tmp_path / "found" / "run.json").write_text(json.dumps(record))
    page, table = tmp_path / "report.html", work / "valid.parquet"
    asked = ("--simulations", 20, "--discovery", tmp_path / "found", "--out", page)
    assert steady("report", work / "hand", table, *asked) == 0
    text = page.read_text()
    assert text.index("steady fit ") < text.index(record["command"]) < text.index(f"steady report {work / 'hand'}")
