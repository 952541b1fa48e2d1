"""Vehicles on wheels: commanded by a speed and a turn rate or a steering angle, or by the speeds of two wheels."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.catalogue.forces import PLANAR, three_digits
from steady_ppl.effects.declaration import Choices, Effect, Means, Names, Need, Pushes, declare, has_role, needs
from steady_ppl.effects.sizes import speed_of
from steady_ppl.model.program import Program
from steady_ppl.model.roles import controls_of

SPEED_AND_TURN = (has_role("speed"), has_role("turn"))
STEERS = has_role("turn", "steering")
TWO_WHEELS = (has_role("left_wheel"), has_role("right_wheel"))
ROLLS: Need = (
    lambda program: (controls_of(program, "speed") and _steering(program)) or len(_wheels(program)) == 2,
    "it needs a speed with a turn rate or a steering angle, or the speeds of two wheels: declare what its controls are "
    'in `roles`, as roles = {"NAME": "speed"}',
)
STEERING_ANGLE: Need = (lambda program: _angles(program, None), has_role("turn", "rudder", "steering")[1])
GRIP: Need = (lambda program: not program.slips, "the lateral velocity is free")


def _steering(program: Program) -> tuple[str, ...]:
    """The control that steers, if there is one."""
    return controls_of(program, "turn", "steering")[:1]


def _wheels(program: Program) -> tuple[str, ...]:
    return controls_of(program, "left_wheel", "right_wheel")


def _angles(program: Program, data: Trajectories | None) -> Choices:
    """Each control that is an angle of front wheels or a rudder, rad."""
    unit_of = dict(zip(program.control_names, program.control_units, strict=True))
    angles = [name for name in controls_of(program, "steering", "rudder") if unit_of[name] == "rad"]
    return [{"controls": (name,), **({"at": name} if len(angles) > 1 else {})} for name in angles]


def _each_channel(program: Program, data: Trajectories | None) -> Choices:
    return [{"channels": (name,), "at": name} for name in program.channel_names]


def _slow(speed: float) -> Callable[[Program, Trajectories | None], Choices]:
    """A speed, m/s where nothing is known of a vehicle's, and else such a share of it."""

    def choices(program: Program, data: Trajectories | None) -> Choices:
        usual = speed_of(program, data, ("forward",))
        return [{"knee": three_digits(speed * (usual if usual > 0 else 1.0))}]

    return choices


WHEELS: list[Effect] = []
_on_command = partial(declare, WHEELS, "command", lacks=needs(PLANAR, *SPEED_AND_TURN))
_on_steering = partial(declare, WHEELS, "command", lacks=needs(PLANAR, STEERS))
_on_lateral_velocity = partial(declare, WHEELS, "push", lacks=needs(PLANAR, GRIP))
_on_two_wheels = partial(declare, WHEELS, "history", lacks=needs(*TWO_WHEELS))


@declare(
    WHEELS,
    "push",
    "s",
    typical=0.2,
    limit=2.0,
    sign=1,
    between=(0.0, math.inf),
    probes=(0.05, 0.15, 0.4),
    choices=_each_channel,
    lacks=needs(PLANAR, ROLLS, GRIP),
)
def response_time(
    self: Program, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, channels: Names, mean: Means
) -> Pushes:
    r"""dv/dt = (v_told - v) / (c + τ), τ what the model has (its step where it says nothing)

    equation: \dot v = (v_\mathrm{told} - v) / (c + \tau)
    feels: reaches its command, or returns to it when pushed off, little by little
    occurs: speed controllers with little gain, hydraulic steering, heavy wheels
    """
    slower, carried = c / (c + self.settles_in(step)), self.carried(state)
    return {channel: (carried[channel] - mean[channel]) * slower for channel in channels}


@_on_command("1", typical=0.5, limit=2.0, profiled=("knee",), by_factor=("knee",), choices=_slow(0.05))
def curvature_steering(self: Program, state: Tensor, control: Tensor, time: Tensor, c: Tensor, knee: Any) -> Tensor:
    r"""turn → (1 - c) turn + c (turn / speed) v, none below a speed of knee

    equation: u_\mathrm{turn} \to (1 - c)\,u_\mathrm{turn} + c\,u_\mathrm{turn}\,v / u_\mathrm{speed}
    feels: steers a curve, not a turn rate: turns slower while it is slower than commanded
    occurs: cars and trucks: the command is a steering angle, which fixes a curve and not a turn rate
    """
    speed, turn = (control[..., self.control_index(name)] for name in controls_of(self, "speed", "turn"))
    forward, _, _ = self.body_velocity(state)
    asked = turn * speed * forward / (speed**2 + knee**2)
    return control + c * (asked - turn).unsqueeze(-1) * self.chosen_controls(controls_of(self, "turn"), control)


@_on_command("rad/m", typical=0.05, limit=0.5)
def steering_offset(self: Program, state: Tensor, control: Tensor, time: Tensor, c: Tensor) -> Tensor:
    r"""turn → turn + c v

    equation: u_\mathrm{turn} \to u_\mathrm{turn} + c\,v
    feels: drives a curve with the steering straight
    occurs: a servo horn that is one tooth off, a wheel that is out of alignment
    """
    forward, _, _ = self.body_velocity(state)
    return control + (c * forward).unsqueeze(-1) * self.chosen_controls(controls_of(self, "turn"), control)


@declare(
    WHEELS,
    "command",
    "rad",
    typical=0.03,
    limit=0.3,
    name="steering_offset",
    choices=_angles,
    lacks=needs(PLANAR, STEERING_ANGLE),
)
def steering_angle_offset(
    self: Program, state: Tensor, control: Tensor, time: Tensor, c: Tensor, controls: Names
) -> Tensor:
    r"""steering → steering + c, or the rudder angle

    equation: u_\mathrm{steering} \to u_\mathrm{steering} + c
    feels: drives a curve with the steering straight
    occurs: a steering sensor whose zero was never set, a wheel that is out of alignment, a rudder that hangs askew
    """
    return control + c * self.chosen_controls(controls, control)


