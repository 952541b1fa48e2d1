"""Forces on a vehicle in the plane, in its body frame unless said otherwise."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.declaration import Effect
from steady_ppl.model.handlers import broadcast_event, running
from steady_ppl.model.planar_vehicle import PlanarVehicle
from steady_ppl.model.program import Program
from steady_ppl.utils.random import seeded

STARTS = 500  # drawn, where nothing else says where a vehicle goes


def not_planar(program: Program) -> str | None:
    """Why an effect on planar vehicles does not apply."""
    return None if isinstance(program, PlanarVehicle) else "it acts on vehicles in the plane only"


def no_bearings(program: Program) -> str | None:
    """Why an effect on bearings to landmarks does not apply."""
    if isinstance(program, PlanarVehicle) and not program.sees_bearings:
        return "it acts on bearings to landmarks, and the program measures something else"
    return not_planar(program)


def _needs_slip(program: Program) -> str | None:
    if isinstance(program, PlanarVehicle) and not program.slips:
        return "the program holds the lateral velocity at zero"
    return not_planar(program)


def needs_grip(program: Program) -> str | None:
    """Why an effect on vehicles whose program holds the lateral velocity does not apply."""
    if isinstance(program, PlanarVehicle) and program.slips:
        return "the lateral velocity is free"
    return not_planar(program)


def _needs_two_thrusters(program: Program) -> str | None:
    if {"left", "right"} <= set(program.control_names):
        return not_planar(program)
    return "the controls are not a left and a right thrust"


def _drags(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    return [{"drag": drag} for drag in (0.06, 0.02, 0.2)]


def _slips(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    return [{"lead": lead} for lead in (0.2, 0.0, 0.5)]


def _limits(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    return [{"channels": program.axes["translation"]}, {"channels": program.axes["yaw"], "at": "yaw"}]


def _places(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    """Patches on a grid over where the vehicle was, as far as its states, its landmarks or its start say."""
    if (data is None or data.states is None) and len(program.landmarks):
        landmarks = torch.as_tensor(program.landmarks).detach().double()
        low, high = 0.5 * landmarks.amin(0), 0.5 * landmarks.amax(0)
    else:
        states = _starts(program) if data is None or data.states is None else data.states
        places = states[..., :2][torch.isfinite(states[..., :2]).all(-1)].double()
        low, high = places.quantile(0.05, 0), places.quantile(0.95, 0)
    radius = float((high - low).max()) / 5
    steps = [torch.linspace(float(low[i]), float(high[i]), 3).tolist() for i in (0, 1)]
    return [{"x": x, "y": y, "radius": radius} for x, y in itertools.product(*steps)]


@torch.no_grad()
def _starts(program: Program) -> torch.Tensor:
    """Drawn from where drives begin, `(1, STARTS, D)`."""
    with seeded("starts"), running(1, STARTS):
        return broadcast_event(program.initial(), torch.Size((1, STARTS)), 1)


def slope(self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor) -> dict[str, Tensor]:
    x, y = c.unbind(-1)
    cos, sin = state[..., 2].cos(), state[..., 2].sin()
    return {"forward": cos * x + sin * y, "lateral": cos * y - sin * x}


def wind(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, drag: Any
) -> dict[str, Tensor]:
    x, y = c.unbind(-1)
    cos, sin = state[..., 2].cos(), state[..., 2].sin()
    forward, lateral, _ = self.body_velocity(state)
    along, across = forward - cos * x - sin * y, lateral - cos * y + sin * x
    return {
        "forward": -drag * (along * along.abs() - forward * forward.abs()),
        "lateral": -drag * (across * across.abs() - lateral * lateral.abs()),
    }


def lateral_coupling(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor
) -> dict[str, Tensor]:
    left, right = control[..., self.control_index("left")], control[..., self.control_index("right")]
    return {"lateral": c * (left - right)}


def weathervane(self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor) -> dict[str, Tensor]:
    forward, lateral, _ = self.body_velocity(state)
    return {"yaw": -c * forward * lateral}


def magnus(self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor) -> dict[str, Tensor]:
    forward, _, yaw_rate = self.body_velocity(state)
    return {"lateral": -c * forward * yaw_rate}


def lever_arm(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, mean: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    yaw_rate = state[..., 5]
    return {"forward": c * yaw_rate**2, "lateral": -c * mean["yaw"]}


def side_slip(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, lead: Any
) -> dict[str, Tensor]:
    _, lateral, yaw_rate = self.body_velocity(state)
    return {"lateral": -c * (lateral - lead * yaw_rate)}


def sticky_patch(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, x: Any, y: Any, radius: Any
) -> dict[str, Tensor]:
    forward, lateral, _ = self.body_velocity(state)
    inside = (-((state[..., 0] - x) ** 2 + (state[..., 1] - y) ** 2) / (2 * radius**2)).exp()
    return {"forward": -c * forward * inside, "lateral": -c * lateral * inside}


def acceleration_limit(
    self: Any,
    state: Tensor,
    control: Tensor,
    time: Tensor,
    step: Tensor,
    c: Tensor,
    channels: Sequence[str],
    mean: Mapping[str, Tensor],
) -> dict[str, Tensor]:
    return {channel: torch.minimum(torch.maximum(mean[channel], -c), c) - mean[channel] for channel in channels}


PLANAR_FORCES = [
    Effect(
        name="slope",
        form="push",
        equation=r"\dot v_\mathrm{world} = (c_1, c_2)",
        text="world-frame acceleration (c₁, c₂)",
        unit="m/s²",
        feels="drifts the same way over ground, wherever it points",
        occurs="ramps and floors that are not level; what a current does to a boat that is slow to drift with it",
        function=slope,
        typical=(0.05, -0.03),
        limit=0.5,
        components=("x", "y"),
        lacks=_needs_slip,
    ),
    Effect(
        name="wind",
        form="push",
        equation=r"a = -k\,(v - w)\,|v - w| + k\,v\,|v|,\quad w = R^\top(c_1, c_2)",
        text="a = -k (v-w)|v-w| + k v|v| per axis, w the world-frame wind (c₁, c₂) in the body frame",
        unit="m/s",
        feels="slower one way than the other, and more so when fast",
        occurs="boats in a current (w is the current, its drag found with it), multirotors and airships in wind, air "
        "tables with a draught",
        function=wind,
        profiled=("drag",),
        typical=(1.0, 0.5),
        limit=10.0,
        components=("x", "y"),
        choices=_drags,
        lacks=_needs_slip,
    ),
    Effect(
        name="lateral_coupling",
        form="push",
        equation=r"a_\mathrm{lateral} = c\,(u_\mathrm{left} - u_\mathrm{right})",
        text="a_lateral = c (left - right)",
        unit="1/kg",
        feels="steps sideways when it is told to turn",
        occurs="propellers whose wash hits a skeg, a stern that swings, the paddle-wheel effect of a single screw",
        function=lateral_coupling,
        typical=0.2,
        limit=1.0,
        lacks=_needs_two_thrusters,
    ),
    Effect(
        name="weathervane",
        form="push",
        equation=r"a_\mathrm{yaw} = -c\,v_x v_y",
        text="a_yaw = -c v_x v_y",
        unit="rad/m²",
        feels="turns its nose into (or out of) the way it slides",
        occurs="airframes with fins (positive) and hulls without (the Munk moment, negative)",
        function=weathervane,
        typical=0.1,
        limit=1.0,
        lacks=_needs_slip,
    ),
    Effect(
        name="magnus",
        form="push",
        equation=r"a_\mathrm{lateral} = -c\,v_x\,\omega",
        text="a_lateral = -c v_x ω",
        unit="1",
        feels="curves carry it to the inside (or outside)",
        occurs="spinning hulls and balls; the centripetal term of a program that forgot that its frame turns",
        function=magnus,
        typical=0.15,
        limit=2.0,
        lacks=not_planar,
    ),
    Effect(
        name="lever_arm",
        form="push",
        equation=r"a_\mathrm{forward} = c\,\omega^2,\quad a_\mathrm{lateral} = -c\,a_\mathrm{yaw}",
        text="a_forward = c ω², a_lateral = -c a_yaw",
        unit="m",
        feels="the tracked point swings around another one when turning",
        occurs="a camera, a tag or a GPS antenna that is mounted away from the centre of mass",
        function=lever_arm,
        typical=0.15,
        limit=1.0,
        lacks=_needs_slip,
    ),
    Effect(
        name="side_slip",
        form="push",
        equation=r"a_\mathrm{lateral} = -c\,(v_y - k\,\omega)",
        text="a_lateral = -c (v_y - k ω)",
        unit="1/s",
        feels="sideways motion dies out, that of forward motion does not",
        occurs="keels, wheels and skids, which let forward motion go on and sideways motion die out",
        function=side_slip,
        profiled=("lead",),
        typical=0.2,
        limit=5.0,
        sign=1,
        choices=_slips,
        lacks=_needs_slip,
    ),
    Effect(
        name="sticky_patch",
        form="push",
        equation=r"a = -c\,v\,\exp(-d^2 / 2 r^2)",
        text="a = -c v exp(-d²/2r²), d the distance from a place",
        unit="1/s",
        feels="is braked at one place of the ground",
        occurs="a carpet, a puddle, mud or a worn place of the floor",
        function=sticky_patch,
        profiled=("x", "y", "radius"),
        typical=0.5,
        limit=3.0,
        sign=1,
        choices=_places,
        lacks=not_planar,
    ),
    Effect(
        name="acceleration_limit",
        form="push",
        equation=r"|a| \le c",
        text="|a| ≤ c",
        unit="m/s²",
        feels="never jumps off the line, whatever it is told",
        occurs="motor drivers with a ramp or a current limit, tyres at the limit of grip",
        function=acceleration_limit,
        typical=0.6,
        limit=10.0,
        sign=1,
        null=float("inf"),
        probes=(0.1, 0.2, 0.4, 0.8, 1.6, 3.2),
        choices=_limits,
        lacks=not_planar,
    ),
]
