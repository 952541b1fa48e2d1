"""The report in a headless browser: it draws, its links work, by keyboard, on paper and on a phone."""

from __future__ import annotations

import re
from os import environ
from pathlib import Path

import pytest
from markupsafe import escape
from report_pages import Motor, content, in_a_browser, lines_of, opened, two_run_report, with_script

import steady_ppl as st

pytestmark = in_a_browser


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("report") / "report.html"
    two_run_report().write(file)
    return file


@pytest.mark.slow
def test_a_browser_draws_it_without_an_error(page):
    wide = ("--window-size=1280,9000", "--dump-dom")
    dom, log = opened(page, *wide)
    assert "CONSOLE" not in log, log
    assert dom.count('class="main-svg"') >= 8
    assert not re.search(r"window\.broken = 1</script>", dom.split('id="data"')[0])
    assert '<option value="2">' in dom and dom.count("<option") > 8


@pytest.mark.slow
def test_a_link_shows_its_drive_and_seconds(page):
    dom, log = opened(page, "--dump-dom", "--window-size=1280,2000", anchor="#run=0&drive=3&from=1&to=2.5")
    assert "CONSOLE" not in log, log
    assert 'role="status">before, trajectory 4, 1.0 to 2.5 s<' in dom
    dom, _ = opened(page, "--dump-dom", anchor="#run=99&drive=-7&from=x&to=y")
    assert 'role="status">after, trajectory 1, all seconds<' in dom


@pytest.mark.slow
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


@pytest.mark.slow
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
    assert "<title>after, trajectory 2, all seconds</title>" in dom


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_link_that_was_followed_can_be_followed_again(page):
    script = """
    const link = document.createElement("a");
    link.href = "#run=0&drive=3&from=1.00&to=2.00";
    document.body.append(link);
    const place = () => document.getElementById("place").textContent, said = [];
    const box = document.getElementById("drive");
    const steps = [() => link.click(), () => { box.value = 1; box.onchange(); }, () => link.click()];
    const take = () => {
      if (said.length === steps.length) { document.title = said.join(" | "); return; }
      const before = place();
      steps[said.length]();
      const wait = setInterval(() => {
        if (place() !== before) { clearInterval(wait); said.push(place()); take(); }
      }, 50);
    };
    setTimeout(take, 500);
    """
    first, chosen_by_hand, again = lines_of(page, script, "again.html")
    assert first == again == "before, trajectory 4, 1.0 to 2.0 s"
    assert chosen_by_hand == "before, trajectory 2, all seconds"


@pytest.mark.slow
def test_addresses_that_are_nonsense_show_what_is_nearest(page):
    for anchor, shown in (
        ("#run=99&drive=99&from=500&to=600", "after, trajectory 6, all seconds"),
        ("#run=0&drive=0&from=5&to=1e9", "before, trajectory 1, 5.0 to 10.0 s"),
        ("#run=0&drive=0&from=-50&to=-40", "before, trajectory 1, all seconds"),
    ):
        dom, log = opened(page, "--dump-dom", anchor=anchor)
        assert "CONSOLE" not in log and f'role="status">{shown}<' in dom, anchor


@pytest.mark.slow
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


@pytest.mark.exhaustive
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


@pytest.mark.slow
def test_a_phone_need_not_scroll_sideways(page):
    script = "setTimeout(() => { document.title = document.documentElement.scrollWidth; }, 3000);"
    frame = page.with_name("frame.html")
    file = with_script(page, script.replace("document.title", "parent.document.title"), "inner.html")
    frame.write_text(f'<title></title><iframe src="{file.name}" style="width:390px;height:800px;border:0"></iframe>')
    dom, _ = opened(frame, "--dump-dom", "--allow-file-access-from-files", "--window-size=1280,900")
    assert int(re.findall("<title>(.*?)</title>", dom)[0]) == 390


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_screenshot_is_kept(page):
    kept = Path(environ.get("OUT", Path(__file__).parents[2] / "out")) / "report.png"
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.unlink(missing_ok=True)
    opened(page, "--window-size=1280,6000", f"--screenshot={kept}")
    assert kept.read_bytes().startswith(b"\x89PNG") and kept.stat().st_size > 100_000
