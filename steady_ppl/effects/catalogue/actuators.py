"""What lies between the command and the force: gains, knees, delays, wear."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.catalogue.forces import PLANAR, THRUSTS
from steady_ppl.effects.declaration import Choices, Effect, Names, Need, declare, has_role, needs
from steady_ppl.model.actuation import delayed, lagged, row_spans, with_play
from steady_ppl.model.program import Program
from steady_ppl.model.roles import controls_of

CONTROLS: Need = (lambda program: program.controls, "the model has no controls")
SUBSTEPS: Need = (lambda program: program.substeps > 1, "it takes a row in one step (fit with --substeps)")
STEERS = has_role("turn", "rudder", "steering")
LINKAGE = has_role("rudder", "steering")
NO_TWO_THRUSTS: Need = (
    lambda program: len(program.controls) != 2 or len(controls_of(program, "left", "right")) != 2,
    "of two thrusts it is the asymmetry, up to mass and inertia",
)


def _each(program: Program, data: Trajectories | None = None) -> Choices:
    return [{"controls": (name,), "at": name} for name in program.control_names]


def _each_and_wheels(program: Program, data: Trajectories | None) -> Choices:
    """Each alone, and two wheels together, whose common radius may be wrong."""
    wheels = controls_of(program, "left_wheel", "right_wheel")
    return [*_each(program), *([{"controls": wheels, "at": "wheels"}] if len(wheels) == 2 else [])]


def _each_of(*roles: str) -> Callable[[Program, Trajectories | None], Choices]:
    """Each control that has one of some roles, at its name unless there is one only."""

    def choices(program: Program, data: Trajectories | None) -> Choices:
        found = controls_of(program, *roles)
        return [{"controls": (name,), **({"at": name} if len(found) > 1 else {})} for name in found]

    return choices


def _everywhere(program: Program, data: Trajectories | None = None) -> Choices:
    """All controls together and, where their units differ, each alone."""
    return [{"controls": program.control_names}, *(_each(program) if len(set(program.control_units)) > 1 else [])]


def _per_unit(program: Program, data: Trajectories | None) -> Choices:
    """The coefficient has a control's unit: together where they share one, else each alone."""
    together, *alone = _everywhere(program)
    return alone or [together]


def _magnitudes(data: Trajectories, controls: Names) -> Tensor:
    return data.controls[..., [data.control_names.index(name) for name in controls]][data.rows].abs()


def _knees(program: Program, data: Trajectories | None) -> Choices:
    choices = []
    for group in _per_unit(program, data):
        knees = [0.6]
        if data is not None:
            sizes = _magnitudes(data, group["controls"]).double().flatten()
            sizes = sizes[sizes > 0.02 * sizes.max()]
            knees = sizes.quantile(sizes.new_tensor([0.4, 0.6, 0.75, 0.88])).tolist() if len(sizes) else knees
        choices += [{**group, "knee": float(f"{knee:.3g}")} for knee in knees]
    return choices


ACTUATORS: list[Effect] = []
_on_commands = partial(declare, ACTUATORS, "history")
_on_controls = partial(_on_commands, lacks=needs(CONTROLS))
_on_time = partial(_on_controls, limit=2.0, sign=1, between=(0.0, math.inf), choices=_everywhere)


@_on_commands("1", typical=0.05, limit=0.5, lacks=needs(*THRUSTS))
def thrust_asymmetry(self: Program, control: Tensor, time: Tensor, c: Tensor) -> Tensor:
    r"""right → (1 + c) right

    equation: u_\mathrm{right} \to (1 + c)\,u_\mathrm{right}
    feels: pulls to one side, the more the harder it is driven
    occurs: a chipped propeller, a tyre with less air, one motor of another batch
    """
    return control * (1 + c * self.chosen_controls(controls_of(self, "right"), control))


@_on_commands("1", typical=0.08, limit=1.0, choices=_each_and_wheels, lacks=needs(NO_TWO_THRUSTS, CONTROLS))
def gain_error(self: Program, control: Tensor, time: Tensor, c: Tensor, controls: Names) -> Tensor:
    r"""u → (1 + c) u of one control, or of two wheels

    equation: u \to (1 + c)\,u
    feels: does more (or less) than commanded
    occurs: a motor constant taken from the data sheet, a gear ratio or a wheel radius that is off
    """
    return control * (1 + c * self.chosen_controls(controls, control))


@_on_commands("1", typical=0.08, limit=1.0, choices=_each_of("turn", "steering", "rudder"), lacks=needs(STEERS))
def steering_asymmetry(self: Program, control: Tensor, time: Tensor, c: Tensor, controls: Names) -> Tensor:
    r"""u → u + c |u| of what steers

    equation: u \to u + c\,|u|
    feels: turns tighter to one side than to the other
    occurs: a servo whose horn is not square to its rod, linkages (Ackermann steering), a propeller beside the rudder
    """
    return control + c * self.chosen_controls(controls, control) * control.abs()


