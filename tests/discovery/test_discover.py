"""`discover`: right about what is planted, silent where nothing is, and honest about what it cannot tell."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import partial

import pytest
import torch
from examples import drives, example
from matplotlib.figure import Figure
from pyro.nn import PyroParam
from small import finite
from torch.distributions import constraints

import steady_ppl as st
from steady_ppl.discovery import discover as module
from steady_ppl.discovery.candidates import _axis, _log_prior, _neighbours, variance_of_places
from steady_ppl.discovery.curves import knots_of
from steady_ppl.discovery.discover import COMPARING, NOT_CONVERGED, _afterwards, _note_of_one_drive, _searched
from steady_ppl.discovery.finding import _interval, _Spreads, next_run
from steady_ppl.discovery.search import Search
from steady_ppl.effects import Effect, chosen_variant, parsed
from steady_ppl.effects.registry import _EFFECTS, register
from steady_ppl.likelihood.maximize import maximise
from steady_ppl.plotting.discovery import unknown_effect

DRIVES, ROWS, SETS = 10, 81, 50


def owner():
    """The hovercraft with the noise that simulates it, everything learnable."""
    program = example("hovercraft", torch.float32)
    program.noise = torch.tensor([0.08, 0.08, 0.05])
    program.guesses = ()
    return program


def tables(program, drives: int = DRIVES, rows: int = ROWS, seed: int = 0):
    program.duration = (rows - 1) * program.step
    return st.simulate(program, drives, seed=2 * seed + 1), st.simulate(program, drives, seed=2 * seed + 2)


def with_effects(program, *texts):
    for text in texts:
        name, at, options, value = parsed(text)
        program = program.with_effect(chosen_variant(program, name, at, **options), value)
    return program


def discovered(*texts: str, program=None, seed: int = 0, known_start: bool = True, **more) -> st.Discovery:
    program = owner() if program is None else program
    train, valid = tables(with_effects(program, *texts), seed=seed)
    return st.discover(program, train, valid, known_start=known_start, simulations=SETS, **more)


@pytest.fixture(scope="module")
def dragged() -> st.Discovery:
    return discovered("quadratic_drag=0.05")


@pytest.fixture(scope="module")
def clean() -> st.Discovery:
    return discovered()


def test_what_it_fits_says_how_well_the_drives_tell_it(dragged, tmp_path):
    train, valid = tables(with_effects(owner(), "quadratic_drag=0.05"))
    for fit in (dragged.before, dragged.after):
        known = fit.information
        assert known is not None and known.suits(fit.program)
        assert known.has_seen(st.for_program(fit.program, train)) and known.has_seen(st.for_program(fit.program, valid))
        assert known.gain < 0.5  # nats: the mean of two folds' fits is nearly that to all of their drives
    known = dragged.after.information
    sd = known.matrix.inverse().diagonal().sqrt()[known.names.index("quadratic_drag")]
    assert float(sd) == pytest.approx(dragged.findings[0].sd[0], rel=0.3)  # which is of a fit to each fold
    dragged.after.save(tmp_path / "run")
    again = st.Fit.load(tmp_path / "run").information
    assert again is not None and torch.equal(again.matrix, known.matrix) and again.drives == known.drives


def test_a_missing_drag_is_found_with_its_coefficient(dragged):
    assert dragged.verdict == "dynamics" and dragged.p_value < 0.05
    (finding,) = dragged.findings
    assert finding.aliases[0] == "quadratic_drag" and finding.confidence > 0.8
    assert abs(finding.coefficient[0] - 0.05) < 4 * finding.sd[0]
    low, high = finding.interval[0]
    assert low < finding.coefficient[0] < high
    assert high - low == pytest.approx(2 * 1.645 * finding.sd[0], rel=1e-3)


def test_the_error_falls_and_the_noise_with_it(dragged):
    before, after = dragged.figures["before"], dragged.figures["after"]
    assert after["log_likelihood"] > before["log_likelihood"] + 2
    assert after["measurement"]["rad"]["3 s"] < 0.9 * before["measurement"]["rad"]["3 s"]
    noise = [max(side["scales"]["channels"].values()) for side in (before, after)]
    assert noise[0] > 1.5 * noise[1]


def test_the_improved_fit_has_the_effect_and_can_be_kept(dragged, tmp_path):
    program = dragged.after.program
    assert float(program.quadratic_drag.detach()) == pytest.approx(dragged.findings[0].coefficient[0])
    dragged.after.save(tmp_path / "run")
    again = st.Fit.load(tmp_path / "run")
    assert float(again.program.quadratic_drag.detach()) == pytest.approx(dragged.findings[0].coefficient[0])


def test_clean_drives_give_none_and_say_what_could_have_been_seen(clean):
    assert clean.verdict == "none" and clean.p_value > 0.05
    assert clean.findings == [] and clean.shape is None and clean.figures["effect"] is None
    limits = {one["effect"]: one["detection_limit"] for one in clean.figures["candidates"]}
    assert 0 < limits["linear_drag"] < 0.2 and 0 < limits["bearing_bias"] < 0.1
    assert len(limits["slope"]) == 2
    assert clean.figures["before"] == clean.figures["after"]


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
    counts = [
        int(count) for count in re.findall(r"(\d+) readings of the (?:training|validation) drives left", str(found))
    ]
    assert len(counts) == 2 and all(7 <= count <= 9 for count in counts)  # a good one beside a jump may go with it


@pytest.mark.exhaustive
def test_a_sensor_declared_too_coarse_takes_no_effects_place():
    program, truth = owner(), with_effects(owner(), "quadratic_drag=0.05")
    program.bearing_sd = 2.5 * truth.bearing_sd
    found = st.discover(program, *tables(truth), known_start=True, simulations=SETS)
    drag, noise = found.findings
    assert drag.aliases[0] == "quadratic_drag" and noise.variant.name == "measurement_noise"
    assert noise.is_correction and noise.interval[0][0] < 0.4 < noise.interval[0][1]
    assert str(found).startswith("These drives contradict the declared noise: measurement_noise = 0.")
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


def test_a_gain_of_one_drive_is_said_to_be(dragged):
    (found,) = dragged.search.found
    assert _note_of_one_drive(found) == ""
    gain = torch.zeros(2 * DRIVES)
    gain[13] = 9.0
    alone = replace(found, candidate=replace(found.candidate, gain=gain))
    assert _note_of_one_drive(alone).startswith("without drive 4 of the training drives nothing would be left")


def test_what_was_found_comes_first_among_the_candidates(dragged):
    assert dragged.figures["candidates"][0]["effect"] == "quadratic_drag"
    assert dragged.figures["candidates"][1]["heldout_gain"] is not None


def test_what_cannot_be_tested_says_why(clean):
    notes = {one["effect"]: one["note"] for one in clean.figures["candidates"]}
    assert notes["process_noise:yaw"] == "the fitted noise against the declared"


@pytest.mark.slow
def test_a_fit_that_has_not_converged_is_said_before_any_ranking(monkeypatch):
    monkeypatch.setattr("steady_ppl.discovery.refits.maximise", partial(maximise, steps=1))
    found = discovered("yaw_bias=0.1")
    assert not found.search.base.converged and NOT_CONVERGED in found.doubts
    assert str(found).startswith("warning: the program's own fit has not converged")
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


def test_a_scale_goes_by_factors_and_a_place_by_steps():
    """The drag of a wind is on a grid of .02, .06 and .2; a knee has no such grid."""
    program = example("hovercraft", torch.float32)
    grid = chosen_variant(program, "wind").effect.variants(program)
    assert [round(one.profiled["drag"] / 0.06, 4) for one in _neighbours(grid[0], grid, "drag", 1.0)] == [3, 0.3333]
    knee = chosen_variant(program, "thrust_saturation", knee=0.6)
    assert [one.profiled["knee"] for one in _neighbours(knee, [knee], "knee", 0.25)] == pytest.approx([0.72, 0.48])


def test_what_a_factor_leaves_open_is_in_an_interval_by_a_factor():
    effect = chosen_variant(example("hovercraft", torch.float32), "wind").effect
    low, high = _interval(effect, -0.5, 0.0, 0.25, 0.5)
    assert low * high == pytest.approx(0.25) and low < -0.5 < high < 0
    assert sum(_interval(effect, 0.5, 0.1, 0.25, 0.0)) == pytest.approx(1.0)
    low, high = _interval(effect, 1e-5, 0.02, 0.01, 0.5)  # a component near zero
    assert high == pytest.approx(-low, rel=0.01) and high < 0.04


def test_choices_of_a_factor_are_above_zero():
    program = example("hovercraft", torch.float32)
    wind = chosen_variant(program, "wind").effect
    with pytest.raises(st.UsageError, match="drag is uncertain by a factor"):
        replace(wind, choices=lambda program, data: [{"drag": 0.0}]).variants(program)
    (alone,) = replace(wind, choices=lambda program, data: [{"drag": 0.1}]).variants(program)
    assert [one.profiled["drag"] for one in _neighbours(alone, [alone], "drag", 1.0)] == pytest.approx(
        [0.18, 0.1 / 1.8]
    )
    assert _log_prior(alone, [alone]) == 0.0


def test_the_prior_of_a_place_and_its_variance_are_one():
    """Leads of 0, .2 and .5 s: a step of a quarter of .2 s is .2 of half the grid's width."""
    slip = chosen_variant(example("hovercraft"), "side_slip").effect.variants(example("hovercraft"))
    middle = replace(slip[0], options={**slip[0].options, "lead": 0.25})
    axis, falls = (
        _axis(middle, slip, "lead"),
        [_log_prior(one, slip) for one in _neighbours(middle, slip, "lead", 0.25)],
    )
    assert -2 * sum(falls) / 2 == pytest.approx((0.25 * axis.spacing / axis.half_width) ** 2) == pytest.approx(0.04)


