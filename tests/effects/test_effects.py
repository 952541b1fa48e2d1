"""The catalogue: what each effect does, how it is named, and that a program with effects is a program."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pyro
import pytest
import torch
from examples import MODELS, drives, example
from pyro.infer import Trace_ELBO
from small import steady

from inference import steady as recipe
from steady_ppl import Fit, Joint, TruthGuide, UsageError, channel_means, for_program, load_program, simulate
from steady_ppl.effects import Effect, attached, catalogue, chosen_variant, find, not_applicable, parsed, record
from steady_ppl.effects.registry import page
from steady_ppl.guides.base import true_paths
from steady_ppl.likelihood.evidence import log_likelihood
from steady_ppl.model.handlers import Recording, Replaying
from steady_ppl.model.substeps import acting_controls, sample_row
from steady_ppl.model.validate import probe

PROGRAMS = ("hovercraft", "truck", "pendulum")
EFFECTS = [(program, effect.name) for program in PROGRAMS for effect in catalogue(example(program))]
every_effect = pytest.mark.parametrize(("name", "effect"), EFFECTS, ids=["-".join(pair) for pair in EFFECTS])


def short(name: str, rows: int = 9):
    program = example(name)
    program.duration = (rows - 1) * program.step
    return program


def variants(program, effect: str):
    return chosen_variant(program, effect).effect.variants(program)


# --- each effect ------------------------------------------------------------------------------------------------------


@every_effect
def test_without_its_coefficient_the_effect_is_not_there(name: str, effect: str) -> None:
    """The same seed gives the same drives; tails come near the normal's as far as their cap lets them."""
    program = short(name)
    plain = simulate(program, 3, seed=1)
    for variant in variants(program, effect):
        absent = variant.absent(torch.zeros((), dtype=torch.float64))
        with_it = simulate(program.with_effect(variant, absent), 3, seed=1)
        exact = {"rtol": 0.0, "atol": 1e-12 if effect != "heavy_tails" else 0.05}
        torch.testing.assert_close(with_it.states[..., : len(program.states)], plain.states, **exact)
        torch.testing.assert_close(with_it.measurements, plain.measurements, **exact)


@every_effect
def test_with_its_typical_coefficient_the_effect_is_felt_by_a_sound_program(name: str, effect: str) -> None:
    program = short(name, rows=40)
    plain = simulate(program, 3, seed=1)
    for variant in variants(program, effect)[:1]:
        with_it = program.with_effect(variant)
        probe(with_it)
        felt = simulate(with_it, 3, seed=1)
        assert torch.isfinite(felt.states).all()
        assert not torch.equal(felt.measurements, plain.measurements) or is_idle(program, variant)


def is_idle(program, variant) -> bool:
    """Whether the example drives never get to the knee or to the limit."""
    return variant.effect.name in ("thrust_saturation", "acceleration_limit")


@every_effect
def test_the_coefficient_has_a_finite_gradient_where_the_effect_is_absent(name: str, effect: str) -> None:
    program = short(name)
    for variant in variants(program, effect)[:2]:
        start = None if math.isinf(variant.effect.null) else variant.absent(torch.zeros((), dtype=torch.float64))
        with_it = program.with_effect(variant, start)
        data = drives(with_it, 2, 9)
        guide = TruthGuide(with_it)
        guide.refresh(data, 0.0)
        elbo = Trace_ELBO(max_plate_nesting=2)
        with pyro.settings.context(module_local_params=True), pyro.validation_enabled(False):
            elbo.differentiable_loss(Joint(with_it), guide, data).backward()
        for parameter, value in with_it.named_parameters():
            assert value.grad is not None and torch.isfinite(value.grad).all(), (variant.label, parameter)


STATE = torch.tensor([1.0, -2.0, 0.7, 0.8, 0.5, 0.3], dtype=torch.float64)  # x, y, heading, vx, vy, yaw rate
COS, SIN = math.cos(0.7), math.sin(0.7)
FORWARD, LATERAL = 0.8 * COS + 0.5 * SIN, 0.5 * COS - 0.8 * SIN  # 0.93, −0.13 m/s
THRUSTS = torch.tensor([0.9, 0.4], dtype=torch.float64)
STEP = torch.tensor(0.1, dtype=torch.float64)