@_on_steering("s²/m²", typical=0.02, limit=0.5)
def understeer(self: Program, state: Tensor, control: Tensor, time: Tensor, c: Tensor) -> Tensor:
    r"""turn → (1 - c v²) turn, or the steering angle

    equation: u_\mathrm{turn} \to (1 - c\,v^2)\,u_\mathrm{turn}
    feels: fast curves are wider than slow ones
    occurs: cars whose front tyres slip more than their rear ones (Rajamani 2012, chapter 3)
    """
    forward, _, _ = self.body_velocity(state)
    return control * (1 - (c * forward**2).unsqueeze(-1) * self.chosen_controls(_steering(self), control))


@_on_steering("1", typical=0.1, limit=1.0, profiled=("knee",), by_factor=("knee",), choices=_slow(0.1))
def reverse_steering(self: Program, state: Tensor, control: Tensor, time: Tensor, c: Tensor, knee: Any) -> Tensor:
    r"""turn → (1 - c tanh(v/knee)) turn, or the steering angle

    equation: u_\mathrm{turn} \to (1 - c\,\tanh(v / v_0))\,u_\mathrm{turn}
    feels: turns tighter backwards than forwards
    occurs: tyres, suspensions and differentials that are not alike in both directions
    """
    forward, _, _ = self.body_velocity(state)
    return control * (
        1 - (c * torch.tanh(forward / knee)).unsqueeze(-1) * self.chosen_controls(_steering(self), control)
    )


@_on_lateral_velocity("m", typical=0.1, limit=1.0)
def lever_arm(
    self: Program, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, mean: Means
) -> Pushes:
    r"""v_y = c ω

    equation: v_y \to c\,\omega
    feels: the tracked point swings around the axle that does not slip
    occurs: a tag that is mounted before or behind the rear axle
    """
    return {"lateral": c * (state[..., 5] / self.settles_in(step) + mean["yaw"])}


@_on_lateral_velocity("rad", typical=0.05, limit=0.5)
def crab_angle(
    self: Program, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, mean: Means
) -> Pushes:
    r"""v_y = c v_x

    equation: v_y \to c\,v_x
    feels: points beside where it goes
    occurs: axles that are not square to the frame, a tag that is turned against the vehicle, a farm machine on a slope
    """
    forward, lateral, yaw_rate = self.body_velocity(state)
    return {"lateral": c * (forward / self.settles_in(step) + (mean["forward"] + lateral * yaw_rate))}


@_on_lateral_velocity("s", typical=0.05, limit=0.5)
def slip_angle(
    self: Program, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, mean: Means
) -> Pushes:
    r"""v_y = -c v_x ω

    equation: v_y \to -c\,v_x\,\omega
    feels: slides outwards in curves, the more the faster
    occurs: tyres under side force in fast curves
    """
    forward, lateral, yaw_rate = self.body_velocity(state)
    change = (mean["forward"] + lateral * yaw_rate) * yaw_rate + forward * mean["yaw"]
    return {"lateral": -c * (forward * yaw_rate / self.settles_in(step) + change)}


@declare(WHEELS, "push", "1/m", typical=0.5, limit=5.0, lacks=needs(PLANAR))
def caster(self: Program, state: Tensor, *_: Tensor, c: Tensor) -> Pushes:
    r"""a_yaw = -c v_x ω

    equation: a_\mathrm{yaw} = -c\,v_x\,\omega
    feels: straightens up when driving forwards, swings round when driving backwards
    occurs: cars with caster and toe, trailers, trolleys with swivelling wheels; hulls whose damping of turns grows with
        speed (the u r term of the yaw moment, Fossen 2011, chapter 6)
    """
    forward, _, yaw_rate = self.body_velocity(state)
    return {"yaw": -c * forward * yaw_rate}


@_on_two_wheels("1", typical=0.02, limit=0.3)
def wheel_radius_difference(self: Program, control: Tensor, time: Tensor, c: Tensor) -> Tensor:
    r"""right wheel → (1 + c/2) right, left wheel → (1 - c/2) left

    equation: u_\mathrm{right} \to (1 + c / 2)\,u_\mathrm{right},\quad u_\mathrm{left} \to (1 - c / 2)\,u_\mathrm{left}
    feels: drives a wide curve when both wheels have the same command
    occurs: a worn tyre, a load on one side (unequal wheel diameters, Borenstein and Feng 1996)
    """
    left, right = (self.chosen_controls((name,), control) for name in _wheels(self))
    return control * (1 + 0.5 * c * (right - left))


@_on_two_wheels("1", typical=0.05, limit=0.5)
def track_width(self: Program, control: Tensor, time: Tensor, c: Tensor) -> Tensor:
    r"""right wheel - left wheel → (1 + c) (right - left), their mean as it is: the track is 1 + c times narrower

    equation: u_\mathrm{right} - u_\mathrm{left} \to (1 + c)\,(u_\mathrm{right} - u_\mathrm{left})
    feels: turns more (or less) than commanded, as straight and as fast as before
    occurs: wide or soft tyres and tracks, which touch the ground elsewhere than in the middle (uncertainty about the
        wheelbase, Borenstein and Feng 1996)
    """
    left, right = (self.chosen_controls((name,), control) for name in _wheels(self))
    half = 0.5 * (control * (right - left)).sum(-1, keepdim=True)
    return control + c * half * (right - left)