def test_a_grid_of_one_point_goes_by_shares_of_where_it_is():
    """A radius stays above zero, and may be anywhere."""
    knee = chosen_variant(example("hovercraft"), "thrust_saturation", knee=1.0)
    here, places = knee, list[float]()
    for _ in range(3):
        here = _neighbours(here, [knee], "knee", 0.5)[1]
        places.append(here.profiled["knee"])
        assert _log_prior(here, [knee]) == 0.0
    assert places == pytest.approx([0.6, 0.36, 0.216])
    assert _axis(replace(knee, options={**knee.options, "knee": 0.0}), [knee], "knee").half_width > 0


def test_the_prior_of_a_place_is_as_wide_as_its_grid():
    slip = chosen_variant(example("hovercraft"), "side_slip").effect.variants(example("hovercraft"))  # leads 0 to .5
    assert _log_prior(replace(slip[0], options={**slip[0].options, "lead": 1.0}), slip) == pytest.approx(-4.5)
    grid = chosen_variant(example("hovercraft"), "wind").effect.variants(example("hovercraft"))
    (least,) = (one for one in grid if one.profiled["drag"] == 0.02)
    assert _log_prior(least, grid) == pytest.approx(-0.5)


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


def test_a_sensor_that_failed_on_all_training_drives_is_no_obstacle():
    program = example("pendulum", torch.float32)
    train, valid = tables(program)
    train.observed[:] = False
    train.observed[0] = True
    with pytest.raises(st.DataError, match="no measurements after their first rows"):
        st.discover(program, train, valid, simulations=SETS)
    assert knots_of(torch.zeros(0), circular=False) is None


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


