"""Vehicles on wheels that are told a speed and a turn rate, as programs without slip have them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.catalogue.planar_forces import needs_grip, not_planar
from steady_ppl.effects.declaration import Effect
from steady_ppl.model.program import Program


def needs_commanded_speed(program: Program) -> str | None:
    """Why an effect on vehicles that are told a speed and a turn rate does not apply."""
    if {"speed", "turn"} <= set(program.control_names):
        return not_planar(program)
    return "the controls are not a speed and a turn rate, which the state could be compared with"


def _needs_wheels(program: Program) -> str | None:
    return needs_commanded_speed(program) or needs_grip(program)


def _each_channel(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    return [{"channels": (name,), "at": name} for name in program.channel_names]


def response_time(
    self: Any,
    state: Tensor,
    control: Tensor,
    time: Tensor,
    step: Tensor,
    c: Tensor,
    channels: Sequence[str],
    mean: Mapping[str, Tensor],
) -> dict[str, Tensor]:
    slower, carried = c / (c + self.settles_in(step)), self.carried(state)
    return {channel: (carried[channel] - mean[channel]) * slower for channel in channels}


def curvature_steering(self: Any, state: Tensor, control: Tensor, time: Tensor, c: Tensor) -> Tensor:
    speed, turn = control[..., self.control_index("speed")], control[..., self.control_index("turn")]
    forward, _, _ = self.body_velocity(state)
    asked = turn * speed * forward / (speed**2 + 0.05**2)
    return control + c * (asked - turn).unsqueeze(-1) * self.chosen_controls(("turn",), control)


def steering_offset(self: Any, state: Tensor, control: Tensor, time: Tensor, c: Tensor) -> Tensor:
    forward, _, _ = self.body_velocity(state)
    more = c * forward
    return control + more.unsqueeze(-1) * self.chosen_controls(("turn",), control)


def understeer(self: Any, state: Tensor, control: Tensor, time: Tensor, c: Tensor) -> Tensor:
    forward, _, _ = self.body_velocity(state)
    lost = c * forward**2
    return control * (1 - lost.unsqueeze(-1) * self.chosen_controls(("turn",), control))


def reverse_steering(self: Any, state: Tensor, control: Tensor, time: Tensor, c: Tensor) -> Tensor:
    forward, _, _ = self.body_velocity(state)
    lost = c * torch.tanh(forward / 0.1)
    return control * (1 - lost.unsqueeze(-1) * self.chosen_controls(("turn",), control))


def lever_arm(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, mean: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    yaw_rate = state[..., 5]
    return {"lateral": c * (yaw_rate / self.settles_in(step) + mean["yaw"])}


def crab_angle(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, mean: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    forward, lateral, yaw_rate = self.body_velocity(state)
    change = mean["forward"] + lateral * yaw_rate
    return {"lateral": c * (forward / self.settles_in(step) + change)}


def slip_angle(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, mean: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    forward, lateral, yaw_rate = self.body_velocity(state)
    change = (mean["forward"] + lateral * yaw_rate) * yaw_rate + forward * mean["yaw"]
    return {"lateral": -c * (forward * yaw_rate / self.settles_in(step) + change)}


def caster(self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor) -> dict[str, Tensor]:
    forward, _, yaw_rate = self.body_velocity(state)
    return {"yaw": -c * forward * yaw_rate}


WHEELS = [
    Effect(
        name="response_time",
        form="push",
        equation=r"\dot v = (v_\mathrm{told} - v) / (c + \tau)",
        text="dv/dt = (v_told - v) / (c + τ), τ what the program has (its step where it says nothing)",
        unit="s",
        feels="gets to what it is told, or back to it when pushed off, little by little",
        occurs="speed controllers with little gain, hydraulic steering, heavy wheels",
        function=response_time,
        typical=0.2,
        limit=2.0,
        sign=1,
        between=(0.0, float("inf")),
        probes=(0.05, 0.15, 0.4),
        choices=_each_channel,
        lacks=_needs_wheels,
    ),
    Effect(
        name="curvature_steering",
        form="command",
        equation=r"u_\mathrm{turn} \to (1 - c)\,u_\mathrm{turn} + c\,u_\mathrm{turn}\,v / u_\mathrm{speed}",
        text="turn → (1 - c) turn + c (turn / speed) v",
        unit="1",
        feels="steers a curve, not a turn rate: turns slower while it is slower than it is told",
        occurs="cars and trucks: the command is a steering angle, which fixes a curve and not a turn rate",
        function=curvature_steering,
        typical=0.5,
        limit=2.0,
        lacks=needs_commanded_speed,
    ),
    Effect(
        name="steering_offset",
        form="command",
        equation=r"u_\mathrm{turn} \to u_\mathrm{turn} + c\,v",
        text="turn → turn + c v",
        unit="rad/m",
        feels="drives a curve with the steering straight",
        occurs="a servo horn that is one tooth off, a wheel that is out of alignment",
        function=steering_offset,
        typical=0.05,
        limit=0.5,
        lacks=needs_commanded_speed,
    ),
    Effect(
        name="understeer",
        form="command",
        equation=r"u_\mathrm{turn} \to (1 - c\,v^2)\,u_\mathrm{turn}",
        text="turn → (1 - c v²) turn",
        unit="s²/m²",
        feels="fast curves are wider than slow ones",
        occurs="cars whose front tyres slip more than their rear ones",
        function=understeer,
        typical=0.02,
        limit=0.5,
        lacks=needs_commanded_speed,
    ),
    Effect(
        name="reverse_steering",
        form="command",
        equation=r"u_\mathrm{turn} \to (1 - c\,\tanh(v / 0.1))\,u_\mathrm{turn}",
        text="turn → (1 - c tanh(v/0.1)) turn",
        unit="1",
        feels="turns tighter backwards than forwards",
        occurs="tyres, suspensions and differentials that are not alike in both directions",
        function=reverse_steering,
        typical=0.1,
        limit=1.0,
        lacks=needs_commanded_speed,
    ),
    Effect(
        name="lever_arm",
        form="push",
        equation=r"v_y \to c\,\omega",
        text="v_y = c ω",
        unit="m",
        feels="the tracked point swings around the axle that does not slip",
        occurs="a tag that is mounted before or behind the rear axle",
        function=lever_arm,
        typical=0.1,
        limit=1.0,
        lacks=needs_grip,
    ),
    Effect(
        name="crab_angle",
        form="push",
        equation=r"v_y \to c\,v_x",
        text="v_y = c v_x",
        unit="rad",
        feels="points beside where it goes",
        occurs="axles that are not square to the frame, a tag that is turned against the vehicle, a farm machine on "
        "a slope",
        function=crab_angle,
        typical=0.05,
        limit=0.5,
        lacks=needs_grip,
    ),
    Effect(
        name="slip_angle",
        form="push",
        equation=r"v_y \to -c\,v_x\,\omega",
        text="v_y = -c v_x ω",
        unit="s",
        feels="slides outwards in curves, the more the faster",
        occurs="tyres under side force in fast curves",
        function=slip_angle,
        typical=0.05,
        limit=0.5,
        lacks=needs_grip,
    ),
    Effect(
        name="caster",
        form="push",
        equation=r"a_\mathrm{yaw} = -c\,v_x\,\omega",
        text="a_yaw = -c v_x ω",
        unit="1/m",
        feels="straightens up when driving forwards, swings round when driving backwards",
        occurs="cars with caster and toe, trailers, trolleys with swivelling wheels",
        function=caster,
        typical=0.5,
        limit=5.0,
        lacks=_needs_wheels,
    ),
]
