"""The report: what it says, that it is whole and harmless, and what a browser makes of it."""

from __future__ import annotations

import base64
import json
import re
import shutil
import signal
import subprocess
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from os import environ, killpg
from pathlib import Path

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import example
from markupsafe import escape
from small import simulated, steady

import steady_ppl as st
from steady_ppl.effects import attached
from steady_ppl.reporting.drives import chosen
from steady_ppl.reporting.maps import where_to_look
from steady_ppl.reporting.packing import packed
from steady_ppl.reporting.program_page import _equation
from steady_ppl.reporting.writing import said, spread

EVIL = "</script><script>window.broken = 1</script>"
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")
in_a_browser = pytest.mark.skipif(BROWSER is None, reason="there is no chromium: apt-get install chromium")
MOST = 6_000_000  # bytes
FOUND = {
    "sentence": "The dynamics lack yaw_linear_drag = 0.05 1/s.",
    "doubts": [],
    "effects": [
        {
            "effect": "yaw_linear_drag",
            "kind": "dynamics",
            "class": ["yaw_linear_drag", EVIL],
            "confidence": 0.97,
            "coefficient": [0.05],
            "interval_90": [[0.04, 0.06]],
            "unit": "1/s",
            "text": "a_yaw = -c w",
            "heldout_gain": 12.0,
        }
    ],
    "candidates": [
        {
            "effect": "yaw_linear_drag",
            "kind": "dynamics",
            "p_value": 1e-9,
            "coefficient": 0.05,
            "sd": 0.005,
            "absent": 0.0,
            "unit": "1/s",
            "detection_limit": 0.02,
            "heldout_gain": 12.0,
            "heldout_gain_ci": [8.0, 16.0],
            "note": None,
        }
    ],
    "shape": None,
    "next_run": None,
    "notes": ["a note"],
}


