"""What the controls of a program are: a speed, a steering angle, a thrust. Effects ask for these roles."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from steady_ppl.errors import ProgramError
from steady_ppl.model.program import Program, names, units


class Role(NamedTuple):
    """What a control can be."""

    text: str
    unit: str = ""  # that a control declared so must have; any where empty


ROLES: Mapping[str, Role] = {
    "speed": Role("a speed", "m/s"),
    "turn": Role("a turn rate", "rad/s"),
    "steering": Role("a steering angle", "rad"),
    "rudder": Role("a rudder angle", "rad"),
    "thrust": Role("a thrust"),
    "left": Role("a left thrust"),
    "right": Role("a right thrust"),
    "left_wheel": Role("a left wheel's speed", "m/s"),
    "right_wheel": Role("a right wheel's speed", "m/s"),
    "propeller": Role("a propeller's speed"),
    "torque": Role("a torque"),
    "force": Role("a force"),
}


def controls_of(program: Program, *roles: str) -> tuple[str, ...]:
    """Return the names of the controls that have some roles, in the order of the roles, without those that none has.

    A program declares `roles = {"delta": "steering"}`. A control that is called as a role has it by its name, unless
    another one is declared to have it or its unit is another.

    Raises:
        ProgramError: `roles` is wrong; see `wrong_roles`.
    """
    for problem in wrong_roles(program):
        raise ProgramError(f"model {type(program).__name__}{problem}", site="roles")
    unit_of = dict(zip(program.control_names, program.control_units, strict=True))
    found = {name: name for name in unit_of if name not in program.roles and _fits(name, unit_of[name])}
    found |= {role: name for name, role in program.roles.items()}
    return tuple(found[role] for role in roles if role in found)


def _fits(role: str, unit: str) -> bool:
    """Whether a control with a unit, or none, can have a role by its name."""
    return role in ROLES and (not unit or ROLES[role].unit in ("", unit))


def wrong_roles(program: Program) -> Iterator[str]:
    """Yield what is wrong with the `roles` of a program: names, roles, units, a role that two controls have."""
    roles = program.roles
    if not isinstance(roles, Mapping):
        yield f': roles is {roles!r}; expected control → role, as {{"delta": "steering"}}'
        return
    unit_of = dict(zip(names(program.controls), units(program.controls), strict=True))
    for name, role in roles.items():
        if name not in unit_of:
            yield f": roles names {name!r}, no control ({', '.join(unit_of)})"
        elif not isinstance(role, str) or role not in ROLES:
            yield f": control {name} has the role {role!r}; there are {', '.join(ROLES)}"
        elif ROLES[role].unit not in ("", unit_of[name]):
            text, unit = ROLES[role]
            said, how = f"is in {unit_of[name]}", "convert the column"
            if not unit_of[name]:
                said, how = "has no unit", f'declare "{name} [{unit}]"'
            yield f": control {name} has the role {role} and {said}; {text} is in {unit}: {how}"
    chosen = list(roles.values())
    for role in (one for index, one in enumerate(chosen) if one in chosen[:index]):
        yield f": two controls have the role {role}: {', '.join(name for name in roles if roles[name] == role)}"
