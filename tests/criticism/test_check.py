"""`check`: silent on clean drives, right about planted faults, and every figure what it says."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import drives, example
from oracles import assert_mean, cart_parameters, kalman
from small import finite

import steady_ppl as st
from steady_ppl import for_program
from steady_ppl.criticism.baselines import ConstantVelocity, Reference, constant_velocity
from steady_ppl.criticism.check import TAKEN_AS_EXACT, _in_own_spreads
from steady_ppl.criticism.residual_maps import Residuals
from steady_ppl.gaussian.kalman import track
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import find_path
from steady_ppl.kernels.rows import kernel_failures
from steady_ppl.likelihood.information import ParameterInformation
from steady_ppl.likelihood.parameters import elements, set_values, values_of
from steady_ppl.model.problem import Problem

CHANCE = 1e-4


def hovercraft(name: str = "hovercraft"):
    return example(name, torch.float32).requires_grad_(False)


def fitted(program, *, known_start: bool = True) -> st.Fit:
    """The program as it is, as a fit."""
    return st.Fit(program, "hand", known_start=known_start)


def table(program, trajectories: int = 12, rows: int = 81, seed: int = 0):
    program.duration = (rows - 1) * program.step
    return st.simulate(program, trajectories, seed=seed)


def judged(data, *, known_start: bool = True) -> st.Check:
    return st.check(fitted(hovercraft(), known_start=known_start), data, simulations=40)


@pytest.fixture(scope="module")
def dragged() -> st.Check:
    """The owner's program without drag on drives with drag."""
    return judged(table(hovercraft("hovercraft.py:HovercraftTruth")))


@pytest.fixture(scope="module")
def clean() -> st.Check:
    return judged(table(hovercraft(), seed=3))


@pytest.mark.slow
def test_clean_drives_are_left_alone(clean):
    figures = clean.figures
    assert figures["who"] == "nothing found" and figures["p_value"] > 0.05
    assert figures["verdict"].startswith("Nothing found") and "no proof" in figures["verdict"]
    assert figures["constant_velocity"]["loses_to_it"] == []


def test_missing_drag_is_dynamics_and_the_yaw_rate_is_where(dragged):
    figures = dragged.figures
    assert figures["who"] == "dynamics" and figures["p_value"] < 1e-3
    assert figures["evidence"]["directions"][0]["direction"].startswith("yaw acceleration with yaw velocity")
    assert figures["evidence"]["directions"][0]["z"] < 0
    regimes = [f for f in figures["findings"] if f["map"] == "regime" and f["residual"] == "yaw"]
    assert any("yaw_rate" in finding["where"] for finding in regimes)
    assert "dynamics" in figures["verdict"] and "steady discover" in figures["verdict"]


@pytest.mark.slow
def test_a_landmark_off_its_place_is_the_sensors_fault():
    data = table(hovercraft(), seed=3)
    measurements = data.measurements.clone()
    measurements[..., 1] += math.radians(4)
    figures = judged(replace(data, measurements=measurements)).figures
    assert figures["who"] == "sensor"
    assert figures["evidence"]["directions"][0]["direction"] == "offset of bearing_1"
    (overall,) = (f for f in figures["findings"] if f["map"] == "all" and f["residual"] == "bearing_1")
    assert overall["mean"] > 0 and "bearing_1 measured" in overall["text"] and "rad above" in overall["text"]


@pytest.mark.slow
def test_controls_that_act_late_are_the_actuators_fault():
    program = hovercraft()
    data = table(program, seed=3)
    late = replace(data, controls=torch.cat([data.controls[:3] * 0, data.controls[:-3]]))
    measured = st.simulate(program, seed=4, like=late)
    figures = judged(replace(measured, controls=data.controls)).figures
    assert figures["who"] == "actuator"
    assert "of all controls" in figures["evidence"]["directions"][0]["direction"]