class Elements(HTMLParser):
    """Tags and attributes of a page, and its identifiers."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def of(self, name: str) -> list[str]:
        return [attributes[name] for _, attributes in self.tags if attributes.get(name)]


def fit(name: str) -> st.Fit:
    return st.Fit(example(name, torch.float32).requires_grad_(False), "hand", known_start=True)


@pytest.fixture(scope="module")
def runs() -> dict[str, st.Fit]:
    return {"before": fit("hovercraft"), "after": fit("hovercraft.py:HovercraftTruth")}


@pytest.fixture(scope="module")
def data() -> st.Trajectories:
    table = simulated(trajectories=6, rows=101)
    return replace(table, labels=("1", "2", EVIL, "4", "5", "6"))


@pytest.fixture(scope="module")
def found(runs, data) -> st.Report:
    return st.report(runs, data, discovery=FOUND, simulations=20, draws=5, how=["steady report before after"])


@pytest.fixture(scope="module")
def page(found, tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("report") / "report.html"
    found.write(file)
    return file


def content(page: Path) -> dict:
    return content_of(page.read_text())


def content_of(html: str) -> dict:
    (text,) = re.findall(r'<script id="data" type="application/json">(.*?)</script>', html, re.DOTALL)
    return json.loads(text, parse_constant=lambda name: pytest.fail(name))


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
    assert chosen(checks).note is None
    few = chosen(checks, numbers=3 * 101 * 80)
    assert 1 <= len(few.drives) < 6 and few.every == 1 and "strongest misfits" in few.note
    assert f"{len(few.drives)} of 6 drives" in few.note
    tiny = chosen(checks, numbers=500)
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
        shown = chosen(checks, numbers)
        rows = -(-101 // shown.every)
        assert 0.5 * numbers < len(shown.drives) * rows * 100 < 1.5 * numbers
        assert shown.note and "of 6 drives" in shown.note
    assert chosen(checks).note is None


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


class Motor(st.Program):
    """One state, one channel."""

    states = ("speed [rad/s]",)
    controls = ("voltage [V]",)
    measurements = ("speed [rad/s]",)
    channels = ("torque [rad/s²]",)
    motion = {"torque": ("", "speed")}

    def initial(self):
        return pyro.sample("start", dist.Normal(torch.zeros(1), torch.ones(1)).to_event(1))

    def transition(self, state, control, time, step):
        return state + step[..., None] * pyro.sample("torque", dist.Normal(control - state, 0.2).to_event(1))

    def observe(self, state):
        pyro.sample("speed", dist.Normal(state, 0.1).to_event(1))


# --- in a browser -----------------------------------------------------------------------------------------------------
def opened(page: Path, *options: str, anchor: str = "") -> tuple[str, str]:
    """What a headless browser prints on stdout and stderr; its whole process group is ended with it."""
    assert BROWSER is not None
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--enable-logging=stderr"]
    command += ["--virtual-time-budget=8000", f"--user-data-dir={page.parent / 'profile'}", *options]
    process = subprocess.Popen(
        [*command, f"file://{page}{anchor}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        return process.communicate(timeout=120)
    finally:
        if process.poll() is None:
            killpg(process.pid, signal.SIGKILL)
            process.wait()


def with_script(page: Path, script: str, name: str) -> Path:
    """The page with another script at its end."""
    file = page.with_name(name)
    file.write_text(page.read_text().replace("</body>", f"<script>{script}</script></body>"))
    return file


@in_a_browser
def test_a_browser_draws_it_without_an_error(page):
    wide = ("--window-size=1280,9000", "--dump-dom")
    dom, log = opened(page, *wide)
    assert "CONSOLE" not in log, log
    assert dom.count('class="main-svg"') >= 8
    assert not re.search(r"window\.broken = 1</script>", dom.split('id="data"')[0])
    assert '<option value="2">' in dom and dom.count("<option") > 8


@in_a_browser
def test_a_link_shows_its_drive_and_seconds(page):
    dom, log = opened(page, "--dump-dom", "--window-size=1280,2000", anchor="#run=0&drive=3&from=1&to=2.5")
    assert "CONSOLE" not in log, log
    assert 'role="status">before, drive 4, 1.0 to 2.5 s<' in dom
    dom, _ = opened(page, "--dump-dom", anchor="#run=99&drive=-7&from=x&to=y")
    assert 'role="status">after, drive 1, all seconds<' in dom


@in_a_browser
def test_clicking_a_place_shows_its_seconds(page):
    click = """
    const place = (id) => document.getElementById(id), said = [];
    const click = (id, point) => { place(id).emit("plotly_click", { points: [point] }); said.push(location.hash); };
    setTimeout(() => window.dispatchEvent(new Event("beforeprint")), 1000);  // draws everything
    setTimeout(() => {
      click("strips", { pointIndex: [1, 0], y: "2" });
      click("map", { customdata: [4, 2.0] });
      click("regimes", { pointIndex: [0, 0] });
      document.title = said.join(" | ");
    }, 4000);
    """
    dom, log = opened(with_script(page, click, "click.html"), "--dump-dom", "--window-size=1280,9000")
    assert "CONSOLE" not in log, log
    title = re.findall("<title>(.*?)</title>", dom)[0]
    first, second, third = title.replace("&amp;", "&").split(" | ")
    assert first.startswith("#run=1&drive=1&from=0.00")
    assert second == "#run=1&drive=4&from=1.00&to=3.00"
    assert third.startswith("#run=1&drive=") and third != second


def lines_of(page: Path, script: str, name: str, *options: str, anchor: str = "") -> list[str]:
    """What a script in the page puts into its title, and no word on the console."""
    dom, log = opened(with_script(page, script, name), "--dump-dom", *options, anchor=anchor)
    assert "CONSOLE" not in log, log
    return unescape(re.findall("<title>(.*?)</title>", dom)[0]).split(" | ")


@in_a_browser
def test_in_a_notebooks_frame_it_answers_as_well(page):
    script = """
    setTimeout(() => {
      const select = document.getElementById("drive");
      select.value = "1";
      select.dispatchEvent(new Event("change"));
      setTimeout(() => { parent.document.title = document.getElementById("place").textContent; }, 500);
    }, 1000);
    """
    inside = with_script(page, script, "inside.html").read_text()
    notebook = page.with_name("notebook.html")
    notebook.write_text(f'<title>nothing</title><iframe srcdoc="{escape(inside)}"></iframe>')
    dom, log = opened(notebook, "--dump-dom")
    assert "CONSOLE" not in log, log
    assert "<title>after, drive 2, all seconds</title>" in dom


@in_a_browser
def test_every_place_of_the_maps_is_a_link_as_well(page):
    script = """
    for (const id of ["strips-list", "regimes-list"]) document.getElementById(id).open = true;
    setTimeout(() => {
      const links = (id) => [...document.querySelectorAll(`#${id} a`)];
      const said = ["strips-list", "regimes-list"].map((id) => links(id).length);
      links("strips-list")[1].click();
      setTimeout(() => { document.title = [...said, location.hash, document.activeElement.id].join(" | "); }, 500);
    }, 1000);
    """
    strips, regimes, place, focused = lines_of(page, script, "lists.html")
    shown = content(page)["runs"][1]
    assert int(strips) == 6 * (len(shown["strips"]["edges"]) - 1)
    assert int(regimes) == len(shown["regimes"]["cells"])
    assert place.startswith("#run=1&drive=0&from=") and focused == "h-drives"


@in_a_browser
def test_a_link_that_was_followed_can_be_followed_again(page):
    script = """
    const link = document.createElement("a");
    link.href = "#run=0&drive=3&from=1.00&to=2.00";
    document.body.append(link);
    const place = () => document.getElementById("place").textContent, said = [];
    const box = document.getElementById("drive");
    const steps = [() => link.click(), () => { box.value = 1; box.onchange(); }, () => link.click()];
    steps.forEach((step, i) => setTimeout(() => { step(); setTimeout(() => said.push(place()), 200); }, 500 * i + 500));
    setTimeout(() => { document.title = said.join(" | "); }, 3000);
    """
    first, chosen_by_hand, again = lines_of(page, script, "again.html")
    assert first == again == "before, drive 4, 1.0 to 2.0 s" and chosen_by_hand == "before, drive 2, all seconds"


@in_a_browser
def test_addresses_that_are_nonsense_show_what_is_nearest(page):
    for anchor, shown in (
        ("#run=99&drive=99&from=500&to=600", "after, drive 6, all seconds"),
        ("#run=0&drive=0&from=5&to=1e9", "before, drive 1, 5.0 to 10.0 s"),
        ("#run=0&drive=0&from=-50&to=-40", "before, drive 1, all seconds"),
    ):
        dom, log = opened(page, "--dump-dom", anchor=anchor)
        assert "CONSOLE" not in log and f'role="status">{shown}<' in dom, anchor


@in_a_browser
def test_the_keyboard_meets_no_tools_and_every_picture_has_a_name(page):
    script = """
    setTimeout(() => window.dispatchEvent(new Event("beforeprint")), 500);
    setTimeout(() => {
      const pictures = [...document.querySelectorAll('[role="img"]')];
      const tools = document.querySelectorAll(".modebar-btn").length;
      const unnamed = pictures.filter((one) => !one.getAttribute("aria-label")).length;
      document.title = [tools, pictures.length, unnamed].join(" | ");
    }, 4000);
    """
    tools, pictures, unnamed = lines_of(page, script, "names.html", "--window-size=1280,9000")
    assert (tools, unnamed) == ("0", "0") and int(pictures) == 9


@in_a_browser
def test_paper_is_as_wide_as_what_is_drawn_on_it(page, tmp_path):
    script = """
    window.dispatchEvent(new Event("beforeprint"));
    const said = [];
    setTimeout(() => {
      said.push([...document.querySelectorAll(".js-plotly-plot")].filter((one) => one.layout.width !== 680).length);
      said.push(document.querySelectorAll("#program details:not([open])").length);
      window.dispatchEvent(new Event("afterprint"));
    }, 3000);
    setTimeout(() => {
      said.push([...document.querySelectorAll(".js-plotly-plot")].filter((one) => one.layout.width === 680).length);
      said.push(document.querySelectorAll("#program details[open]").length);
      document.title = said.join(" | ");
    }, 5000);
    """
    assert lines_of(page, script, "paper.html", "--window-size=1280,3000") == ["0", "0", "0", "0"]
    opened(page, f"--print-to-pdf={tmp_path / 'report.pdf'}")
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")


@in_a_browser
def test_a_phone_need_not_scroll_sideways(page):
    script = "setTimeout(() => { document.title = document.documentElement.scrollWidth; }, 3000);"
    frame = page.with_name("frame.html")
    file = with_script(page, script.replace("document.title", "parent.document.title"), "inner.html")
    frame.write_text(f'<title></title><iframe src="{file.name}" style="width:390px;height:800px;border:0"></iframe>')
    dom, _ = opened(frame, "--dump-dom", "--allow-file-access-from-files", "--window-size=1280,900")
    assert int(re.findall("<title>(.*?)</title>", dom)[0]) == 390


@in_a_browser
def test_a_system_of_one_state_is_drawn(tmp_path):
    program = Motor()
    program.duration = 6.0
    with st.seeded(0):
        table = st.simulate(program, 6, seed=0)
    file = tmp_path / "motor.html"
    st.report({"motor": st.Fit(program, "hand")}, table, simulations=20, draws=5).write(file)
    dom, log = opened(file, "--dump-dom", "--window-size=1280,9000")
    assert "CONSOLE" not in log and "could not be drawn" not in dom.split("<script")[0], log
    assert "One state alone has no plane" in dom.split("<script")[0]


@in_a_browser
def test_a_screenshot_is_kept(page):
    kept = Path(environ.get("OUT", Path(__file__).parents[1] / "out")) / "report.png"
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.unlink(missing_ok=True)
    opened(page, "--window-size=1280,6000", f"--screenshot={kept}")
    assert kept.read_bytes().startswith(b"\x89PNG") and kept.stat().st_size > 100_000
