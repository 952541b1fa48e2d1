"""What an effect declares: units of its coefficients, where it is probed, and what no declaration can be."""

from __future__ import annotations

import pytest
from examples import short

from steady_ppl import UsageError
from steady_ppl.effects import Effect, chosen_variant


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


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"typical": 0.0}, "must be finite and not zero, got 0.0"),
        ({"typical": (0.1, 0.1)}, "2 typical numbers for 1 components"),
        ({"typical": (0.1, 0.1), "components": ("east", "north"), "sign": 1}, "has no sign"),
        ({"limit": 0.0}, "a magnitude above zero"),
    ],
)
def test_a_wrong_declaration_is_explained(wrong: dict, says: str) -> None:
    right = {"typical": 0.1, "limit": 1.0}
    with pytest.raises(UsageError, match=says):
        Effect("mine", "push", "a = c", "a = c", "1", "pulls", lambda self, c: {}, **{**right, **wrong})