@pytest.mark.slow
def test_a_run_that_has_an_effect_is_searched_for_the_next_one(dragged, tmp_path):
    dragged.after.save(tmp_path / "run")
    train, valid = tables(with_effects(owner(), "quadratic_drag=0.05"))
    again = st.discover(st.Fit.load(tmp_path / "run"), train, valid, simulations=SETS)
    assert "quadratic_drag" not in [finding.variant.name for finding in again.findings]
    assert again.before.known_start


SCHEMA = {
    "verdict": str,
    "p_value": float,
    "effect": (str, type(None)),
    "class": list,
    "confidence": (float, type(None)),
    "candidates": list,
    "shape": (dict, type(None)),
    "next_run": (dict, type(None)),
    "before": dict,
    "after": dict,
}
CANDIDATE = {
    "effect": str,
    "kind": str,
    "statistic": float,
    "p_value": float,
    "coefficient": (float, list, type(None)),
    "sd": (float, list, type(None)),
    "unit": str,
    "detection_limit": (float, list, type(None)),
    "heldout_gain": (float, type(None)),
    "heldout_gain_ci": (list, type(None)),
}


def test_the_figures_keep_to_the_schema(dragged, clean):
    for found in (dragged, clean):
        figures = json.loads(json.dumps(found.figures, allow_nan=False))
        assert finite(figures)
        for key, kind in SCHEMA.items():
            assert isinstance(figures[key], kind), key
        assert figures["verdict"] in ("none", "dynamics", "actuator", "sensor", "noise", "other")
        for candidate in figures["candidates"]:
            for key, kind in CANDIDATE.items():
                assert isinstance(candidate[key], kind), (candidate["effect"], key)
        names = [candidate["effect"] for candidate in figures["candidates"]]
        assert len(names) == len(set(names))