@pytest.mark.slow
def test_more_scatter_than_declared_is_noise_and_nothing_else():
    program = hovercraft()
    program.bearing_sd = 2 * program.bearing_sd
    figures = judged(table(program, seed=3)).figures
    assert figures["who"] == "noise" and "scatter of bearing" in figures["verdict"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4])
def test_rougher_motion_than_declared_moves_drives_apart_and_is_noise(seed):
    """So it is for 26 of the first 30 seeds; the scores of the rest would pass for a mean effect's at the level."""
    program = hovercraft()
    program.noise = 2 * program.noise
    assert judged(table(program, 16, 101, seed=seed)).figures["who"] == "noise"


def test_the_real_set_is_scaled_like_any_other():
    """Or its tails would seem heavier than theirs: a third of clean drives were blamed on noise."""
    values = np.random.default_rng(0).standard_t(4, (30, 20, 3, 2))
    there = np.random.default_rng(1).random(values.shape) < 0.9
    sets = [Residuals(["a", "b"], values[i : i + 1] * there[i : i + 1], there[i : i + 1]) for i in range(30)]

    def scaled(order):
        rest = [np.concatenate([getattr(sets[i], name) for i in order[1:]]) for name in ("values", "there")]
        real, simulated = _in_own_spreads(sets[order[0]], Residuals(["a", "b"], *rest))
        return np.concatenate([real.values, simulated.values])

    there_and_back = scaled([7, *range(1, 7), 0, *range(8, 30)])
    np.testing.assert_allclose(there_and_back[[7, *range(1, 7), 0, *range(8, 30)]], scaled(list(range(30))))


@pytest.mark.slow
def test_a_mass_that_does_not_fit_is_a_parameter():
    program = hovercraft()
    program.mass = torch.tensor(1.9)
    figures = judged(table(program, seed=3)).figures
    assert figures["who"] == "parameters" and "mass (larger" in figures["verdict"]


@pytest.mark.slow
def test_false_discoveries_on_clean_drives_are_as_rare_as_they_should_be(cart):
    seeds, found, blamed = 12, 0, 0
    for seed in range(seeds):
        result = st.check(fitted(cart), drives(cart, 6, 31, seed=seed), simulations=30, seed=seed)
        found += bool(result.misfit.significant)
        blamed += result.blame.kind != "nothing found"
    chance = [math.comb(seeds, k) * 0.05**k * 0.95 ** (seeds - k) for k in range(seeds + 1)]
    most = next(k for k in range(seeds) if sum(chance[k + 1 :]) < CHANCE)
    assert found <= most and blamed <= most
    assert most < seeds / 2


@pytest.mark.exhaustive
def test_a_single_drive_beside_few_simulated_ones_accuses_nobody_either():
    """Twenty drives tell the covariance of some eighty scores: simulated ones, too, are judged by the others' alone."""
    program, seeds = hovercraft("hovercraft:HovercraftTruth"), 20
    accused = 0
    for seed in range(seeds):
        result = st.check(fitted(program, known_start=False), table(program, 1, 61, seed), simulations=20, seed=seed)
        accused += result.blame.p_values["mean"] < 0.05
    assert accused <= 4  # one in 400


@pytest.mark.exhaustive
def test_where_a_single_drive_dwells_is_not_taken_for_a_regime():
    """Of forty drives these three were accused, one of them at less than 1e-4, while simulated drives were sorted by
    the ranges of the measured one, in which they hardly were; since each is sorted by its own, none of the forty is
    below 0.1."""
    program = hovercraft("hovercraft:HovercraftTruth")
    for seed in (3, 7, 9):
        result = st.check(fitted(program, known_start=False), table(program, 1, 301, 900 + seed), seed=seed)
        assert result.misfit.p_value > 0.05, seed


