"""`discover` finds what is planted: forces, faults of sensors, noise, several at once and effects of one's own."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial

import pytest
import torch
from examples import example
from matplotlib.figure import Figure
from planted_drives import ROWS, SETS, discovered, owner, tables, with_effects
from pyro.nn import PyroParam
from torch.distributions import constraints

import steady_ppl as st
from steady_ppl.discovery.candidates import variance_of_places
from steady_ppl.discovery.discover import NOT_CONVERGED
from steady_ppl.discovery.finding import next_run
from steady_ppl.effects import Effect
from steady_ppl.effects.registry import _EFFECTS, register
from steady_ppl.likelihood.maximize import maximise
from steady_ppl.plotting.discovery import unknown_effect


@pytest.mark.slow
def test_a_fault_of_the_sensor_is_not_blamed_on_the_dynamics():
    found = discovered("landmark_bias:1=0.07")
    assert found.verdict == "sensor" and found.findings[0].aliases == ["landmark_bias:bearing_1"]
    assert abs(found.findings[0].coefficient[0] - 0.07) < 4 * found.findings[0].sd[0]


@pytest.mark.slow
def test_wrong_readings_decide_nothing():
    program = owner()
    tables_of_truth = tables(with_effects(program, "quadratic_drag=0.05"))
    train, valid = (replace(one, measurements=one.measurements.clone()) for one in tables_of_truth)
    for data in (train, valid):
        data.measurements[30:36, 1, 2] += 1.5
        data.measurements[50, 4, 0] -= 2.0
    found = st.discover(program, train, valid, known_start=True, simulations=SETS)
    assert [finding.aliases[0] for finding in found.findings] == ["quadratic_drag"]
    assert abs(found.findings[0].coefficient[0] - 0.05) < 4 * found.findings[0].sd[0]
    assert [one["columns"] for one in found.figures["outliers"]] == 2 * [["y.bearing_2"], ["y.bearing_0"]]
    left = re.findall(r"(\d+) readings of the (?:training|validation) trajectories left", str(found))
    counts = [int(count) for count in left]
    assert len(counts) == 2 and all(7 <= count <= 9 for count in counts)  # a good one beside a jump may go with it


@pytest.mark.exhaustive
def test_a_sensor_declared_too_coarse_takes_no_effects_place():
    program, truth = owner(), with_effects(owner(), "quadratic_drag=0.05")
    program.bearing_sd = 2.5 * truth.bearing_sd
    found = st.discover(program, *tables(truth), known_start=True, simulations=SETS)
    drag, noise = found.findings
    assert drag.aliases[0] == "quadratic_drag" and noise.variant.name == "measurement_noise"
    assert noise.is_correction and noise.interval[0][0] < 0.4 < noise.interval[0][1]
    assert str(found).startswith("These trajectories contradict the declared noise: measurement_noise = 0.")
    assert [one["correction"] for one in found.figures["effects"]] == [False, True]


@pytest.mark.slow
def test_two_effects_are_both_found():
    found = discovered("linear_drag=0.12", "landmark_bias:2=0.08")
    assert {finding.aliases[0] for finding in found.findings} >= {"landmark_bias:bearing_2"}
    assert any("linear_drag" in finding.aliases for finding in found.findings)


@pytest.mark.exhaustive
def test_what_no_effect_explains_is_a_curve():
    found = discovered("yaw_linear_drag=0.12", withheld=["yaw_linear_drag", "yaw_quadratic_drag"])
    assert found.verdict == "other" and found.findings == []
    shape = found.shape
    assert (shape.channel, shape.variable) == ("yaw", "yaw_rate")
    for point, height, band in zip(shape.points, shape.curve, shape.band, strict=True):
        assert abs(height + 0.12 * point) < 3 * band + 0.02
    assert found.figures["class"] == [] and found.figures["effect"] is None
    axes = unknown_effect(found, axes=Figure().subplots())
    (curve,) = (line for line in axes.get_lines() if line.get_label() == "curve")
    assert curve.get_ydata().tolist() == pytest.approx(list(shape.curve)) and "yaw_rate [rad/s]" in axes.get_xlabel()


@pytest.mark.exhaustive
def test_noise_that_is_not_the_declared_is_said_to_be():
    program = owner()
    truth = owner()
    truth.noise = 3 * truth.noise.detach()
    train, valid = tables(truth)
    found = st.discover(program, train, valid, known_start=True, simulations=SETS)
    assert found.verdict == "noise"
    assert all(finding.variant.effect.name == "process_noise" for finding in found.findings)
    assert found.findings[0].interval[0][0] < 3 < found.findings[0].interval[0][1] * 1.3
    program.guesses = ("noise",)
    again = st.discover(program, train, valid, known_start=True, simulations=SETS)
    assert "process_noise" not in [finding.variant.effect.name for finding in again.findings]


@pytest.mark.exhaustive
def test_a_sensor_whose_noise_is_learned_is_said_not_to_be_the_declared():
    truth, program = FreeSight(), FreeSight()
    truth.bearing_sd = torch.tensor(0.12)
    found = st.discover(program, *tables(truth), known_start=True, simulations=SETS)
    (finding,) = found.findings
    assert found.verdict == "noise" and finding.variant.name == "measurement_noise"
    low, high = finding.interval[0]
    assert low < 0.12 / 0.06 < high and high - low < 0.2
    assert "The noise is not as declared: measurement_noise = " in str(found)


class FreeSight(type(owner())):
    """The hovercraft, the standard deviation of its bearings learned."""

    def __init__(self):
        super().__init__()
        self.noise = torch.tensor([0.08, 0.08, 0.05])
        self.bearing_sd = PyroParam(torch.tensor(0.06), constraints.positive)


@pytest.mark.slow
def test_a_fit_that_has_not_converged_is_said_before_any_ranking(monkeypatch):
    monkeypatch.setattr("steady_ppl.discovery.refits.maximise", partial(maximise, steps=1))
    found = discovered("yaw_bias=0.1")
    assert not found.search.base.converged and NOT_CONVERGED in found.doubts
    assert str(found).startswith("warning: the model's own fit has not converged")
    assert found.figures["doubts"] == found.doubts


@pytest.mark.exhaustive
def test_not_knowing_a_knee_is_in_the_coefficients_interval():
    found = discovered("thrust_saturation:knee=0.6=0.8")
    (finding,) = found.findings
    assert finding.variant.name == "thrust_saturation" and abs(finding.coefficient[0] - 0.8) < 3 * finding.sd[0]
    (alone,) = found.search.rounds[-1].screening.spread_of(found.search.final, finding.variant).numpy()
    (one,) = found.search.found
    places = float(variance_of_places(one.without, one.candidate))
    assert places > 0.1 * alone**2 and finding.sd[0] ** 2 == pytest.approx(alone**2 + places, rel=1e-3)


@pytest.mark.exhaustive
def test_the_next_run_tells_what_these_drives_do_not():
    """Steady flight at one speed: what brakes it may go with the velocity or with its square."""
    found = discovered("linear_drag=0.1")
    (one,) = found.search.found
    brakes = [c for c in one.candidates if c.variant.name in ("linear_drag", "quadratic_drag")]
    run = next_run(Unclear(brakes), 0)
    assert run.between == ["linear_drag", "quadratic_drag"] and run.separation > max(0.0, run.usual)
    assert {len(values) for values in run.controls.values()} == {ROWS}
    low, high = (float(edge) for edge in torch.aminmax(found.search.base.folds[0].drives.controls[:-1]))
    assert all(low - 1e-3 <= value <= high + 1e-3 for values in run.controls.values() for value in values)


class Unclear:
    """A class of several effects."""

    def __init__(self, aliases):
        self.aliases = aliases


@pytest.mark.exhaustive
def test_an_effect_of_ones_own_is_found():
    def tether(self, state, control, time, step, c):
        return {"yaw": -c * state[..., 2].sin()}

    effect = Effect(
        name="compass_spring",
        form="push",
        equation=r"a_\psi = -c \sin\psi",
        text="a_yaw = -c sin(heading)",
        unit="rad/s²",
        feels="turns north by itself",
        function=tether,
        typical=0.1,
        limit=5.0,
        lacks=lambda program: None if "heading" in program.angles else "there is no heading",
    )
    known = list(_EFFECTS)
    register(effect)
    try:
        found = discovered("compass_spring=0.08")
    finally:
        _EFFECTS[:] = known
    assert found.figures["effect"] == "compass_spring"
    assert abs(found.findings[0].coefficient[0] - 0.08) < 4 * found.findings[0].sd[0]


@pytest.mark.exhaustive
def test_a_pendulum_lacks_friction_and_a_spring_and_says_so():
    program = example("pendulum", torch.float32)
    found = discovered("coulomb_friction=0.8", "cubic_stiffness=4", program=program)
    assert found.verdict == "dynamics"
    assert {finding.aliases[0] for finding in found.findings} == {"coulomb_friction", "cubic_stiffness"}
    for finding, planted in ((one, 0.8 if one.aliases[0] == "coulomb_friction" else 4) for one in found.findings):
        assert abs(finding.coefficient[0] - planted) < 4 * finding.sd[0]


@pytest.mark.exhaustive
def test_an_unknown_start_gaps_and_unequal_lengths_do_not_mislead():
    train, valid = tables(with_effects(owner(), "quadratic_drag=0.06"), rows=91)
    found = st.discover(owner(), gappy(train, 1), gappy(valid, 2), simulations=SETS)
    assert found.verdict == "dynamics" and "quadratic_drag" in found.findings[0].aliases


def gappy(data, seed: int):
    """A tenth of the cells missing, every third drive twenty rows shorter, no true states."""
    random = torch.Generator().manual_seed(seed)
    lengths = data.lengths.clone()
    lengths[::3] -= 20
    inside = torch.arange(len(data.time)).unsqueeze(-1) < lengths
    seen = (torch.rand(data.observed.shape, generator=random) > 0.1) & inside.unsqueeze(-1) & data.observed
    time = torch.where(inside, data.time, data.time.gather(0, (lengths - 1).unsqueeze(0)))
    after = (torch.arange(len(data.time)).unsqueeze(-1) - lengths + 1).clamp(min=0)
    return replace(
        data,
        time=time + 0.1 * after,
        lengths=lengths,
        observed=seen,
        measurements=torch.where(seen, data.measurements, 0.0),
        controls=torch.where(inside.unsqueeze(-1), data.controls, 0.0),
        states=None,
    )
