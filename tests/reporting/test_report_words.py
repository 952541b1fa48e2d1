"""Equations, verdicts and coefficients as the page says them."""

from __future__ import annotations

from dataclasses import replace

import torch
from examples import example
from markupsafe import escape

from steady_ppl.effects import attached
from steady_ppl.reporting.report import _equation, said, spread


def test_an_equation_that_is_no_latex_is_said_in_words():
    program = example("hovercraft", torch.float32).with_effect("linear_drag", 0.1)
    (variant,) = attached(program)
    broken = replace(variant.effect, equation=r"\frac{")
    assert _equation(broken) == escape(broken.text)
    assert "<math" in _equation(variant.effect)


def test_sentences_of_a_verdict_are_set_as_text():
    assert said("`steady discover` <b> between -0.5 and -3 of 90 %") == (
        "<code>steady discover</code> &lt;b&gt; between −0.5 and −3 of 90\u00a0%"
    )


def test_coefficients_stand_beside_their_own_spread():
    assert spread({"coefficient": [1.0, -2.0], "sd": [0.1, 0.2]}) == "1 ± 0.1, −2 ± 0.2"
    assert spread({"coefficient": 1.5, "sd": None}) == "1.5"
    assert spread({"coefficient": [1.0, 2.0], "sd": None}) == "1, 2"
