"""Forces that any program can lack: drag, friction, offsets and springs on the channels of one axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.declaration import Effect
from steady_ppl.model.program import Program


def _axes(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    axes = {name: channels for name, channels in program.axes.items() if name != "yaw"}
    if len(axes) == 1:
        return [{"channels": channels} for channels in axes.values()]
    return [{"channels": channels, "at": name} for name, channels in axes.items()]


def _springs(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    moved = [channel for channel, (position, _) in program.motion.items() if position]
    if len(moved) == 1:
        return [{"channels": (moved[0],)}]
    return [{"channels": (channel,), "at": channel} for channel in moved]


def _yaw(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    return [{"channels": program.axes["yaw"]}]


def _no_axes(program: Program) -> str | None:
    return None if program.axes else "the program does not say which channels move what (`motion`)"


def _no_yaw(program: Program) -> str | None:
    return None if "yaw" in program.axes else "there is no yaw channel"


def _no_springs(program: Program) -> str | None:
    return None if any(p for p, _ in program.motion.values()) else "no channel has a position (`motion`)"


def linear_drag(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, channels: Sequence[str]
) -> dict[str, Tensor]:
    velocity = self.velocities(state)
    return {channel: -c * velocity[channel] for channel in channels}


def quadratic_drag(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, channels: Sequence[str]
) -> dict[str, Tensor]:
    velocity = self.velocities(state)
    return {channel: -c * velocity[channel] * velocity[channel].abs() for channel in channels}


def coulomb_friction(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, channels: Sequence[str]
) -> dict[str, Tensor]:
    velocity = self.velocities(state)
    return {channel: -c * velocity[channel] * (velocity[channel] ** 2 + 0.05**2).rsqrt() for channel in channels}


def constant(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, channels: Sequence[str]
) -> dict[str, Tensor]:
    still = torch.zeros_like(state[..., 0])
    return dict.fromkeys(channels, c + still)


def body_constant(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor
) -> dict[str, Tensor]:
    forward, lateral = c.unbind(-1)
    still = torch.zeros_like(state[..., 0])
    return {"forward": forward + still, "lateral": lateral + still}


def stiffness(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, channels: Sequence[str]
) -> dict[str, Tensor]:
    position = self.positions(state)
    return {channel: -c * position[channel] for channel in channels}


def cubic_stiffness(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, channels: Sequence[str]
) -> dict[str, Tensor]:
    position = self.positions(state)
    return {channel: -c * position[channel] ** 3 for channel in channels}


def _planar(program: Program) -> bool:
    return {"forward", "lateral"} <= set(program.axes.get("translation", ()))


FORCES = [
    Effect(
        name="linear_drag",
        form="push",
        equation=r"a = -c\,v",
        text="a = -c v",
        unit="1/s",
        feels="coasts to rest like in oil: half the speed, half the braking",
        occurs="slow motion through something viscous: joints in grease, small boats, gliders at low speed, an "
        "eddy-current brake",
        function=linear_drag,
        typical=0.12,
        limit=1.0,
        sign=1,
        choices=_axes,
        lacks=_no_axes,
    ),
    Effect(
        name="quadratic_drag",
        form="push",
        equation=r"a = -c\,v\,|v|",
        text="a = -c v |v| per axis",
        unit="1/m",
        feels="top speed is capped, slow motion is free",
        occurs="hulls, airframes and cars at speed, where the wake costs energy (Reynolds numbers well above 1000)",
        function=quadratic_drag,
        typical=0.06,
        limit=0.5,
        sign=1,
        choices=_axes,
        lacks=_no_axes,
    ),
    Effect(
        name="coulomb_friction",
        form="push",
        equation=r"a = -c\,v / \sqrt{v^2 + 0.05^2}",
        text="a = -c v / sqrt(v² + 0.05²)",
        unit="m/s²",
        feels="brakes the same at any speed, then stops dead",
        occurs="sledges, tracked robots, wheels with the brake dragging, linear guides and ball screws",
        function=coulomb_friction,
        typical=0.1,
        limit=1.0,
        sign=1,
        choices=_axes,
        lacks=_no_axes,
    ),
    Effect(
        name="yaw_linear_drag",
        form="push",
        equation=r"a_\mathrm{yaw} = -c\,\omega",
        text="a_yaw = -c ω",
        unit="1/s",
        feels="stops turning by itself",
        occurs="boats, hovercraft and multirotors that turn slowly; damping of a bearing or a rotor's wash",
        function=linear_drag,
        typical=0.15,
        limit=2.0,
        sign=1,
        choices=_yaw,
        lacks=_no_yaw,
    ),
    Effect(
        name="yaw_quadratic_drag",
        form="push",
        equation=r"a_\mathrm{yaw} = -c\,\omega\,|\omega|",
        text="a_yaw = -c ω |ω|",
        unit="1/rad",
        feels="fast spins are capped, slow ones go on",
        occurs="hulls and fins that are swept sideways through water or air when turning fast",
        function=quadratic_drag,
        typical=0.25,
        limit=3.0,
        sign=1,
        choices=_yaw,
        lacks=_no_yaw,
    ),
    Effect(
        name="yaw_bias",
        form="push",
        equation=r"a_\mathrm{yaw} = c",
        text="a_yaw = c",
        unit="rad/s²",
        feels="pulls to one side with the controls at rest",
        occurs="one propeller's torque reaction, a bent rudder or skeg, a tether that twists",
        function=constant,
        typical=0.04,
        limit=0.5,
        choices=_yaw,
        lacks=_no_yaw,
    ),
    Effect(
        name="acceleration_bias",
        form="push",
        equation=r"a = c",
        text="a = c in the body frame",
        unit="m/s²",
        feels="creeps one way, whichever way it points",
        occurs="a tilted rail, a spring or a hose that pulls one way, an offset of whatever drives the channel",
        function=constant,
        typical=0.05,
        limit=0.5,
        choices=_axes,
        lacks=lambda program: "it has two components there" if _planar(program) else _no_axes(program),
    ),
    Effect(
        name="acceleration_bias",
        form="push",
        equation=r"(a_\mathrm{forward}, a_\mathrm{lateral}) = (c_1, c_2)",
        text="(a_forward, a_lateral) = (c₁, c₂)",
        unit="m/s²",
        feels="creeps one way in its own frame, whichever way it points",
        occurs="a load that hangs to one side, thrusters that are mounted at an angle, an inertial unit that is not "
        "level",
        function=body_constant,
        typical=(0.05, 0.0),
        limit=0.5,
        components=("forward", "lateral"),
        lacks=lambda program: None if _planar(program) else "it is no planar vehicle",
    ),
    Effect(
        name="stiffness",
        form="push",
        equation=r"a = -c\,x",
        text="a = -c x",
        unit="1/s²",
        feels="is drawn back to the origin, like by a spring",
        occurs="moorings, springs and belts, a pendulum near its rest, a tether under tension",
        function=stiffness,
        typical=2.0,
        limit=50.0,
        choices=_springs,
        lacks=_no_springs,
    ),
    Effect(
        name="cubic_stiffness",
        form="push",
        equation=r"a = -c\,x^3",
        text="a = -c x³",
        unit="1/(m² s²)",
        feels="free near the origin, a wall far from it",
        occurs="rubber mounts, a belt that tightens, clamped beams at large deflections (the Duffing oscillator)",
        function=cubic_stiffness,
        typical=3.0,
        limit=100.0,
        choices=_springs,
        lacks=_no_springs,
    ),
]