def means(program, state=STATE, control=THRUSTS, time=3.0) -> torch.Tensor:
    """Mean accelerations at one state, with the controls as they act when held for ever."""
    clock = torch.tensor([[time], [time + 0.1]], dtype=torch.float64)
    control = program.actuators(control.expand(2, 1, -1), clock)[0, 0]
    found = channel_means(program, program.transition, state, control, clock[0, 0], STEP)
    return torch.stack([found[channel] for channel in program.channel_names]).detach()


@pytest.mark.parametrize(
    ("effect", "value", "pushes"),
    [
        ("linear_drag", 0.2, (-0.2 * FORWARD, -0.2 * LATERAL, 0)),
        ("quadratic_drag", 0.2, (-0.2 * FORWARD**2, 0.2 * LATERAL**2, 0)),
        (
            "coulomb_friction",
            0.2,
            (-0.2 * FORWARD / math.hypot(FORWARD, 0.05), -0.2 * LATERAL / math.hypot(LATERAL, 0.05), 0),
        ),
        ("yaw_linear_drag", 0.2, (0, 0, -0.2 * 0.3)),
        ("yaw_quadratic_drag", 0.2, (0, 0, -0.2 * 0.3**2)),
        ("yaw_bias", 0.2, (0, 0, 0.2)),
        ("acceleration_bias", (0.2, 0.1), (0.2, 0.1, 0)),
        ("slope", (0.2, 0.0), (0.2 * COS, -0.2 * SIN, 0)),
        ("slope", (0.0, 0.2), (0.2 * SIN, 0.2 * COS, 0)),
        ("lateral_coupling", 0.2, (0, 0.2 * 0.5, 0)),
        ("weathervane", 0.2, (0, 0, -0.2 * FORWARD * LATERAL)),
        ("magnus", 0.2, (0, -0.2 * FORWARD * 0.3, 0)),
        ("lever_arm", 0.2, (0.2 * 0.3**2, 0.2 * 0.5 / 1.5, 0)),  # a_yaw = −0.5 / 1.5
        ("side_slip:lead=0.5", 0.2, (0, -0.2 * (LATERAL - 0.5 * 0.3), 0)),
        (
            "sticky_patch:x=1:y=-3:radius=2",
            0.2,
            (-0.2 * FORWARD * math.exp(-1 / 8), -0.2 * LATERAL * math.exp(-1 / 8), 0),
        ),
        ("acceleration_limit", 0.5, (0.5 - 1.3 / 1.5, 0, 0)),
        ("acceleration_limit:yaw", 0.2, (0, 0, 0.5 / 1.5 - 0.2)),
        ("thrust_asymmetry", 0.2, (0.2 * 0.4 / 1.5, 0, 0.2 * 0.4 / 1.5)),  # the right one pulls to the left
        (
            "speed_dependent_gain",
            0.2,
            (-0.2 * math.hypot(0.8, 0.5) * 1.3 / 1.5, 0, 0.2 * math.hypot(0.8, 0.5) * 0.5 / 1.5),
        ),
        ("thrust_saturation:knee=0.5", 0.2, (-0.2 * 0.4 / 1.5, 0, 0.2 * 0.4 / 1.5)),
        ("dead_zone", 0.2, (-0.4 / 1.5, 0, 0)),
        ("dead_zone", 0.5, (-0.9 / 1.5, 0, 0.1 / 1.5)),  # the right one does nothing, the left one 0.4
        ("battery_sag", 0.2, (-0.2 * 0.3 * 1.3 / 1.5, 0, 0.2 * 0.3 * 0.5 / 1.5)),  # after 3 of 10 s
        ("actuator_lag", 0.2, (0, 0, 0)),
        ("actuator_delay", 0.2, (0, 0, 0)),
    ],
)
def test_a_hovercraft_is_pushed_as_the_equation_says(effect: str, value, pushes: tuple[float, ...]) -> None:
    program = example("hovercraft")
    got = means(program.with_effect(effect, value)) - means(program)
    torch.testing.assert_close(got, torch.tensor(pushes, dtype=torch.float64), rtol=1e-6, atol=1e-7)


