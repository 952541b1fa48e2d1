"""What an effect declares: units of its coefficients, where it is probed, and what no declaration can be."""

from __future__ import annotations

from dataclasses import replace

import pytest
from examples import drives, short

from steady_ppl import UsageError
from steady_ppl.effects import Effect, chosen_variant, find


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
