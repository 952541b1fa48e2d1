"""Forces on a vehicle in the plane, in its body frame unless said otherwise."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.declaration import Effect, declare
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
def _starts(program: Program) -> Tensor:
    """Drawn from where drives begin, `(1, STARTS, D)`."""
    with seeded("starts"), running(1, STARTS):
        return broadcast_event(program.initial(), torch.Size((1, STARTS)), 1)


PLANAR_FORCES: list[Effect] = []
_force = partial(declare, PLANAR_FORCES, "push")
_where_it_slips = partial(_force, lacks=_needs_slip)
_on_any = partial(_force, lacks=not_planar)


@_where_it_slips("m/s²", typical=(0.05, -0.03), limit=0.5, components=("x", "y"))
def slope(self: Any, state: Tensor, *_: Tensor, c: Tensor) -> dict[str, Tensor]:
    r"""world-frame acceleration (c₁, c₂)

    equation: \dot v_\mathrm{world} = (c_1, c_2)
    feels: drifts the same way over ground, wherever it points
    occurs: ramps and floors that are not level; what a current does to a boat that is slow to drift with it
    """
    x, y = c.unbind(-1)
    cos, sin = state[..., 2].cos(), state[..., 2].sin()
    return {"forward": cos * x + sin * y, "lateral": cos * y - sin * x}


@_where_it_slips(
    "m/s",
    typical=(1.0, 0.5),
    limit=10.0,
    components=("x", "y"),
    profiled=("drag",),
    choices=lambda program, data: [{"drag": drag} for drag in (0.06, 0.02, 0.2)],
)
def wind(self: Any, state: Tensor, *_: Tensor, c: Tensor, drag: Any) -> dict[str, Tensor]:
    r"""a = -k (v-w)|v-w| + k v|v| per axis, w the world-frame wind (c₁, c₂) in the body frame

    equation: a = -k\,(v - w)\,|v - w| + k\,v\,|v|,\quad w = R^\top(c_1, c_2)
    feels: slower one way than the other, and more so when fast
    occurs: boats in a current (w is the current, its drag found with it), multirotors and airships in wind, air tables
        with a draught
    """
    x, y = c.unbind(-1)
    cos, sin = state[..., 2].cos(), state[..., 2].sin()
    forward, lateral, _ = self.body_velocity(state)
    along, across = forward - cos * x - sin * y, lateral - cos * y + sin * x
    return {
        "forward": -drag * (along * along.abs() - forward * forward.abs()),
        "lateral": -drag * (across * across.abs() - lateral * lateral.abs()),
    }


@_force("1/kg", typical=0.2, limit=1.0, lacks=_needs_two_thrusters)
def lateral_coupling(self: Any, state: Tensor, control: Tensor, *_: Tensor, c: Tensor) -> dict[str, Tensor]:
    r"""a_lateral = c (left - right)

    equation: a_\mathrm{lateral} = c\,(u_\mathrm{left} - u_\mathrm{right})
    feels: steps sideways when it is told to turn
    occurs: propellers whose wash hits a skeg, a stern that swings, the paddle-wheel effect of a single screw
    """
    left, right = control[..., self.control_index("left")], control[..., self.control_index("right")]
    return {"lateral": c * (left - right)}


@_where_it_slips("rad/m²", typical=0.1, limit=1.0)
def weathervane(self: Any, state: Tensor, *_: Tensor, c: Tensor) -> dict[str, Tensor]:
    r"""a_yaw = -c v_x v_y

    equation: a_\mathrm{yaw} = -c\,v_x v_y
    feels: turns its nose into (or out of) the way it slides
    occurs: airframes with fins (positive) and hulls without (the Munk moment, negative)
    """
    forward, lateral, _ = self.body_velocity(state)
    return {"yaw": -c * forward * lateral}


@_on_any("1", typical=0.15, limit=2.0)
def magnus(self: Any, state: Tensor, *_: Tensor, c: Tensor) -> dict[str, Tensor]:
    r"""a_lateral = -c v_x ω

    equation: a_\mathrm{lateral} = -c\,v_x\,\omega
    feels: curves carry it to the inside (or outside)
    occurs: spinning hulls and balls; the centripetal term of a program that forgot that its frame turns
    """
    forward, _, yaw_rate = self.body_velocity(state)
    return {"lateral": -c * forward * yaw_rate}


@_where_it_slips("m", typical=0.15, limit=1.0)
def lever_arm(self: Any, state: Tensor, *_: Tensor, c: Tensor, mean: Mapping[str, Tensor]) -> dict[str, Tensor]:
    r"""a_forward = c ω², a_lateral = -c a_yaw

    equation: a_\mathrm{forward} = c\,\omega^2,\quad a_\mathrm{lateral} = -c\,a_\mathrm{yaw}
    feels: the tracked point swings around another one when turning
    occurs: a camera, a tag or a GPS antenna that is mounted away from the centre of mass
    """
    yaw_rate = state[..., 5]
    return {"forward": c * yaw_rate**2, "lateral": -c * mean["yaw"]}


@_where_it_slips(
    "1/s",
    typical=0.2,
    limit=5.0,
    sign=1,
    profiled=("lead",),
    choices=lambda program, data: [{"lead": lead} for lead in (0.2, 0.0, 0.5)],
)
def side_slip(self: Any, state: Tensor, *_: Tensor, c: Tensor, lead: Any) -> dict[str, Tensor]:
    r"""a_lateral = -c (v_y - k ω)

    equation: a_\mathrm{lateral} = -c\,(v_y - k\,\omega)
    feels: sideways motion dies out, that of forward motion does not
    occurs: keels, wheels and skids, which let forward motion go on and sideways motion die out
    """
    _, lateral, yaw_rate = self.body_velocity(state)
    return {"lateral": -c * (lateral - lead * yaw_rate)}


@_on_any("1/s", typical=0.5, limit=3.0, sign=1, profiled=("x", "y", "radius"), choices=_places)
def sticky_patch(self: Any, state: Tensor, *_: Tensor, c: Tensor, x: Any, y: Any, radius: Any) -> dict[str, Tensor]:
    r"""a = -c v exp(-d²/2r²), d the distance from a place

    equation: a = -c\,v\,\exp(-d^2 / 2 r^2)
    feels: is braked at one place of the ground
    occurs: a carpet, a puddle, mud or a worn place of the floor
    """
    forward, lateral, _ = self.body_velocity(state)
    inside = (-((state[..., 0] - x) ** 2 + (state[..., 1] - y) ** 2) / (2 * radius**2)).exp()
    return {"forward": -c * forward * inside, "lateral": -c * lateral * inside}


@_on_any("m/s²", typical=0.6, limit=10.0, sign=1, null=math.inf, probes=(0.1, 0.2, 0.4, 0.8, 1.6, 3.2), choices=_limits)
def acceleration_limit(
    self: Any, state: Tensor, *_: Tensor, c: Tensor, channels: Sequence[str], mean: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    r"""|a| ≤ c

    equation: |a| \le c
    feels: never jumps off the line, whatever it is told
    occurs: motor drivers with a ramp or a current limit, tyres at the limit of grip
    """
    return {channel: torch.minimum(torch.maximum(mean[channel], -c), c) - mean[channel] for channel in channels}
