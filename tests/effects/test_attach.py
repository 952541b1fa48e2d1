"""A program with effects is a program: its steps, its densities, its runs and its class."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pyro
import pytest
import torch
from examples import MODELS, drives, example, short
from small import steady

from inference import steady as recipe
from steady_ppl import Fit, Joint, UsageError, load_program, simulate
from steady_ppl.effects import attached, chosen_variant, record
from steady_ppl.effects.attach import SD_OF_LOG_FACTOR
from steady_ppl.guides.path_guides import true_paths
from steady_ppl.model.handlers import Recording, Replaying
from steady_ppl.model.substeps import acting_controls, sample_row
from steady_ppl.model.validate import probe


@pytest.mark.parametrize(
    ("name", "effects"),
    [
        ("hovercraft", ("linear_drag", "slope", "landmark_bias:2")),
        ("hovercraft", ("actuator_lag", "actuator_delay", "speed_dependent_gain")),
        ("hovercraft", ("coloured_noise:yaw", "lever_arm", "clock_offset")),
        ("hovercraft", ("lever_arm", "coloured_noise:translation", "heavy_tails")),
        ("truck", ("curvature_steering", "command_noise", "range_dependent_noise")),
        ("pendulum", ("coulomb_friction", "cubic_stiffness", "coloured_noise")),
        ("car", ("backlash", "steering_asymmetry", "slope")),
        ("two_wheels", ("wheel_radius_difference", "track_width", "gain_error:wheels")),
        ("gps_boat", ("added_mass", "cross_flow", "caster")),
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


@pytest.mark.parametrize(
    "effect",
    [
        "linear_drag",
        "actuator_delay",
        "heavy_tails",
        "bearing_bias",
        "lever_arm",
        "process_noise:yaw",
        "coloured_noise:yaw",
    ],
)
def test_its_methods_take_their_arguments_by_name(effect: str) -> None:
    program = example("hovercraft").with_effect(effect)
    state, control = torch.zeros(2, len(program.state_names)).double(), torch.zeros(2, 2).double()
    time, step = torch.zeros(2).double(), torch.full((2,), 0.1).double()
    with pyro.plate("drives", 2):
        assert program.transition(state=state, control=control, time=time, step=step).shape == state.shape
        program.observe(state=state)


def test_an_effect_that_lacks_nothing_may_say_so_in_no_words() -> None:
    program = example("hovercraft")
    effect = replace(chosen_variant(program, "linear_drag").effect, lacks=lambda program: "")
    assert chosen_variant(program, effect).effect is effect and effect.variants(program)


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


def test_a_factor_is_likeliest_at_one_and_as_likely_at_ten_as_at_a_tenth() -> None:
    program = short("hovercraft").with_effect("process_noise:yaw")
    (prior,) = (program.priors[name] for name in program.priors)
    density = prior.log_prob(torch.tensor([0.1, 0.9, 1.0, 1.1, 10.0]))
    assert int(density.argmax()) == 2
    torch.testing.assert_close(density[0], density[4])
    assert density[2] - density[0] == pytest.approx(math.log(10) ** 2 / (2 * SD_OF_LOG_FACTOR**2), abs=1e-5)


def test_a_class_lists_its_effects(tmp_path: Path) -> None:
    text = (MODELS / "hovercraft.py").read_text()
    text += '\n\nclass Dragged(Hovercraft):\n    effects = ("linear_drag=0.1", "slope=0.05,-0.03", "landmark_bias:2")\n'
    (tmp_path / "boats.py").write_text(text)
    program = load_program(f"{tmp_path / 'boats.py'}:Dragged")
    assert [variant.name for variant in attached(program)] == ["linear_drag", "slope", "landmark_bias:bearing_2"]
    assert program.linear_drag.item() == pytest.approx(0.1)
    torch.testing.assert_close(program.slope.detach(), torch.tensor([0.05, -0.03]))
    probe(program)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "rate"),
    [
        pytest.param("actuator_delay:turn", 0.2, marks=pytest.mark.slow),
        ("lever_arm", 0.1),
        ("measurement_noise", 1.0),
    ],
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


@pytest.mark.slow
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


def test_programs_that_begin_at_one_tensor_have_coefficients_of_their_own() -> None:
    begin = torch.tensor(0.1)
    one, other = (example("hovercraft").with_effect("linear_drag", begin) for _ in range(2))
    with torch.no_grad():
        one.linear_drag_unconstrained.fill_(0.5)
    assert other.linear_drag.item() == begin.item() == pytest.approx(0.1)


def test_an_effect_is_added_once() -> None:
    program = example("hovercraft").with_effect("landmark_bias:1")
    program = program.with_effect("landmark_bias:2")  # another landmark is another effect
    with pytest.raises(UsageError, match="has the effect landmark_bias:bearing_2 already"):
        program.with_effect("landmark_bias:2", 0.1)


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


def test_programs_with_the_same_effect_are_of_one_class():
    program = example("hovercraft")
    one = program.with_effect("linear_drag", 0.1)
    (variant,) = attached(one)
    assert type(program.with_effect(variant, 0.3)) is type(program.with_effect("linear_drag", 0.5)) is type(one)
    assert type(one.with_effect("wind")) is not type(one)
    saturated = [type(program.with_effect("thrust_saturation", knee=knee)) for knee in (0.6, 0.5, 0.6)]
    assert saturated[0] is saturated[2] is not saturated[1]


def test_a_class_keeps_its_name_where_a_program_lists_the_same_effect() -> None:
    class Listing(type(example("hovercraft"))):
        def __init__(self, *effects: str) -> None:
            super().__init__()
            self.effects = effects

    listed, added = Listing("linear_drag=0.1"), Listing().with_effect("linear_drag", 0.1)
    assert type(listed).__name__ == "Listing" and type(added).__name__ == "ListingWithLinearDrag"
    assert type(Listing("linear_drag=0.2")) is type(listed)
