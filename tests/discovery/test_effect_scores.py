"""Scores of effects and curves are derivatives of log p(y) where they are absent; a shortcut by residuals is not."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from examples import drives, example
from paths import at_rest, settled

from steady_ppl.discovery.curves import curves
from steady_ppl.discovery.effect_scores import Column, Scoring, scores_along, simulate_scores
from steady_ppl.effects import attach, chosen_variant, parsed
from steady_ppl.gaussian.smoother import smooth
from steady_ppl.likelihood.parameters import elements
from steady_ppl.likelihood.scores import typical_spreads
from steady_ppl.model.problem import Problem

EFFECTS = (
    "linear_drag",
    "coulomb_friction",
    "slope",
    "yaw_bias",
    "thrust_asymmetry",
    "dead_zone",
    "actuator_lag",
    "battery_sag",
    "lever_arm",
    "landmark_bias:bearing_1",
    "sensor_scale",
    "clock_offset",
    "range_dependent_noise",
    "measurement_noise",
)


@pytest.fixture(scope="module")
def hovercraft():
    program = example("hovercraft")
    data = drives(program, 12, 41)
    at, path = at_rest(program, data)
    return program, data, at, path


@pytest.mark.slow
@pytest.mark.parametrize("text", EFFECTS)
def test_scores_of_effects_are_slopes_of_log_likelihood_where_they_are_absent(hovercraft, text):
    program, data, at, path = hovercraft
    name, where, options, _ = parsed(text)
    variant = chosen_variant(program, name, where, **options)
    found = Scoring(program, data, at)(Column(variant))
    size, null = variant.effect.size, variant.effect.null
    typical = torch.as_tensor(variant.effect.typical).double().flatten()
    for index in range(size):
        step = 0.02 * float((typical - null).abs().max())
        by = torch.zeros(size).double()
        by[index] = step
        values = [null + sign * by for sign in (1, -1)]
        sides = [attach(deepcopy(program), variant, v.tolist() if size > 1 else float(v[0])) for v in values]
        up, down = (settled(one, data, path)[0].log_likelihood for one in sides)
        expected = (up - down) / (2 * step)
        both = torch.stack([found[:, index], expected])
        assert torch.corrcoef(both)[0, 1] > 0.995, f"{text}: {both.tolist()}"
        ratio = float((both[0] * both[1]).sum() / both[1].square().sum())
        assert ratio == pytest.approx(1, abs=0.05), text


@pytest.mark.slow
def test_scores_of_curves_are_those_of_their_heights(hovercraft):
    """Against the same curve attached with a small height at one knot."""
    program, data, at, path = hovercraft
    seen = replace(data, states=path.states)
    spread, sharpness = typical_spreads(program, data, at)
    every = {variant.at: variant for variant in curves(program, seen, spread, sharpness)}
    scoring = Scoring(program, data, at)
    for name in (
        "forward~forward velocity",
        "yaw~heading",
        "lateral~commanded yaw",
        "forward~time × what is commanded",
        "bearing_1~reading",
        "all~reading",
    ):
        variant = every[name]
        found = scoring(Column(variant))
        for knot in (0, 3):
            height = torch.zeros(variant.effect.size).double()
            height[knot] = 0.05 * variant.effect.limit
            sides = [program.with_effect(variant, sign * height) for sign in (1, -1)]
            up, down = (settled(one, data, path)[0].log_likelihood for one in sides)
            expected = (up - down) / (2 * height[knot])
            close = (found[:, knot] - expected).abs().max() < 0.08 * max(1e-3, float(expected.abs().max()))
            assert close, f"{name} knot {knot}: {found[:, knot].tolist()} for {expected.tolist()}"


@pytest.mark.slow
def test_the_regression_of_smoothed_residuals_is_biased_and_the_scores_are_not():
    """The reference's bias: the smoother has already believed the program without the drag."""
    truth = example("hovercraft").with_effect("linear_drag", 0.05)
    program = example("hovercraft")
    data = drives(truth, 60, 61)
    at, _ = at_rest(program, data)
    variant = chosen_variant(program, "linear_drag", "")
    states, noise = at.states[:-1], at.channels.mean
    push = variant(program, states, data.controls[:-1], data.elapsed[:-1], data.steps, c=torch.ones(()).double())
    columns = torch.stack([push["forward"], push["lateral"]], -1) / program.noise[:2].detach()
    shortcut = float((columns * noise[..., :2]).sum() / columns.square().sum())
    score = Scoring(program, data, at)(Column(variant)).flatten()
    clean = drives(example("hovercraft"), 60, 61, seed=1)
    null = Scoring(program, clean, at_rest(program, clean)[0])(Column(variant)).flatten()
    step = float(score.sum() / (len(score) * null.var()))
    assert shortcut < 0.35 * 0.05
    assert step == pytest.approx(0.05, rel=0.35)  # the information's standard error is 1/√30, and a step is not the end


def with_function(column: Column, function) -> Column:
    return replace(column, variant=replace(column.variant, effect=replace(column.variant.effect, function=function)))


def test_a_candidate_that_fails_takes_no_other_along(hovercraft):
    """Its own code raises, it is not finite, or it is not finite on drives that are simulated."""
    program, data, _, path = hovercraft
    problem, parts = Problem(program, data, False), elements(program)
    sound = Column(chosen_variant(program, "yaw_bias", ""))

    def raises(*_, c, **__):
        raise ZeroDivisionError("no wind")

    def is_not_finite(self, state, *_, c, **__):
        return {"yaw": c * state[..., 0] * float("nan")}

    def fails_elsewhere(self, state, *_, c, **__):
        near = torch.isin(state[..., 0], seen)
        return {"yaw": torch.where(near, c * state[..., 0], float("nan"))}

    ahead = smooth(problem, path, passes=3, tolerance=0.01)
    columns = [sound, with_function(sound, raises), with_function(sound, is_not_finite)]
    _, (scores, why, other) = scores_along(problem, ahead, parts, columns)
    assert why == "ZeroDivisionError: no wind" and "not finite" in other
    assert torch.equal(scores_along(problem, ahead, parts, [sound])[1][0], scores)

    seen = torch.empty(0).double()  # of simulated drives none
    starts = path.states[0].expand(20, -1, -1)
    simulated = simulate_scores(problem, starts, parts, [sound, with_function(sound, fails_elsewhere)], seed=1)
    assert torch.equal(simulated[..., :-1], simulate_scores(problem, starts, parts, [sound], seed=1))
    assert bool(simulated[..., -1].isnan().any())