def test_the_figures_are_those_of_kalmans_predictions(cart, uneven):
    figures = st.check(fitted(cart, known_start=False), uneven, simulations=200).figures
    row = figures["measurements"]["position"]["horizons"]["one step"]
    exact = kalman(uneven, cart_parameters(cart))
    seen = uneven.observed[1:, :, 0]
    error = (uneven.measurements[1:, :, 0] - exact.predicted_means[1:, :, 0])[seen]
    variance = (exact.predicted_covariances[1:, :, 0, 0] + cart.measurement_sd**2)[seen]
    assert row["count"] == len(error) and figures["measurements"]["position"]["unit"] == "m"
    assert row["rmse"] == pytest.approx(float(error.square().mean().sqrt()))
    assert row["predicted_sd"] == pytest.approx(float(variance.mean().sqrt()))
    assert row["coverage_90"] == pytest.approx(float((error.abs() < 1.644854 * variance.sqrt()).double().mean()))


def test_the_noise_floor_is_what_kalman_expects_of_its_own_errors(cart, even):
    result = st.check(fitted(cart), even, simulations=400)
    expected = (kalman(even, cart_parameters(cart), known_start=True).predicted_covariances + 0)[1:, :, 0, 0]
    assert_mean(torch.from_numpy(result.floor[1]).square(), float((expected + cart.measurement_sd**2).mean()))


@pytest.mark.slow
def test_the_reference_ignores_controls_and_scans_its_noise(clean):
    reference = clean.reference
    assert isinstance(reference, Reference) and len(reference.program.scales) == 3
    figures = clean.figures
    assert "ignores the controls" in figures["constant_velocity"]["what"]
    row = figures["measurements"]["bearing_0"]["horizons"]["3 s"]
    assert row["noise_floor_90"][0] < row["rmse"] < row["constant_velocity"] < row["last_measurement"]
    coasting = ConstantVelocity(clean.program, reference.program.scales)
    state, time, step = torch.randn(2, 3, 6), torch.zeros(2, 3), torch.full((2, 3), 0.1)
    moved = []
    for control in (torch.zeros(2, 3, 2), torch.ones(2, 3, 2)):
        with st.seeded("coast"):
            moved.append(coasting.transition(state, control, time, step))
    assert bool((moved[0] == moved[1]).all())


@pytest.mark.slow
def test_the_reference_of_a_program_takes_no_parameters_of_another():
    """Kernels have them as constants."""
    data = table(hovercraft(), 16)
    for bearing_sd in (0.02, 0.2):
        program = hovercraft()
        program.bearing_sd = bearing_sd
        problem = Problem(program, st.for_program(program, data), True)
        tracked = track(problem, find_path(problem))
        with kernel_failures() as why:
            reference = constant_velocity(problem, tracked, [1])
        assert why == {}
        own = replace(problem, program=reference.program)
        start = ReferencePath(tracked.path(problem.data).states, torch.zeros_like(tracked.noise).float())
        plain = track(own, start, passes=6, kernels=False).log_likelihood
        assert reference.log_likelihood == pytest.approx(float(plain.sum()), rel=1e-3)


@pytest.mark.slow
def test_a_program_that_loses_to_constant_velocity_is_told_so():
    class Backwards(type(hovercraft())):
        """Thrust pushes the other way."""

        def actuators(self, control, time):
            return -control

    program = Backwards().requires_grad_(False)
    program.noise = torch.tensor([2.0, 2.0, 1.0])
    figures = st.check(fitted(program), table(hovercraft(), seed=3), simulations=20).figures
    assert "3 s" in figures["constant_velocity"]["loses_to_it"]
    assert "worse than constant velocity" in figures["verdict"]


def test_json_round_trips_without_a_nan(dragged):
    figures = dragged.figures
    assert finite(figures)
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    assert all(finding["p_value"] < 0.05 for finding in figures["findings"])
    strengths = [abs(finding["z"]) for finding in figures["findings"]]
    assert strengths == sorted(strengths, reverse=True)


def test_the_text_begins_with_the_verdict_and_names_every_component(dragged):
    lines = str(dragged).splitlines()
    assert lines[0] == dragged.figures["verdict"]
    assert sum("bearing_3 [rad]" in line for line in lines) == 3  # horizons
    assert any("sd  yaw acceleration" in line and "rad/s" in line for line in lines)