def test_a_wind_carries_what_is_at_rest_and_stops_when_it_moves_along() -> None:
    program = example("hovercraft").with_effect("wind:drag=0.1", (2.0, 0.0))
    still = STATE * torch.tensor([1, 1, 0, 0, 0, 0])
    idle = torch.zeros(2, dtype=torch.float64)
    torch.testing.assert_close(means(program, still, idle), torch.tensor([0.4, 0, 0]).double(), atol=1e-7, rtol=1e-6)
    carried = still + torch.tensor(
        [0, 0, 0, 2.0, 0, 0]
    )  # no drag where there is no wind past it: 0.1 · 2² is given back
    torch.testing.assert_close(means(program, carried, idle), torch.tensor([0.4, 0, 0]).double(), atol=1e-7, rtol=1e-6)


@pytest.mark.parametrize(
    ("effect", "value", "pushes"),
    [
        ("gain_error:turn", 0.2, (0, 0, 0.2 * 0.5 * 0.4 / 0.1)),
        ("gain_error:speed", -0.2, (-0.2 * 0.95 / 0.1, 0, 0)),
        ("lever_arm", 0.2, (0, 0.2 * 0.5 * 0.4 / 0.1, 0)),  # v_y goes to c · yaw rate, which goes to what it is told
        ("curvature_steering", 0.5, (0, 0, 0.5 * 0.5 * 0.4 * (0.95 * FORWARD / (0.95**2 + 0.05**2) - 1) / 0.1)),
        ("response_time", 0.3, (-0.75 * (0.95 - FORWARD) / 0.1, 0, 0)),  # in 0.1 + 0.3 s
        ("response_time:yaw", 0.1, (0, 0, -0.5 * (0.5 * 0.4 - 0.3) / 0.1)),
        ("response_time:lateral", 0.1, (0, 0.5 * LATERAL / 0.1, 0)),
        ("steering_offset", 0.2, (0, 0, 0.5 * 0.2 * FORWARD / 0.1)),
        ("understeer", 0.2, (0, 0, -0.5 * 0.2 * FORWARD**2 * 0.4 / 0.1)),
        ("reverse_steering", 0.2, (0, 0, -0.5 * 0.2 * math.tanh(FORWARD / 0.1) * 0.4 / 0.1)),
        ("crab_angle", 0.2, (0, 0.2 * 0.95 / 0.1, 0)),  # likewise
        ("slip_angle", 0.2, (0, -0.2 * (FORWARD * 0.5 * 0.4 + (0.95 - FORWARD) * 0.3) / 0.1, 0)),
        ("caster", 0.2, (0, 0, -0.2 * FORWARD * 0.3)),
    ],
)
def test_a_truck_is_pushed_as_the_equation_says(effect: str, value: float, pushes: tuple[float, ...]) -> None:
    program, control = example("truck"), torch.tensor([0.95, 0.4], dtype=torch.float64)
    got = means(program.with_effect(effect, value), control=control) - means(program, control=control)
    torch.testing.assert_close(got, torch.tensor(pushes, dtype=torch.float64), rtol=1e-6, atol=1e-6)


def test_a_spring_pulls_a_pendulum_back() -> None:
    program, state = example("pendulum"), torch.tensor([0.5, 0.2], dtype=torch.float64)
    for effect, push in (("stiffness", -2 * 0.5), ("cubic_stiffness", -2 * 0.5**3)):
        got = means(program.with_effect(effect, 2.0), state, THRUSTS[:1]) - means(program, state, THRUSTS[:1])
        torch.testing.assert_close(got, torch.tensor([push], dtype=torch.float64))
    assert attached(program.with_effect("stiffness"))[0].parameter == "stiffness_effect"  # it has a `stiffness`


