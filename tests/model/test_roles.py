"""What the controls of a program are: by their names, by `roles`, and what cannot be."""

from __future__ import annotations

from typing import Any

import pytest
from examples import example

from steady_ppl import Program, ProgramError
from steady_ppl.model.roles import ROLES, controls_of
from steady_ppl.model.validate import probe


def driven(*controls: str, roles: Any = None) -> Program:
    """A car with other controls; it is never driven."""
    program = example("car")
    program.controls = controls
    if roles is not None:
        program.roles = roles
    return program


def test_a_control_that_is_called_as_a_role_has_it() -> None:
    assert controls_of(example("car"), "speed", "steering", "turn") == ("speed", "steering")
    assert controls_of(example("hovercraft"), "right", "left") == ("right", "left")
    assert controls_of(driven(), *ROLES) == ()
    assert controls_of(driven(*ROLES), *ROLES) == tuple(ROLES)  # without a unit
    assert controls_of(driven("speed [km/h]", "left [1]"), "speed", "left") == ("left",)


def test_other_names_have_the_role_that_is_declared() -> None:
    program = driven("u1 [m/s]", "delta [rad]", roles={"delta": "steering", "u1": "speed"})
    assert controls_of(program, "speed", "steering") == ("u1", "delta")


def test_what_is_declared_goes_before_a_name() -> None:
    program = driven("speed [rpm]", "v [m/s]", "left [1]", roles={"v": "speed", "left": "torque"})
    assert controls_of(program, "speed", "torque", "left") == ("v", "left")


@pytest.mark.parametrize(
    ("controls", "roles", "says"),
    [
        (("delta [rad]",), {"delta": "steer"}, "control delta has the role 'steer'; there are speed, turn, steering"),
        (("delta [rad]",), {"delta": 3}, "control delta has the role 3; there are speed"),
        (("delta [rad]",), {"detla": "steering"}, "roles names 'detla', no control (delta)"),
        (
            ("delta [deg]",),
            {"delta": "steering"},
            "control delta has the role steering and is in deg; a steering angle is in rad: convert the column",
        ),
        (("delta",), {"delta": "steering"}, 'has no unit; a steering angle is in rad: declare "delta [rad]"'),
        (("a [N]", "b [N]"), {"a": "left", "b": "left"}, "two controls have the role left: a, b"),
        (("a [N]",), ("left",), "roles is ('left',); expected control → role"),
        (("a [N]",), "left", "roles is 'left'; expected control → role"),
    ],
)
def test_a_wrong_declaration_is_named_in_one_line(controls: tuple[str, ...], roles: Any, says: str) -> None:
    for read in (lambda program: controls_of(program, "speed"), probe):
        with pytest.raises(ProgramError) as caught:
            read(driven(*controls, roles=roles))
        assert says in str(caught.value) and str(caught.value).startswith("model Car: ")
        assert "\n" not in str(caught.value)