def test_the_same_seed_gives_the_same_figures(cart, even):
    a, b, c = (st.check(fitted(cart), even, simulations=20, seed=seed).figures for seed in (1, 1, 2))
    assert a == b and a != c


def test_the_truth_beyond_a_known_start_changes_nothing(cart, even):
    states = even.states.clone()
    states[1:] += 5
    one, other = (st.check(fitted(cart), data, simulations=20).figures for data in (even, replace(even, states=states)))
    assert one == other


@pytest.mark.parametrize("known_start", [False, True])
def test_gaps_uneven_lengths_and_a_drive_of_one_row_leave_finite_figures(cart, uneven, known_start):
    lengths = uneven.lengths.clone()
    lengths[1] = 1
    inside = torch.arange(uneven.time.shape[0])[:, None] < lengths
    short = replace(uneven, lengths=lengths, observed=uneven.observed & inside[..., None])
    assert finite(st.check(fitted(cart, known_start=known_start), short, simulations=20).figures)


def test_drives_of_different_rates_are_said_to_be(cart, even):
    assert not even.uneven_steps
    faster = even.time.clone()
    faster[:, 1] *= 0.5
    notes = st.check(fitted(cart, known_start=False), replace(even, time=faster), simulations=20).notes
    assert "the trajectories' steps differ" in notes[0] and "rows of" in notes[0]


def test_a_component_that_is_never_measured_has_no_figures():
    data = table(hovercraft(), trajectories=4, rows=21)
    observed = data.observed.clone()
    observed[..., 2] = False
    figures = st.check(fitted(hovercraft()), replace(data, observed=observed), simulations=20).figures
    assert figures["measurements"]["bearing_2"]["horizons"] == {} and finite(figures)


def test_a_pendulum_whose_spring_is_not_in_its_program_is_dynamics():
    class Springless(type(example("pendulum"))):
        def transition(self, state, control, time, step):
            angle, rate = state.unbind(-1)
            mean = -self.damping * rate + self.gain * control[..., 0]
            rate = rate + pyro.sample("acceleration", dist.Normal(mean, self.noise)) * step
            return st.stack(angle + rate * step, rate)

    truth, program = example("pendulum", torch.float32), Springless().requires_grad_(False)
    truth.stiffness, program.noise = torch.tensor(3.0), torch.tensor(1.0)
    figures = st.check(fitted(program), table(truth, trajectories=8, rows=101), simulations=40).figures
    assert figures["who"] == "dynamics"
    assert figures["evidence"]["directions"][0]["direction"] == "torque acceleration with the sine of angle"


def test_a_spring_that_is_too_soft_is_a_parameter_and_what_could_stand_for_it_is_named_too():
    program = example("pendulum", torch.float32).requires_grad_(False)
    data = table(program, trajectories=8, rows=101)
    program.stiffness = torch.tensor(9.0)
    figures = st.check(fitted(program), data, simulations=40).figures
    assert figures["who"] == "parameters" and "stiffness (larger fits better)" in figures["verdict"]


def test_what_cannot_be_checked_is_refused(cart, even):
    with pytest.raises(st.UsageError, match="got 5 simulations: bands need at least 20"):
        st.check(fitted(cart), even, simulations=5)
    with pytest.raises(st.DataError, match="nothing to compare"):
        st.check(fitted(cart), replace(even, observed=torch.zeros_like(even.observed)))
    with pytest.raises(st.DataError, match="no x. columns"):
        st.check(fitted(cart), even.without_truth())


def test_a_program_whose_noise_is_not_normal_is_refused(cart, even):
    class Heavy(type(cart)):
        def transition(self, state, control, time, step):
            position, velocity = state.unbind(-1)
            acceleration = pyro.sample("acceleration", dist.StudentT(3.0, 0.0 * velocity, self.noise))
            return st.stack(position + velocity * step, velocity + acceleration * step)

    with pytest.raises(st.UsageError, match="check needs a model that can be linearised: .*StudentT"):
        st.check(fitted(Heavy().double().requires_grad_(False)), even)


