"""Groups of worlds that move in continuous time, each with the program that a user would write and effects to plant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from continuous_drives import World
from continuous_effects import Planted
from continuous_programs import CartProgram, PendulumProgram, TwoWheelProgram, UnicycleProgram
from continuous_wheels import Car, TwoWheels
from continuous_worlds import Boat, Cart, Hovercraft, Pendulum, Unicycle

from steady_ppl import Program, load_program
from steady_ppl.effects import chosen_variant

MODELS = Path(__file__).parents[1] / "models"
WIND_DRAG = 0.06  # 1/m: wind acts through a drag that world and program both have
ROUGH = (0.2, 0.2, 0.1)


@dataclass(frozen=True)
class Group:
    """Sets of one kind.

    Attributes:
        name: on the command line and in the records.
        world: without effects.
        program: makes the user's program.
        known_start: whether `discover` is given the first states.
        effects: that `planted` plants.
    """

    name: str
    world: World
    program: Callable[[], Program]
    known_start: bool = False
    effects: tuple[str, ...] = ()


def _hovercraft() -> Program:
    return load_program(MODELS / "hovercraft.py")


def _boat() -> Program:
    return load_program(MODELS / "gps_boat.py:GpsBoat")


def _car() -> Program:
    return load_program(MODELS / "car.py")


ON_HOVERCRAFT = (
    *("linear_drag", "quadratic_drag", "coulomb_friction", "yaw_linear_drag", "yaw_quadratic_drag", "yaw_bias"),
    *("side_slip", "magnus", "weathervane", "lateral_coupling", "slope", "wind"),
    *("thrust_asymmetry", "actuator_delay", "actuator_lag", "bearing_bias", "clock_offset"),
)
ON_BOAT = ("yaw_linear_drag", "quadratic_drag", "side_slip")
ON_HULL = ("cross_flow", "added_mass", "caster")
ON_CAR = ("steering_asymmetry", "backlash", "slope")
ON_TWO_WHEELS = ("wheel_radius_difference", "track_width", "gain_error:wheels")
ON_LINE = (
    *("quadratic_drag", "coulomb_friction", "stiffness", "cubic_stiffness", "acceleration_bias"),
    *("actuator_delay", "actuator_lag", "clock_offset"),
)
ON_WHEELS = (  # no crab angle: where wheels hold the speed it is a bias of the heading
    *("lever_arm", "slip_angle", "steering_offset", "understeer", "clock_offset"),
)
PAPER = Hovercraft()
SMOOTH = {thrust: Hovercraft(driven="smooth", thrust=float(thrust)) for thrust in (1, 2, 3)}


def _groups() -> dict[str, Group]:
    """Return all groups by name; those whose names begin with "rough" are run only where `--only` names them."""
    found = []
    for start in ("known", "unknown"):
        known = start == "known"
        planted = ON_HOVERCRAFT if known else ()
        found.append(Group(f"hovercraft paper x1 {start}", PAPER, _hovercraft, known, planted))
        for thrust, world in SMOOTH.items():
            effects = planted if thrust == 1 else ()
            found.append(Group(f"hovercraft smooth x{thrust} {start}", world, _hovercraft, known, effects))
    found += [
        Group("unicycle", Unicycle(), UnicycleProgram, effects=ON_WHEELS),
        Group("boat", Boat(), _boat, effects=ON_BOAT),
        Group("hull", Boat(), _boat, effects=ON_HULL),
        Group("car", Car(), _car, effects=ON_CAR),
        Group("two wheels", TwoWheels(), TwoWheelProgram, effects=ON_TWO_WHEELS),
        Group("pendulum", Pendulum(), PendulumProgram, effects=ON_LINE),
        Group("cart", Cart(), CartProgram, effects=ON_LINE),
    ]
    hovercraft = [one for one in found if isinstance(one.world, Hovercraft)]
    rough = [
        Group(f"rough {one.name}", replace(one.world, noise=ROUGH), one.program, one.known_start) for one in hovercraft
    ]
    return {one.name: one for one in [*found, *rough]}


GROUPS = _groups()


def chosen_groups(only: Sequence[str] | None) -> list[Group]:
    """Return the groups whose names begin with one of `only`; all but the rough ones when None.

    Raises:
        SystemExit: a name fits no group.
    """
    if not only:
        return [one for name, one in GROUPS.items() if not name.startswith("rough")]
    strange = [text for text in only if not any(name.startswith(text) for name in GROUPS)]
    if strange:
        raise SystemExit(f"no group begins with {', '.join(strange)}; there are {', '.join(GROUPS)}")
    return [one for name, one in GROUPS.items() if name.startswith(tuple(only))]


def user_program(group: Group, effect: str = "") -> Program:
    """Return the program that a user would write; with the drag that the world has where wind is planted."""
    program = group.program()
    for known in both_have(effect):
        program = program.with_effect(chosen_variant(program, known.name), known.size)
    return program


def both_have(effect: str) -> tuple[Planted, ...]:
    """Return what world and program both have beside a planted effect."""
    return (Planted("quadratic_drag", (WIND_DRAG,)),) if effect == "wind" else ()
