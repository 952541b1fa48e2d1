"""What Jupyter shows: sentences first, everything from outside escaped, and short in plain text."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from html import unescape

import pytest
from examples import example
from small import simulated

import steady_ppl as st
from steady_ppl.plotting.discovery import unknown_effect
from steady_ppl.training.loop import Trained

PNG = b"\x89PNG"


def picture(html: str) -> bytes:
    """The bytes of the one picture in it."""
    (found,) = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    return base64.b64decode(found)


def test_a_table_says_what_is_in_its_columns() -> None:
    data = simulated(trajectories=2, rows=4)
    data.observed[1:3, 0, 2] = False
    html = data._repr_html_()
    assert "2 trajectories of 4 rows, a row every 0.1 s" in html
    cells = re.findall(r"<tr><td>y.bearing_2</td><td>([^<]*)</td><td>([^<]*)</td><td>25.0%</td></tr>", html)
    kept = st.to_frame(data)["y.bearing_2"].dropna()
    assert cells == [(f"{kept.min():.4g}", f"{kept.max():.4g}")]


def test_names_from_a_table_are_escaped() -> None:
    data = replace(simulated(rows=4), measurement_names=("<b>", "b", "c", "d"))
    assert "<td>y.&lt;b&gt;</td>" in data._repr_html_()


def test_a_fit_shows_its_parameters_and_how_it_was_judged() -> None:
    history = [{"step": 5.0, "log_likelihood": 1.25}, {"step": 10.0, "log_likelihood": 2.5}]
    fit = st.Fit(example("hovercraft"), "steady", trained=Trained(history, kept=10), notes=["a <note>"])
    html = fit._repr_html_()
    assert "Hovercraft, fitted by steady" in html and "1.25 → 2.50 nats a trajectory, kept at step 10" in html
    assert "<td>mass</td><td>1.5</td>" in html and "note: a &lt;note&gt;" in html
    assert "Hovercraft, recipe hand, nothing learned" in st.Fit(example("hovercraft"), "hand")._repr_html_()
    assert repr(fit).startswith("Fit(Hovercraft(mass=1.5") and len(repr(fit)) < 200


@pytest.fixture(scope="module")
def fits():
    return {
        name: st.Fit(example(name), "hand", known_start=True)
        for name in ("hovercraft", "hovercraft.py:HovercraftTruth")
    }


@pytest.mark.slow
def test_a_check_and_a_proof_show_verdict_picture_and_figures(fits) -> None:
    data = simulated(rows=40, trajectories=6)
    for found in (st.check(fits["hovercraft"], data, simulations=20), st.prove(fits, data)):
        html, verdict = unescape(found._repr_html_()), found.figures["verdict"]
        assert verdict.split(":")[0] in html.partition("<img")[0] and picture(html).startswith(PNG)
        assert str(found).splitlines()[-1].strip() in html
        assert verdict in repr(found) and len(repr(found)) < 600


@pytest.mark.exhaustive
def test_a_discovery_shows_sentence_picture_and_figures() -> None:
    data = st.simulate(example("hovercraft").with_effect("yaw_bias", 0.3), 10, seed=1)
    found = st.discover(st.Fit(example("hovercraft"), "hand", known_start=True), data, simulations=50)
    html = unescape(found._repr_html_())
    assert found.figures["sentence"].split("[")[0] in html and picture(html).startswith(PNG)
    assert found.figures["sentence"] in repr(found)
    with pytest.raises(st.UsageError, match="no curve to draw: the verdict is dynamics"):
        unknown_effect(found)