def known_by(fit: st.Fit, data: st.Trajectories, size: float, gain: float = 0.0) -> st.Fit:
    """A fit whose own drives leave each number open by a share of it."""
    parts = elements(fit.program)
    matrix = size**-2 * torch.eye(len(parts), dtype=torch.float64)
    return replace(fit, information=ParameterInformation(tuple(p.name for p in parts), matrix, gain, set(data.digests)))


@pytest.fixture(scope="module")
def off() -> tuple[st.Fit, st.Trajectories]:
    """A cart whose numbers are off by some per cent, as a fit to few drives leaves them, and many other drives."""
    cart = example("linear_gaussian", torch.float32)
    data = st.simulate(cart, 40, seed=8)
    parts = elements(cart)
    set_values(parts, values_of(parts) + torch.tensor([0.06, -0.06, 0.0, 0.0]).double())
    return st.Fit(cart, "likelihood", known_start=True), data


def test_what_a_fit_could_not_know_is_no_fault(off) -> None:
    fit, data = off
    sure = st.check(fit, data, simulations=40)
    assert sure.blame.kind == "parameters" and "fit it again first" in str(sure)
    assert TAKEN_AS_EXACT in sure.notes
    assert TAKEN_AS_EXACT not in st.check(replace(fit, recipe="hand"), data, simulations=20).notes  # nothing was fitted
    others = st.simulate(fit.program, 3, seed=9)
    open_ = st.check(known_by(fit, for_program(fit.program, others), 0.1), data, simulations=40)
    assert open_.is_open and TAKEN_AS_EXACT not in open_.notes and open_.blame.p_values["parameters"] > 0.05
    assert open_.figures["parameter_uncertainty"] is True
    assert "noise and fit" in str(open_) and "bands hold what the fit's own leave open" in str(open_)
    assert "noise alone" in str(sure) and "bands hold" not in str(sure)


def test_on_its_own_drives_a_fits_uncertainty_does_not_count(off) -> None:
    fit, data = off
    found = st.check(known_by(fit, for_program(fit.program, data), 0.1), data, simulations=40)
    assert not found.is_open and found.blame.kind == "parameters"
    masked = st.check(
        known_by(fit, for_program(fit.program, data), 0.1), data.subset([1]), has_seen=False, simulations=20
    )
    assert masked.is_open and any("1 of these trajectories are the fit's own" in note for note in masked.notes)


def test_numbers_that_lead_anywhere_are_taken_as_exact(off) -> None:
    fit, data = off
    others = for_program(fit.program, st.simulate(fit.program, 3, seed=9))
    found = st.check(known_by(fit, others, 1e6), data, simulations=20)
    if not found.is_open:
        assert any("parameters are taken as exact" in note for note in found.notes)
    assert found.blame.kind in ("nothing found", "parameters")


@pytest.mark.parametrize(
    ("gain", "says"),
    [
        (
            0.01,
            "although the fit has converged: these trajectories are of another vehicle, or an effect is missing;",
        ),
        (7.0, "and the fit has not converged (a longer one gains 7 nats, linearised): fit it again first"),
    ],
)
def test_a_fit_that_has_ended_is_not_sent_back(off, gain: float, says: str) -> None:
    fit, data = off
    others = for_program(fit.program, st.simulate(fit.program, 3, seed=9))
    found = st.check(known_by(fit, others, 1e-3, gain), data, simulations=40)
    assert found.blame.kind == "parameters" and says in str(found).replace("\n", " ")
    assert found.figures["gain_of_longer_fit"] == gain


def test_times_ahead_may_be_asked_for(cart, even) -> None:
    found = st.check(fitted(cart), even, simulations=20, horizons=[0.7])
    assert list(found.horizons) == ["one step", "0.7 s"]