def seen(program, state=STATE) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and standard deviation of what is measured."""
    recording = Recording()
    with recording:
        program.observe(state)
    fn = recording.distributions["bearing"].base_dist
    return fn.loc.detach(), fn.scale.detach()


def test_sensors_read_as_the_equations_say() -> None:
    program = example("hovercraft")
    reading, sd = seen(program)
    third = torch.tensor([0, 0, 1.0, 0], dtype=torch.float64)
    moved = STATE - 0.2 * torch.cat([STATE[3:], torch.zeros(3)])
    for effect, value, expected in (
        ("bearing_bias", 0.1, reading + 0.1),
        ("landmark_bias:2", 0.1, reading + 0.1 * third),
        ("sensor_scale", 0.1, 1.1 * torch.atan2(reading.sin(), reading.cos())),
        ("clock_offset", 0.2, seen(program, moved)[0]),
    ):
        got = seen(program.with_effect(effect, value))[0]
        assert torch.allclose(torch.cos(got - expected), torch.ones(4).double(), atol=1e-12), effect
    ranges = (torch.tensor(program.landmarks).double() - STATE[:2]).square().sum(-1).sqrt()
    torch.testing.assert_close(seen(program.with_effect("range_dependent_noise", 0.1))[1], sd * (1 + 0.1 * ranges))


def test_noise_is_as_wide_as_the_equations_say() -> None:
    def widths(program, control=THRUSTS):
        recording = Recording()
        with recording:
            program.transition(STATE, control, torch.zeros(()), STEP)
        return recording.distributions["acceleration"].stddev.detach()

    program, truck = example("hovercraft"), example("truck")
    for effect, factor in (("translation", (3, 3, 1)), ("yaw", (1, 1, 3))):
        got = widths(program.with_effect(f"process_noise:{effect}", 3.0)) / widths(program)
        torch.testing.assert_close(got, torch.tensor(factor, dtype=torch.float64), rtol=1e-6, atol=0)
    got = widths(truck.with_effect("command_noise", 2.0)) / widths(truck)
    factors = (1 + 2 * abs(0.9 - FORWARD), 1, 1 + 2 * abs(0.4 - 0.3))
    torch.testing.assert_close(got, torch.tensor(factors, dtype=torch.float64), rtol=1e-6, atol=0)


# --- coloured noise ---------------------------------------------------------------------------------------------------


def test_coloured_noise_has_the_spread_and_the_memory_that_it_claims() -> None:
    """Stationary sd σ and lag-1 correlation c; 5 standard errors, drives being independent."""
    program = load_program(f"{MODELS / 'hovercraft.py'}:Hovercraft").double()
    share, rows, count = 0.8, 40, 1500
    coloured = program.with_effect("coloured_noise:yaw", share)
    coloured.duration = (rows - 1) * program.step
    deviation = simulate(coloured, count, seed=0).states[..., -1]
    assert (deviation[0] == 0).all()  # at rest before
    last, after = deviation[-2], deviation[-1]
    sd, z = 0.1, 5 / math.sqrt(count)
    growth = math.sqrt(1 - share ** (2 * (rows - 1)))
    assert abs(after.std() / (sd * growth) - 1) < z / math.sqrt(2)
    assert abs((last * after).mean() / (last * last).mean() - share) < z * math.sqrt(1 - share**2)
    plain = simulate(coloured, count, seed=0).states[-1, :, -3:-1]
    assert abs(plain.std() / 0.2 - 1) < z / 2  # the other channels' noise stays white and as wide


def test_coloured_noise_of_two_axes_starts_where_a_drive_is_known_to() -> None:
    program = short("hovercraft").with_effect("coloured_noise:translation", 0.5).with_effect("coloured_noise:yaw", 0.5)
    probe(program)
    assert len(set(program.state_names)) == 6 + 2 * 3
    table = simulate(example("hovercraft"), 2, seed=0)
    data = for_program(program, table)
    assert (data.known_start[:, 6:] == 0).all()
    density = log_likelihood(program, data, particles=50, known_start=True)
    assert torch.isfinite(density).all()


# --- a program with effects is a program ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "effects"),
    [
        ("hovercraft", ("linear_drag", "slope", "landmark_bias:2")),
        ("hovercraft", ("actuator_lag", "actuator_delay", "speed_dependent_gain")),
        ("hovercraft", ("coloured_noise:yaw", "lever_arm", "clock_offset")),
        ("hovercraft", ("lever_arm", "coloured_noise:translation", "heavy_tails")),
        ("truck", ("curvature_steering", "command_noise", "range_dependent_noise")),
        ("pendulum", ("coulomb_friction", "cubic_stiffness", "coloured_noise")),
    ],
)
def test_step_after_step_is_the_same_as_all_steps_at_once(name: str, effects: tuple[str, ...]) -> None:
    program = example(name)
    for effect in effects:
        program = program.with_effect(effect)
    data = drives(program, 3, 8, gaps=True)
    noise = {site: value[0] for site, value in true_paths(program, data).noise.items()}
    states = torch.where(data.rows[..., None], data.states, data.states[:1])
    acting = acting_controls(program, data)[:-1]

    def move(rows: slice) -> tuple[torch.Tensor, torch.Tensor]:
        recording = Recording()
        with recording, Replaying({site: value[rows] for site, value in noise.items()}):
            after = sample_row(program, states[:-1][rows], acting[rows], data.elapsed[:-1][rows], data.steps[rows])
        return after, sum(recording.distributions[site].log_prob(value[rows]) for site, value in noise.items())

    together, density = move(slice(None))
    one_by_one = [move(slice(row, row + 1)) for row in range(len(data.steps))]
    close = {"rtol": 1e-12, "atol": 1e-12}
    torch.testing.assert_close(torch.cat([after for after, _ in one_by_one]), together, **close)
    torch.testing.assert_close(torch.cat([part for _, part in one_by_one]), density, **close)
    torch.testing.assert_close(together[data.transitions], states[1:][data.transitions], rtol=1e-9, atol=1e-9)


def test_the_prior_of_a_coefficient_counts_in_the_joint_density() -> None:
    program = short("hovercraft")
    data = drives(program, 2, 6)

    def density(value: float) -> torch.Tensor:
        with_it = program.with_effect("weathervane", value)
        trace = pyro.poutine.trace(pyro.poutine.condition(Joint(with_it), {"states": data.states})).get_trace(data)
        (prior,) = [site["fn"].log_factor for name, site in trace.nodes.items() if name.startswith("prior")]
        return prior.detach()

    expected = torch.distributions.Cauchy(0.0, 1.0).log_prob(torch.tensor([0.0, 0.7]))
    torch.testing.assert_close(torch.stack([density(0.0), density(0.7)]), expected.double())


def test_a_class_lists_its_effects(tmp_path: Path) -> None:
    text = (MODELS / "hovercraft.py").read_text()
    text += '\n\nclass Dragged(Hovercraft):\n    effects = ("linear_drag=0.1", "slope=0.05,-0.03", "landmark_bias:2")\n'
    (tmp_path / "boats.py").write_text(text)
    program = load_program(f"{tmp_path / 'boats.py'}:Dragged")
    assert [variant.name for variant in attached(program)] == ["linear_drag", "slope", "landmark_bias:bearing_2"]
    assert program.linear_drag.item() == pytest.approx(0.1)
    torch.testing.assert_close(program.slope.detach(), torch.tensor([0.05, -0.03]))
    probe(program)


@pytest.mark.parametrize(
    ("effect", "rate"), [("actuator_delay:turn", 0.2), ("lever_arm", 0.1), ("measurement_noise", 1.0)]
)
def test_a_coefficient_moves_in_steps_of_its_typical_size(effect: str, rate: float) -> None:
    program = example("truck").with_effect(effect, 0.5)
    data = simulate(program, seed=0, trajectories=1).without_truth(keep_start=True)
    coefficient = getattr(program, f"{effect.replace(':', '_')}_unconstrained")
    before = coefficient.detach().clone()
    settings = {"guide": "gaussian", "steps": 1, "learning_rate": 0.01, "averaging": 0.0}
    recipe.fit(program, data, known_start=True, progress=False, **settings)
    assert float((coefficient.detach() - before).abs()) == pytest.approx(0.01 * rate, rel=0.01)  # Adam's first step


def test_the_program_itself_is_left_alone() -> None:
    program = example("hovercraft")
    more = program.with_effect("linear_drag", 0.3)
    assert not attached(program) and not hasattr(program, "linear_drag") and not program.priors
    more.mass = torch.tensor(9.0)
    assert program.mass.item() == pytest.approx(1.5)


@pytest.mark.parametrize("moved", [False, True])
def test_a_run_remembers_the_effects_that_were_added(tmp_path: Path, moved: bool) -> None:
    (tmp_path / "hovercraft.py").write_text((MODELS / "hovercraft.py").read_text())
    program = load_program(tmp_path / "hovercraft.py")
    for effect, value in (("linear_drag", 0.3), ("thrust_saturation:knee=0.7", 0.2), ("landmark_bias:1", -0.1)):
        program = program.with_effect(effect, value)
    Fit(program, "hand").save(tmp_path / "run")
    again = Fit.load(tmp_path / "run", tmp_path / "hovercraft.py" if moved else None).program
    assert record(again) == ["linear_drag", "thrust_saturation:knee=0.7", "landmark_bias:bearing_1"]
    assert [again.linear_drag.item(), again.landmark_bias_bearing_1.item()] == pytest.approx([0.3, -0.1])
    assert again.priors.keys() == program.priors.keys()
    a, b = (simulate(each, 2, seed=4).measurements for each in (program, again))
    assert torch.equal(a, b)
    assert steady("evaluate", tmp_path / "run", written_table(tmp_path), "--particles", 20, "--rollouts", 2) == 0


def written_table(folder: Path) -> Path:
    table = folder / "t.csv"
    assert steady("simulate", MODELS / "hovercraft.py", "--trajectories", 2, "--out", table) == 0
    return table


# --- names ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("linear_drag", ("linear_drag", "", {}, None)),
        ("linear_drag=0.1", ("linear_drag", "", {}, (0.1,))),
        ("slope=0.05,-0.03", ("slope", "", {}, (0.05, -0.03))),
        ("gain_error:turn", ("gain_error", "turn", {}, None)),
        ("gain_error:turn=-1e-2", ("gain_error", "turn", {}, (-0.01,))),
        ("landmark_bias:2", ("landmark_bias", "2", {}, None)),
        ("landmark_bias:2=0.1", ("landmark_bias", "2", {}, (0.1,))),
        ("thrust_saturation:knee=0.6", ("thrust_saturation", "", {"knee": 0.6}, None)),
        ("thrust_saturation:knee=0.6=0.45", ("thrust_saturation", "", {"knee": 0.6}, (0.45,))),
        ("thrust_saturation:turn:knee=0.6=0.45", ("thrust_saturation", "turn", {"knee": 0.6}, (0.45,))),
        ("sticky_patch:x=1:y=-2:radius=3=0.5", ("sticky_patch", "", {"x": 1.0, "y": -2.0, "radius": 3.0}, (0.5,))),
    ],
)
def test_names_are_read(text: str, read) -> None:
    assert parsed(text) == read


@pytest.mark.parametrize(
    ("program", "text", "says"),
    [
        ("hovercraft", "liner_drag", "did you mean linear_drag?"),
        ("hovercraft", "zzz", "there are acceleration_bias, "),
        ("hovercraft", "stiffness", "does not apply to Hovercraft: no channel has a position"),
        ("truck", "slope", "does not apply to Truck: the program holds the lateral velocity at zero"),
        ("truck", "gain_error:left", "no place 'left': it can be at speed, turn"),
        ("hovercraft", "landmark_bias:4", "it can be at bearing_0, "),
        ("hovercraft", "linear_drag:yaw", "no place 'yaw': there is one only"),
        ("hovercraft", "thrust_saturation:x=3:knee=0.6", "no option x: it has knee"),
        ("hovercraft", "slope=1", "effect slope takes 2 numbers (x, y), got 1"),
        ("hovercraft", "linear_drag=1,2", "effect linear_drag takes one number, got 2"),
        ("hovercraft", "linear_drag=", "expected NAME or NAME=NUMBER"),
        ("hovercraft", "linear_drag=much", "expected NAME or NAME=NUMBER"),
        ("hovercraft", "thrust_saturation:knee=", "expected NAME or NAME=NUMBER"),
        ("hovercraft", "thrust_saturation:knee=0.5,0.6:x=1", "expected NAME or NAME=NUMBER"),
        ("truck", "gain_error:turn:speed", "it is at turn or at speed"),
        ("hovercraft", "linear_drag=nan", "finite numbers, got nan"),
        ("hovercraft", "linear_drag=inf", "finite numbers, got inf"),
        ("hovercraft", "process_noise=-1", "a positive number, got -1.0"),
        ("hovercraft", "acceleration_limit=0", "a positive number, got 0.0"),
        ("hovercraft", "heavy_tails=-1", "a number between 0 and 0.49, got -1"),
        ("hovercraft", "coloured_noise=2", "a number between -0.99 and 0.99, got 2"),
        ("truck", "actuator_lag=-0.1", "a number at least 0, got"),
        ("hovercraft", "sticky_patch:x=nan=0.5", "sticky_patch: x is a finite number, got nan"),
    ],
)
def test_a_wrong_name_or_number_is_explained(program: str, text: str, says: str) -> None:
    model = example(program)

    def add() -> None:
        name, at, options, value = parsed(text)
        model.with_effect(chosen_variant(model, name, at, **options), value)

    with pytest.raises(UsageError) as caught:
        add()
    assert says in str(caught.value)


def test_an_effect_is_added_once() -> None:
    program = example("hovercraft").with_effect("landmark_bias:1")
    program = program.with_effect("landmark_bias:2")  # another landmark is another effect
    with pytest.raises(UsageError, match="has the effect landmark_bias:bearing_2 already"):
        program.with_effect("landmark_bias:2", 0.1)


def test_all_effects_of_the_design_are_there() -> None:
    design = """
        linear_drag quadratic_drag coulomb_friction yaw_linear_drag yaw_quadratic_drag slope wind acceleration_bias
        yaw_bias thrust_asymmetry gain_error speed_dependent_gain thrust_saturation dead_zone actuator_lag
        actuator_delay battery_sag acceleration_limit lateral_coupling weathervane magnus lever_arm side_slip
        curvature_steering sticky_patch stiffness cubic_stiffness bearing_bias landmark_bias sensor_scale clock_offset
        heavy_tails range_dependent_noise process_noise command_noise coloured_noise
    """
    assert set(design.split()) <= {effect.name for effect in catalogue()}
    for name in PROGRAMS:
        program = example(name)
        applies = {effect.name for effect in catalogue(program)}
        assert applies | not_applicable(program).keys() == {effect.name for effect in catalogue()}


def test_the_page_of_the_catalogue_is_up_to_date() -> None:
    """`steady effects > docs/effects.md` brings it up to date."""
    assert (MODELS.parent / "docs" / "effects.md").read_text() == page()
    truck = page(example("truck"))
    assert "- `slope`: the program holds the lateral velocity at zero" in truck
    assert "| `landmark_bias` | bearing_0, bearing_1, bearing_2, bearing_3 |" in truck


def test_coefficients_have_the_units_of_what_they_act_on() -> None:
    units = {
        ("pendulum", "coulomb_friction"): "rad/s²",
        ("pendulum", "cubic_stiffness"): "1/(rad² s²)",
        ("pendulum", "quadratic_drag"): "1/rad",
        ("pendulum", "stiffness"): "1/s²",
        ("pendulum", "sensor_bias"): "rad",
        ("pendulum", "dead_zone"): "N m",
        ("hovercraft", "coulomb_friction"): "m/s²",
        ("hovercraft", "yaw_quadratic_drag"): "1/rad",
        ("hovercraft", "dead_zone"): "N",
        ("truck", "dead_zone:turn"): "rad/s",
    }
    for (program, effect), unit in units.items():
        assert chosen_variant(short(program), effect).unit == unit, (program, effect)


def test_probes_go_with_the_size_of_the_commands() -> None:
    """Pulse widths of a thousand and more, not newtons."""
    program = short("hovercraft")
    data = drives(program, 2, 6)
    large = replace(data, controls=1000 * data.controls)
    (small,), (great,) = (find("dead_zone", program).variants(program, table) for table in (data, large))
    assert small.probes == [small.scale * probe for probe in (0.05, 0.15, 0.3)]
    assert 500 <= great.scale / small.scale <= 2000
    assert great.scale <= float(large.controls.abs().max()) < 2 * great.scale


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"typical": 0.0}, "none would feel it"),
        ({"typical": (0.1, 0.1)}, "2 typical numbers for 1 components"),
        ({"typical": (0.1, 0.1), "components": ("east", "north"), "sign": 1}, "has no sign"),
        ({"limit": 0.0}, "a magnitude above zero"),
    ],
)
def test_a_wrong_declaration_is_explained(wrong: dict, says: str) -> None:
    right = {"typical": 0.1, "limit": 1.0}
    with pytest.raises(UsageError, match=says):
        Effect("mine", "push", "a = c", "a = c", "1", "pulls", lambda self, c: {}, **{**right, **wrong})


def test_listed_effects_come_after_the_whole_of_init() -> None:
    class Mixin:
        def __init__(self) -> None:
            super().__init__()
            self.linear_drag = pyro.nn.PyroParam(torch.tensor(5.0))

    class Dragged(Mixin, type(example("hovercraft"))):
        effects = ("linear_drag=0.1",)

    program = Dragged()
    assert program.linear_drag.item() == 5.0 and program.linear_drag_effect.item() == pytest.approx(0.1)


def test_an_init_that_fails_is_heard() -> None:
    class Broken(type(example("hovercraft"))):
        effects = ("linear_drag=0.1",)

        def __init__(self) -> None:
            super().__init__()
            raise RuntimeError("mine")

    with pytest.raises(RuntimeError, match="mine"):
        Broken()
