"""The report: what it says, and that it is whole and harmless."""

from __future__ import annotations

import base64
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from examples import example
from markupsafe import escape
from report_pages import EVIL, FOUND, Elements, content, content_of, six_drives, two_run_report, two_runs
from small import simulated, steady

import steady_ppl as st
from steady_ppl.effects import attached
from steady_ppl.reporting.drives import chosen_drives, packed, where_to_look
from steady_ppl.reporting.html import _equation, said, spread

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


def unpacked(part: dict) -> np.ndarray:
    codes = np.frombuffer(base64.b64decode(part["data"]), "<i2").reshape(part["shape"]).astype(float)
    return np.where(codes == -32768, np.nan, part["low"] + part["step"] * (codes + 32767))


def test_numbers_come_back_as_finely_as_sixteen_bits_are():
    values = np.random.default_rng(0).normal(size=(3, 4, 5)) * 100
    values[1, 2, 3] = np.nan
    back = unpacked(packed(values))
    np.testing.assert_array_equal(np.isnan(back), np.isnan(values))
    np.testing.assert_allclose(back, values, atol=np.nanmax(values) - np.nanmin(values), rtol=0)
    assert np.nanmax(abs(back - values)) <= 0.5001 * (np.nanmax(values) - np.nanmin(values)) / 65534
    assert unpacked(packed(np.full((2, 2), np.nan))).shape == (2, 2)
    np.testing.assert_array_equal(unpacked(packed(np.full(3, 7.0))), 7.0)


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
    assert len(sections) == 7 and {s["aria-labelledby"] for s in sections} <= set(elements.of("id"))
    assert {"#verdict", "#drives", "#where", "#missing", "#gain", "#program", "#again"} <= set(elements.of("href"))
    assert all("scope" in attributes for tag, attributes in elements.tags if tag == "th")
    assert ("html", {"lang": "en"}) in elements.tags


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


def test_a_place_to_look_at_is_where_the_misfit_is(runs):
    table = simulated("hovercraft.py:HovercraftTruth", trajectories=6, rows=41)
    measurements = table.measurements.clone()
    measurements[15:25, 4, 1] += 0.4
    check = st.check(runs["after"], replace(table, measurements=measurements), simulations=20)
    (cell,) = (
        one
        for i, one in enumerate(check.misfit.cells)
        if one.map == "drive" and one.residual == 1 and one.where["drive"] == 4
    )
    assert where_to_look(check, cell) == (4, 0.0, 4.5)
    (cell,) = (one for one in check.misfit.cells if one.map == "all" and one.residual == 1)
    place = where_to_look(check, cell)
    assert place is not None and place[0] == 4
    regimes = [one for one in check.misfit.cells if one.map == "regime" and one.residual == 1 and "left" in one.where]
    for cell in regimes:
        drive, start, end = where_to_look(check, cell)
        middle = round(0.5 * (start + end) / 0.1)
        low, high = cell.where["left"]
        near = table.controls[max(0, middle - 6) : middle + 6, drive, 0]
        assert bool(((near >= low - 1e-6) & (near <= high + 1e-6)).any())


def test_there_is_room_for_the_strongest_drives(found):
    checks = list(found.checks.values())
    assert chosen_drives(checks).note is None
    few = chosen_drives(checks, numbers=3 * 101 * 80)
    assert 1 <= len(few.drives) < 6 and few.every == 1 and "strongest misfits" in few.note
    assert f"{len(few.drives)} of 6 drives" in few.note
    tiny = chosen_drives(checks, numbers=500)
    assert len(tiny.drives) == 1 and tiny.every > 1 and "th row" in tiny.note


def test_one_run_alone_is_a_report_without_a_proof(runs, data, tmp_path):
    found = st.report({"only": runs["before"]}, data, simulations=20, draws=5)
    assert isinstance(found.proof, str) and "one run only" in found.html
    assert "Nobody has looked yet" in found.html
    with pytest.raises(st.UsageError, match="cannot be written"):
        found.write(tmp_path / "none" / "report.html")
    with pytest.raises(st.UsageError, match="at least one run"):
        st.report({}, data)


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


def test_what_is_shown_row_by_row_has_an_upper_bound(runs):
    """A page of three hundred drives is hardly larger than one of thirty."""
    checks = [st.check(one, simulated(trajectories=6, rows=101), simulations=20) for one in runs.values()]
    for numbers in (3_000, 30_000):
        shown = chosen_drives(checks, numbers)
        rows = -(-101 // shown.every)
        assert 0.5 * numbers < len(shown.drives) * rows * 100 < 1.5 * numbers
        assert shown.note and "of 6 drives" in shown.note
    assert chosen_drives(checks).note is None


def test_an_equation_that_is_no_latex_is_said_in_words(runs, data):
    program = example("hovercraft", torch.float32).with_effect("linear_drag", 0.1)
    (variant,) = attached(program)
    broken = replace(variant.effect, equation=r"\frac{")
    assert _equation(broken) == escape(broken.text)
    assert "<math" in _equation(variant.effect)


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


def test_sentences_of_a_verdict_are_set_as_text():
    assert said("`steady discover` <b> between -0.5 and -3 of 90 %") == (
        "<code>steady discover</code> &lt;b&gt; between −0.5 and −3 of 90\u00a0%"
    )


def test_coefficients_stand_beside_their_own_spread():
    assert spread({"coefficient": [1.0, -2.0], "sd": [0.1, 0.2]}) == "1 ± 0.1, −2 ± 0.2"
    assert spread({"coefficient": 1.5, "sd": None}) == "1.5"
    assert spread({"coefficient": [1.0, 2.0], "sd": None}) == "1, 2"


def test_the_command_that_is_shown_is_the_one_that_was_given(work: Path, tmp_path: Path):
    page, table = tmp_path / "report.html", work / "valid.parquet"
    asked = ("--simulations", 20, "--title", "my page", "--seed", 3)
    assert steady("report", work / "hand", table, *asked, "--out", page) == 0
    text = page.read_text()
    given = f"steady report {work / 'hand'} {table} --title &#39;my page&#39; --simulations 20 --seed 3 --out {page}"
    assert given in text
    assert "Hovercraft, recipe hand, seed 0, without a known start\nsteady fit " in text  # and by what it was fitted
    assert f"# {table}: sha256 of its drives " in text


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
