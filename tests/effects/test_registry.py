"""How effects are named, which there are, and their page."""

from __future__ import annotations

import pytest
import torch
from examples import MODELS, example

from steady_ppl import UsageError, simulate
from steady_ppl.effects import catalogue, chosen_variant, not_applicable, parsed
from steady_ppl.effects.registry import page

PROGRAMS = ("hovercraft", "truck", "pendulum")


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
        ("truck", "wind", "does not apply to Truck: the model holds the lateral velocity at zero"),
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


LEFT_THRUST = 'no control is a left thrust: declare one in `roles`, as roles = {"NAME": "left"}'
RIGHT_THRUST = 'no control is a right thrust: declare one in `roles`, as roles = {"NAME": "right"}'
SPEED = 'no control is a speed (m/s): declare one in `roles`, as roles = {"NAME": "speed"}'
TURN = 'no control is a turn rate (rad/s): declare one in `roles`, as roles = {"NAME": "turn"}'
STEERS = "no control is a turn rate (rad/s) or a steering angle (rad): declare one in `roles`, as roles = "
ANGLE = "no control is a turn rate (rad/s), a rudder angle (rad) or a steering angle (rad): declare one in `roles`"
LINKAGE = "no control is a rudder angle (rad) or a steering angle (rad): declare one in `roles`, as roles = "
WHEEL = 'no control is a right wheel\'s speed (m/s): declare one in `roles`, as roles = {"NAME": "right_wheel"}'
ROLLS = "it needs a speed with a turn rate or a steering angle, or the speeds of two wheels: declare what its controls "
HELD = "the model holds the lateral velocity at zero"
PLANAR = "it acts on vehicles in the plane only"


@pytest.mark.parametrize(
    ("name", "controls", "reasons"),
    [
        ("car", ("port [m/s]",), {"wheel_radius_difference": WHEEL, "track_width": WHEEL}),
        ("car", ("right [N]",), {"lateral_coupling": LEFT_THRUST, "thrust_asymmetry": LEFT_THRUST}),
        ("car", ("left [N]",), {"lateral_coupling": RIGHT_THRUST, "thrust_asymmetry": RIGHT_THRUST}),
        ("car", ("left [N]", "right [N]"), {"gain_error": "of two thrusts it is the asymmetry"}),
        (
            "car",
            ("turn [rad/s]",),
            {"curvature_steering": SPEED, "command_noise": SPEED, "response_time": ROLLS},
        ),
        ("car", ("speed [m/s]",), {"curvature_steering": TURN, "command_noise": TURN, "understeer": STEERS}),
        ("car", ("delta [rad]",), {"steering_offset": ANGLE, "steering_asymmetry": ANGLE, "backlash": LINKAGE}),
        ("car", ("steering [deg]",), {"steering_offset": ANGLE}),
        (
            "car",
            (),
            {"reverse_steering": STEERS, "added_mass": HELD, "cross_flow": HELD},
        ),
        ("pendulum", ("speed",), {"slope": PLANAR, "caster": PLANAR, "understeer": PLANAR, "steering_offset": PLANAR}),
    ],
)
def test_what_a_control_is_not_is_said(name: str, controls: tuple[str, ...], reasons: dict[str, str]) -> None:
    program = example(name)
    program.controls = controls
    if "port [m/s]" in controls:
        program.roles = {"port": "left_wheel"}
    refused = not_applicable(program)
    for effect, reason in reasons.items():
        assert reason in refused[effect], effect


def test_the_refusal_goes_when_what_it_asks_for_is_declared() -> None:
    program = example("car")
    program.controls, program.roles = ("v [m/s]", "delta [rad]"), {"v": "speed"}
    assert "backlash" in not_applicable(program)
    program.roles = {"v": "speed", "delta": "steering"}
    assert {"backlash", "steering_offset", "response_time"} <= {effect.name for effect in catalogue(program)}


@pytest.mark.parametrize(
    ("name", "renamed", "roles"),
    [
        ("car", ("u1 [m/s]", "delta [rad]"), {"u1": "speed", "delta": "steering"}),
        ("truck", ("v [m/s]", "w [rad/s]"), {"v": "speed", "w": "turn"}),
        ("hovercraft", ("a [N]", "b [N]"), {"b": "right", "a": "left"}),
    ],
)
def test_other_names_with_their_roles_have_the_same_candidates(name: str, renamed, roles) -> None:
    """The same places, units and numbers; a coefficient at a control is called by the new name."""
    program, other = example(name), example(name)
    other.controls, other.roles = renamed, roles
    new = dict(zip(program.control_names, other.control_names, strict=True))

    def told(variant, rename):
        at = rename.get(variant.at, variant.at)
        controls = tuple(rename.get(one, one) for one in variant.options.get("controls", ()))
        return variant.effect, at, controls, variant.unit

    found = [told(one, new) for effect in catalogue(program) for one in effect.variants(program)]
    assert found == [told(one, {}) for effect in catalogue(other) for one in effect.variants(other)]
    assert not_applicable(program) == not_applicable(other)
    for one in (program, other):
        one.duration = 4 * one.step
    for effect in catalogue(program):
        if effect.form in ("command", "history", "spread") or effect.name == "lateral_coupling":
            states = [simulate(one.with_effect(effect), 2, seed=3, substeps=2).states for one in (program, other)]
            assert torch.equal(*states), effect.name


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


def test_every_effects_docstring_has_all_its_texts() -> None:
    for effect in catalogue():
        texts = (effect.text, effect.equation, effect.feels, effect.occurs)
        assert all(text and text == " ".join(text.split()) for text in texts), effect.name


def test_the_page_of_the_catalogue_is_up_to_date() -> None:
    """`steady effects > docs/effects.md` brings it up to date."""
    assert (MODELS.parent / "docs" / "effects.md").read_text() == page()
    truck = page(example("truck"))
    assert "- `wind`: the model holds the lateral velocity at zero" in truck
    assert "| `landmark_bias` | bearing_0, bearing_1, bearing_2, bearing_3 |" in truck
