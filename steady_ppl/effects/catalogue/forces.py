"""Forces that any program can lack: drag, friction, offsets and springs on the channels of one axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.declaration import Effect, declare
from steady_ppl.model.program import Program


def _each(groups: Mapping[str, Sequence[str]]) -> Sequence[Mapping[str, Any]]:
    """Each group of channels, at its name unless there is one only."""
    return [{"channels": channels, **({"at": name} if len(groups) > 1 else {})} for name, channels in groups.items()]


def _axes(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    return _each({name: channels for name, channels in program.axes.items() if name != "yaw"})


def _springs(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    return _each({channel: (channel,) for channel, (position, _) in program.motion.items() if position})


def _no_axes(program: Program) -> str | None:
    return None if program.axes else "the program does not say which channels move what (`motion`)"


def _no_springs(program: Program) -> str | None:
    return None if any(p for p, _ in program.motion.values()) else "no channel has a position (`motion`)"


def _planar(program: Program) -> bool:
    return {"forward", "lateral"} <= set(program.axes.get("translation", ()))


FORCES: list[Effect] = []
_force = partial(declare, FORCES, "push")
_on_axes = partial(_force, choices=_axes, lacks=_no_axes)
_on_yaw = partial(
    _force,
    choices=lambda program, data: [{"channels": program.axes["yaw"]}],
    lacks=lambda program: None if "yaw" in program.axes else "there is no yaw channel",
)
_on_springs = partial(_force, choices=_springs, lacks=_no_springs)


@_on_axes("1/s", typical=0.12, limit=1.0, sign=1)
def linear_drag(self: Any, state: Tensor, *_: Tensor, c: Tensor, channels: Sequence[str]) -> dict[str, Tensor]:
    r"""a = -c v

    equation: a = -c\,v
    feels: coasts to rest like in oil: half the speed, half the braking
    occurs: slow motion through something viscous: joints in grease, small boats, gliders at low speed, an eddy-current
        brake
    """
    velocity = self.velocities(state)
    return {channel: -c * velocity[channel] for channel in channels}


@_on_axes("1/m", typical=0.06, limit=0.5, sign=1)
def quadratic_drag(self: Any, state: Tensor, *_: Tensor, c: Tensor, channels: Sequence[str]) -> dict[str, Tensor]:
    r"""a = -c v |v| per axis

    equation: a = -c\,v\,|v|
    feels: top speed is capped, slow motion is free
    occurs: hulls, airframes and cars at speed, where the wake costs energy (Reynolds numbers well above 1000)
    """
    velocity = self.velocities(state)
    return {channel: -c * velocity[channel] * velocity[channel].abs() for channel in channels}


@_on_axes("m/s²", typical=0.1, limit=1.0, sign=1)
def coulomb_friction(self: Any, state: Tensor, *_: Tensor, c: Tensor, channels: Sequence[str]) -> dict[str, Tensor]:
    r"""a = -c v / sqrt(v² + 0.05²)

    equation: a = -c\,v / \sqrt{v^2 + 0.05^2}
    feels: brakes the same at any speed, then stops dead
    occurs: sledges, tracked robots, wheels with the brake dragging, linear guides and ball screws
    """
    velocity = self.velocities(state)
    return {channel: -c * velocity[channel] * (velocity[channel] ** 2 + 0.05**2).rsqrt() for channel in channels}


@_on_yaw("1/s", typical=0.15, limit=2.0, sign=1)
def yaw_linear_drag(self: Any, *given: Tensor, c: Tensor, channels: Sequence[str]) -> dict[str, Tensor]:
    r"""a_yaw = -c ω

    equation: a_\mathrm{yaw} = -c\,\omega
    feels: stops turning by itself
    occurs: boats, hovercraft and multirotors that turn slowly; damping of a bearing or a rotor's wash
    """
    return linear_drag(self, *given, c=c, channels=channels)


@_on_yaw("1/rad", typical=0.25, limit=3.0, sign=1)
def yaw_quadratic_drag(self: Any, *given: Tensor, c: Tensor, channels: Sequence[str]) -> dict[str, Tensor]:
    r"""a_yaw = -c ω |ω|

    equation: a_\mathrm{yaw} = -c\,\omega\,|\omega|
    feels: fast spins are capped, slow ones go on
    occurs: hulls and fins that are swept sideways through water or air when turning fast
    """
    return quadratic_drag(self, *given, c=c, channels=channels)


@_on_yaw("rad/s²", typical=0.04, limit=0.5)
def yaw_bias(self: Any, state: Tensor, *_: Tensor, c: Tensor, channels: Sequence[str]) -> dict[str, Tensor]:
    r"""a_yaw = c

    equation: a_\mathrm{yaw} = c
    feels: pulls to one side with the controls at rest
    occurs: one propeller's torque reaction, a bent rudder or skeg, a tether that twists
    """
    return dict.fromkeys(channels, c + torch.zeros_like(state[..., 0]))


@_force(
    "m/s²",
    typical=0.05,
    limit=0.5,
    choices=_axes,
    lacks=lambda program: "it has two components there" if _planar(program) else _no_axes(program),
)
def acceleration_bias(self: Any, *given: Tensor, c: Tensor, channels: Sequence[str]) -> dict[str, Tensor]:
    """a = c in the body frame

    equation: a = c
    feels: creeps one way, whichever way it points
    occurs: a tilted rail, a spring or a hose that pulls one way, an offset of whatever drives the channel
    """
    return yaw_bias(self, *given, c=c, channels=channels)


@_force(
    "m/s²",
    name="acceleration_bias",
    typical=(0.05, 0.0),
    limit=0.5,
    components=("forward", "lateral"),
    lacks=lambda program: None if _planar(program) else "it is no planar vehicle",
)
def planar_acceleration_bias(self: Any, state: Tensor, *_: Tensor, c: Tensor) -> dict[str, Tensor]:
    r"""(a_forward, a_lateral) = (c₁, c₂)

    equation: (a_\mathrm{forward}, a_\mathrm{lateral}) = (c_1, c_2)
    feels: creeps one way in its own frame, whichever way it points
    occurs: a load that hangs to one side, thrusters that are mounted at an angle, an inertial unit that is not level
    """
    still = torch.zeros_like(state[..., 0])
    return {"forward": c[..., 0] + still, "lateral": c[..., 1] + still}


@_on_springs("1/s²", typical=2.0, limit=50.0)
def stiffness(self: Any, state: Tensor, *_: Tensor, c: Tensor, channels: Sequence[str]) -> dict[str, Tensor]:
    r"""a = -c x

    equation: a = -c\,x
    feels: is drawn back to the origin, like by a spring
    occurs: moorings, springs and belts, a pendulum near its rest, a tether under tension
    """
    position = self.positions(state)
    return {channel: -c * position[channel] for channel in channels}


@_on_springs("1/(m² s²)", typical=3.0, limit=100.0)
def cubic_stiffness(self: Any, state: Tensor, *_: Tensor, c: Tensor, channels: Sequence[str]) -> dict[str, Tensor]:
    r"""a = -c x³

    equation: a = -c\,x^3
    feels: free near the origin, a wall far from it
    occurs: rubber mounts, a belt that tightens, clamped beams at large deflections (the Duffing oscillator)
    """
    position = self.positions(state)
    return {channel: -c * position[channel] ** 3 for channel in channels}