@declare(ACTUATORS, "command", "s/m", typical=0.1, limit=1.0, lacks=needs(PLANAR))
def speed_dependent_gain(self: Program, state: Tensor, control: Tensor, time: Tensor, c: Tensor) -> Tensor:
    r"""u → (1 - c |v|) u

    equation: u \to (1 - c\,|v|)\,u
    feels: propellers pull less the faster it goes
    occurs: propellers, whose thrust falls with the speed of advance; motors near the speed of no load
    """
    forward, lateral, _ = self.body_velocity(state)
    speed = (forward**2 + lateral**2).clamp(min=1e-30).sqrt()  # which has a slope at rest
    return control * (1 - c * speed).unsqueeze(-1)


@_on_controls("1", typical=0.45, limit=1.0, sign=1, profiled=("knee",), choices=_knees)
def thrust_saturation(self: Program, control: Tensor, *_: Tensor, c: Tensor, controls: Names, knee: Any) -> Tensor:
    r"""u → u - c sign(u) max(|u| - knee, 0)

    equation: u \to u - c\,\mathrm{sign}(u)\max(|u| - u_0, 0)
    feels: full commands give little more than half ones
    occurs: motors at their current limit, ventilating propellers, valves that are fully open
    """
    beyond = control.sign() * (control.abs() - knee).relu()
    return control - c * self.chosen_controls(controls, control) * beyond


@_on_controls("of the control", typical=0.2, limit=1.0, sign=1, probes=(0.05, 0.15, 0.3), choices=_per_unit)
def dead_zone(self: Program, control: Tensor, time: Tensor, c: Tensor, controls: Names) -> Tensor:
    r"""u → sign(u) max(|u| - c, 0)

    equation: u \to \mathrm{sign}(u)\max(|u| - c, 0)
    feels: small commands do nothing
    occurs: static friction in motors, gear play, valves with overlap, drivers that ignore small duty cycles
    """
    lost = torch.minimum(torch.maximum(control, -c), c)
    return control - self.chosen_controls(controls, control) * lost


@_on_commands(
    "of the control",
    typical=0.1,
    limit=1.0,
    sign=1,
    between=(0.0, math.inf),
    probes=(0.03, 0.1, 0.25),
    choices=_each_of("steering", "rudder"),
    lacks=needs(LINKAGE),
)
def backlash(self: Program, control: Tensor, time: Tensor, c: Tensor, controls: Names) -> Tensor:
    r"""u_acting stays while |u - u_acting| < c, and else follows at that distance; a trajectory begins in the middle

    equation: u_\mathrm{acting} \to \max(u - c, \min(u + c, u_\mathrm{acting}))
    feels: does nothing at first when it is steered the other way
    occurs: worn steering gears and tie rods, geared servos, rudder chains
    """
    return control + self.chosen_controls(controls, control) * (with_play(control, c) - control)


@_on_time("s", typical=0.25, probes=(0.1, 0.3, 0.6))
def actuator_lag(self: Program, control: Tensor, time: Tensor, c: Tensor, controls: Names) -> Tensor:
    r"""du_acting/dt = (u - u_acting) / c

    equation: \dot u_\mathrm{acting} = (u - u_\mathrm{acting}) / c
    feels: follows a command slowly, up and down
    occurs: rotors that spin up, hydraulic cylinders, heating elements, a low pass in the driver
    """
    return control + self.chosen_controls(controls, control) * (lagged(control, time, c) - control)


@_on_time("s", typical=0.2, probes=(0.1, 0.2, 0.4))
def actuator_delay(self: Program, control: Tensor, time: Tensor, c: Tensor, controls: Names) -> Tensor:
    r"""u_acting(t) = u(t - c)

    equation: u_\mathrm{acting}(t) = u(t - c)
    feels: follows every command, later
    occurs: radio links, buses and computers between command and motor
    """
    return control + self.chosen_controls(controls, control) * (delayed(control, time, c) - control)


@declare(ACTUATORS, "between", "1", typical=0.5, limit=1.0, sign=1, lacks=needs(CONTROLS, SUBSTEPS))
def first_order_hold(self: Program, control: Tensor, time: Tensor, c: Tensor) -> Tensor:
    r"""u → u + c (t - t_mid) du/dt within a row, from the rows beside it

    equation: u(t) = u_k + c\,(t - t_{k + 1/2})\,\frac{u_{k+1} - u_{k-1}}{t_{k + 3/2} - t_{k - 1/2}}
    feels: is pushed by what changes all the time, where the table has a mean for each row
    occurs: rows that are means of a faster controller, forces and torques that are measured
    """
    spans, count = row_spans(time), self.substeps
    middle, rise = time + 0.5 * spans, torch.zeros_like(control)
    apart = (middle[2:] - middle[:-2]).clamp(min=torch.finfo(time.dtype).tiny)
    rise[1:-1] = (control[2:] - control[:-2]) * (spans[1:-1] / apart).unsqueeze(-1)
    share = (torch.arange(count, dtype=time.dtype, device=time.device) + 0.5) / count - 0.5
    return (control.unsqueeze(1) + c * share[:, None, None] * rise.unsqueeze(1)).flatten(0, 1)


@_on_controls("1", typical=0.25, limit=1.0, sign=1)
def battery_sag(self: Program, control: Tensor, time: Tensor, c: Tensor) -> Tensor:
    r"""u → (1 - c t/T) u, T the model's duration

    equation: u \to (1 - c\,t / T)\,u
    feels: weaker towards the end of every trajectory
    occurs: small vehicles on one battery without a voltage regulator
    """
    return control * (1 - c * time / self.duration).unsqueeze(-1)