def test_the_text_says_the_verdict_first(dragged, clean):
    assert str(dragged).startswith("The dynamics lack quadratic_drag = 0.0")
    assert "a = -c v |v|" in str(dragged) and "open-loop error −" in str(dragged)
    assert str(clean).startswith("No effect is missing as far as these drives can tell (p = ")
    assert all(len(line) <= 125 for line in str(dragged).splitlines())


@pytest.mark.slow
@pytest.mark.parametrize(("withheld", "says"), [(["linaer_drag"], "did you mean linear_drag"), ("wind", "a list of")])
def test_what_is_withheld_is_an_effect(withheld, says):
    program = example("hovercraft")
    with pytest.raises(st.UsageError, match=says):
        st.discover(program, st.simulate(program, 10), withheld=withheld)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("only", "says"), [(["physics"], "there are dynamics, actuator, sensor, noise"), ("noise", "list")]
)
def test_what_is_looked_for_is_a_kind(only, says):
    program = example("hovercraft")
    with pytest.raises(st.UsageError, match=says):
        st.discover(program, st.simulate(program, 10), only=only)


@pytest.mark.slow
def test_mixed_tables_are_one_and_every_second_drive_chooses() -> None:
    program = example("hovercraft", torch.float32)
    train, valid = drives(program, 6, 21, seed=1), drives(program, 5, 21, seed=2)
    found = st.discover(program, train, valid, known_start=True, mix=True, simulations=50)
    first, second = found.search.base.folds
    assert first.drives.labels == ("train 1", "train 3", "train 5", "valid 1", "valid 3", "valid 5")
    assert second.drives.labels == ("train 2", "train 4", "train 6", "valid 2", "valid 4")
    assert "the tables were mixed: 5 of the 11 drives were kept to choose by" in found.notes
    with pytest.raises(st.UsageError, match="mix puts two tables together"):
        st.discover(program, train, known_start=True, mix=True)


def test_an_interrupt_after_the_search_leaves_it_complete():
    def interrupted():
        raise KeyboardInterrupt

    search, notes = Search(None, base=None, final=None, step=None, gained=0.0), []
    assert _afterwards(lambda: 3, search, COMPARING, notes) == 3 and not search.interrupted
    assert _afterwards(interrupted, search, COMPARING, notes) is None
    assert search.interrupted == COMPARING and not search.cut_short
    assert _afterwards(interrupted, search, "a later part", notes) is None and notes == []
    assert search.interrupted == COMPARING


def test_the_sd_of_an_effect_whose_program_was_not_tested_is_what_is_observed_there(dragged):
    (finding,) = dragged.findings
    untested = replace(dragged.search, rounds=dragged.search.rounds[:1])
    assert _Spreads(untested)(finding.variant) == pytest.approx(finding.sd, rel=0.3)
    maximum = replace(dragged.search.final.maxima[0], information=torch.zeros(0, 0))
    by_draws = replace(untested, final=replace(dragged.search.final, maxima=[maximum]))
    tested = dragged.search.found[0].candidate.tested
    assert _Spreads(by_draws)(finding.variant) == pytest.approx(tested.sd * dragged.search.final.first_share**0.5)


@pytest.mark.parametrize("failure", [None, ZeroDivisionError("of the program's own")])
def test_where_nothing_can_be_observed_a_note_says_whose_intervals_these_are(dragged, monkeypatch, failure):
    def observed(*_):
        if failure:
            raise failure

    monkeypatch.setattr("steady_ppl.discovery.finding.observed", observed)
    (finding,) = dragged.findings
    untested = replace(dragged.search, rounds=dragged.search.rounds[:1], notes=[])
    spread = _Spreads(untested)
    assert spread(finding.variant).tolist() == spread(finding.variant).tolist()
    assert (spread(finding.variant) > 0).all()
    (note,) = untested.notes
    assert note.endswith("ZeroDivisionError: of the program's own" if failure else "it diverges beside what was found")


@pytest.mark.parametrize(
    ("error", "raised"),
    [
        (ZeroDivisionError("by the tide"), st.FilterError),
        (st.DataError("no tide"), st.DataError),
        (KeyError(1), KeyError),
    ],
)
def test_a_fault_of_numbers_before_the_first_tests_is_a_line(monkeypatch, error, raised):
    def fails(*_):
        raise error

    monkeypatch.setattr(module, "search", fails)
    with pytest.raises(raised) as caught:
        _searched(None, None, None)
    if isinstance(error, ZeroDivisionError):
        assert str(caught.value) == "the program cannot be searched on these drives: ZeroDivisionError: by the tide"
