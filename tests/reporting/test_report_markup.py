"""Every name that reaches the report's page, made by somebody who means harm: text it stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pyro
import pyro.distributions as dist
import pytest
import torch
from report_pages import FOUND, Elements, content, in_a_browser, opened, with_script

import steady_ppl as st
from steady_ppl.errors import ComputationError
from steady_ppl.reporting.report import _data

IMAGE = "<img src=x onerror=window.broken=1>"
LINK = '<a href="javascript:window.broken=1">x</a>'  # plotly makes links of these
ENDS = "</script><!--<script>window.broken=1</script>\"'><svg onload=window.broken=1>`{{ 7*7 }}%{y}"
HOSTILE = IMAGE + LINK + ENDS
TAGS = {"img", "svg", "iframe", "object", "embed", "base", "link"}


class Hostile(st.Program):
    __doc__ = HOSTILE
    states = (f"place{HOSTILE} [m{HOSTILE}]", f"speed{HOSTILE} [m/s{HOSTILE}]")
    controls = (f"push{HOSTILE} [N{HOSTILE}]",)
    measurements = (f"place{HOSTILE} [m{HOSTILE}]",)
    channels = (f"push{HOSTILE} [m/s²{HOSTILE}]",)
    motion = {f"push{HOSTILE}": (states[0].partition(" [")[0], states[1].partition(" [")[0])}

    def initial(self):
        return pyro.sample("start", dist.Normal(torch.zeros(2), torch.ones(2)).to_event(1))

    def transition(self, state, control, time, step):
        place, speed = state.unbind(-1)
        push = pyro.sample("push", dist.Normal(control - speed[..., None], 0.2).to_event(1))[..., 0]
        return torch.stack((place + step * speed, speed + step * push), -1)

    def observe(self, state):
        pyro.sample("place", dist.Normal(state[..., :1], 0.1).to_event(1))


def hostile(value):
    """The same discovery, every text of it hostile; its keys and the kinds of its numbers stay."""
    if isinstance(value, dict):
        return {key: hostile(part) for key, part in value.items()}
    if isinstance(value, list):
        return [hostile(part) for part in value]
    return value + HOSTILE if isinstance(value, str) else value


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    program = Hostile()
    program.duration = 6.0
    with st.seeded(0):
        table = st.simulate(program, 6, seed=0)
    table = replace(table, labels=tuple(f"{i}{HOSTILE}" for i in range(6)))
    fit = st.Fit(program, f"hand{HOSTILE}", {f"setting{HOSTILE}": HOSTILE}, notes=[HOSTILE])
    found = hostile(FOUND) | {"source": HOSTILE, "doubts": [HOSTILE]}
    found["next_run"] = {"between": [HOSTILE, HOSTILE], "way": HOSTILE, "separation": 1.0, "usual": 0.5}
    shape = dict.fromkeys(("channel", "variable", "variable_unit", "unit"), HOSTILE)
    found["shape"] = shape | {"points": [0.0, 1.0], "curve": [0.0, 1.0], "band": [0.1, 0.1]}
    found["candidates"][0]["note"] = HOSTILE
    runs = {f"before{HOSTILE}": fit, f"after{HOSTILE}": replace(fit)}
    options = {"title": HOSTILE, "how": [HOSTILE], "notes": [HOSTILE], "simulations": 20, "draws": 5}
    file = tmp_path_factory.mktemp("hostile") / "report.html"
    st.report(runs, table, discovery=found, **options).write(file)
    return file


@pytest.mark.slow
def test_hostile_names_are_text_of_the_page(page: Path) -> None:
    text = page.read_text()
    assert IMAGE not in text and LINK not in text and "<!--<script" not in text and "<svg onload" not in text
    assert ">49" not in text and text.count("&lt;img src=x") > 60
    elements = Elements(text)
    assert not TAGS & {tag for tag, _ in elements.tags}
    assert [tag for tag, _ in elements.tags].count("script") == 3
    assert {name for _, attributes in elements.tags for name in attributes if name.startswith("on")} == {"onsubmit"}
    assert all(link.startswith("#") for link in elements.of("href"))


def test_hostile_names_are_text_of_the_data(page: Path) -> None:
    read = content(page)
    assert read["labels"][1] == f"1{HOSTILE}" and read["runs"][1]["label"] == f"after{HOSTILE}"
    assert read["controlNames"] == [{"name": f"push{HOSTILE}", "unit": f"N{HOSTILE}"}]
    assert "<" not in page.read_text().partition('type="application/json">')[2].partition("</script>")[0]


@pytest.mark.slow
@in_a_browser
def test_hostile_names_are_text_in_a_browser(page: Path) -> None:
    """Everything is drawn, every list is opened, and every point is pointed at."""
    script = """
    setTimeout(() => window.dispatchEvent(new Event("beforeprint")), 500);
    setTimeout(() => {
      document.querySelectorAll("details").forEach((one) => { one.open = true; });
      document.querySelectorAll(".js-plotly-plot").forEach((one) => {
        const at = (trace) => (trace.type === "heatmap" ? [0, 0] : 2);
        one.data.forEach((trace, curveNumber) => { Plotly.Fx.hover(one, [{ curveNumber, pointNumber: at(trace) }]); });
      });
    }, 2500);
    setTimeout(() => {
      const address = (one) => one.getAttribute("href") || one.getAttribute("xlink:href") || "";
      const links = [...document.querySelectorAll("a")].map(address);
      document.title = [
        String(window.broken), document.querySelectorAll("img, [onerror], [onload]").length,
        links.filter((link) => !link.startsWith("#")).length, document.querySelectorAll(".main-svg").length > 8,
        [...document.querySelectorAll("svg text")].some((one) => one.textContent.includes("<img src=x")),
      ].join(" ");
    }, 5000);
    """
    dom, log = opened(with_script(page, script, "hostile.html"), "--dump-dom", "--window-size=1280,9000")
    assert "could not be drawn" not in dom.split("<script")[0], log
    assert dom.partition("<title>")[2].partition("</title>")[0] == "undefined 0 0 true true"


def test_a_figure_that_is_not_finite_is_one_line():
    with pytest.raises(ComputationError, match="the page is not written: a figure is not finite"):
        _data({"rmse": [1.0, float("inf")]})
