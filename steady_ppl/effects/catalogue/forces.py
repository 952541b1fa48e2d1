"""Forces that a program can lack: on the channels of one axis of any program, and on a vehicle in the plane, there in
its body frame unless said otherwise."""

import itertools
import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.declaration import Choices, Effect, Means, Names, Need, Pushes, declare, has_role, needs
from steady_ppl.effects.sizes import sizes_of_channels, speed_of
from steady_ppl.model.handlers import draw_starts
from steady_ppl.model.planar_vehicle import PlanarVehicle
from steady_ppl.model.program import Program
from steady_ppl.model.roles import controls_of
from steady_ppl.utils.random import seeded

KNEE_SPEED = 0.05  # m/s; a friction's knee where nothing is known of speeds
SHARES_OF_SPEED = (0.1, 0.02)  # of the root mean square speed, that a friction's knee can be
STARTS = 500  # drawn, where nothing else says where a vehicle goes

AXES: Need = (lambda program: program.axes, "the model does not say which channels move what (`motion`)")
SPRINGS: Need = (lambda program: any(p for p, _ in program.motion.values()), "no channel has a position (`motion`)")
BODY: Need = (
    lambda program: {"forward", "lateral"} <= set(program.axes.get("translation", ())),
    "it is no planar vehicle",
)
ONE_COMPONENT: Need = (lambda program: not BODY[0](program), "it has two components there")
YAW: Need = (lambda program: "yaw" in program.axes, "there is no yaw channel")
PLANAR: Need = (lambda program: isinstance(program, PlanarVehicle), "it acts on vehicles in the plane only")
SLIP: Need = (lambda program: program.slips, "the model holds the lateral velocity at zero")
THRUSTS = (has_role("left"), has_role("right"))


def _each(groups: Mapping[str, Names]) -> Choices:
    """Each group of channels, at its name unless there is one only."""
    return [{"channels": channels, **({"at": name} if len(groups) > 1 else {})} for name, channels in groups.items()]


def _axes(program: Program, data: Trajectories | None) -> Choices:
    return _each({name: channels for name, channels in program.axes.items() if name != "yaw"})


def _springs(program: Program, data: Trajectories | None) -> Choices:
    return _each({channel: (channel,) for channel, (position, _) in program.motion.items() if position})


def three_digits(value: float) -> float:
    """As it is written."""
    return float(f"{value:.3g}")


def _axes_and_knees(program: Program, data: Trajectories | None) -> Choices:
    """A friction's knee is somewhere below the speeds that were driven."""
    choices = []
    for group in _axes(program, data):
        speed = speed_of(program, data, group["channels"])
        knees = [three_digits(share * speed) for share in SHARES_OF_SPEED] if speed > 0 else [KNEE_SPEED]
        choices += [{**group, "knee": knee} for knee in knees]
    return choices


def _drags(program: Program, data: Trajectories | None) -> Choices:
    """Drags of which wind could be felt: they brake the usual speed by a share of what is commanded."""
    speed, commanded = speed_of(program, data, program.axes["translation"]), 0.0
    if data is not None and speed > 0:
        commanded = max(sizes_of_channels(program, data)[channel] for channel in program.axes["translation"])
    unit = commanded / speed**2 if commanded > 0 else 0.2
    return [{"drag": three_digits(share * unit)} for share in (0.3, 0.1, 1.0)]


def _leads(program: Program, data: Trajectories | None) -> Choices:
    """How far ahead of the tracked point the one is that does not slide, in shares of a usual radius of turning."""
    speed, turn = (speed_of(program, data, program.axes[axis]) for axis in ("translation", "yaw"))
    if not (speed > 0 and turn > 0):
        return [{"lead": lead} for lead in (0.2, 0.0, 0.5)]
    return [{"lead": three_digits(share * speed / turn)} for share in (0.1, 0.0, 0.3)]


def _limits(program: Program, data: Trajectories | None) -> Choices:
    return [{"channels": program.axes["translation"]}, {"channels": program.axes["yaw"], "at": "yaw"}]


def _places(program: Program, data: Trajectories | None) -> Choices:
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
    with seeded("starts"):
        return draw_starts(program, 1, STARTS)


FORCES: list[Effect] = []
_force = partial(declare, FORCES, "push")
_on_axes = partial(_force, choices=_axes, lacks=needs(AXES))
_on_yaw = partial(_force, choices=lambda program, data: [{"channels": program.axes["yaw"]}], lacks=needs(YAW))
_on_springs = partial(_force, choices=_springs, lacks=needs(SPRINGS))
_where_it_slips = partial(_force, lacks=needs(PLANAR, SLIP))
_on_any = partial(_force, lacks=needs(PLANAR))


@_on_axes("1/s", typical=0.12, limit=1.0, sign=1)
def linear_drag(self: Program, state: Tensor, *_: Tensor, c: Tensor, channels: Names) -> Pushes:
    r"""a = -c v

    equation: a = -c\,v
    feels: coasts to rest like in oil: half the speed, half the braking
    occurs: slow motion through something viscous: joints in grease, small boats, gliders at low speed, an eddy-current
        brake
    """
    velocity = self.velocities(state)
    return {channel: -c * velocity[channel] for channel in channels}


@_on_axes("1/m", typical=0.06, limit=0.5, sign=1)
def quadratic_drag(self: Program, state: Tensor, *_: Tensor, c: Tensor, channels: Names) -> Pushes:
    r"""a = -c v |v| per axis

    equation: a = -c\,v\,|v|
    feels: top speed is capped, slow motion is free
    occurs: hulls, airframes and cars at speed, where the wake costs energy (Reynolds numbers well above 1000)
    """
    velocity = self.velocities(state)
    return {channel: -c * velocity[channel] * velocity[channel].abs() for channel in channels}


@_force(
    "m/s²",
    typical=0.1,
    limit=1.0,
    sign=1,
    profiled=("knee",),
    by_factor=("knee",),
    choices=_axes_and_knees,
    lacks=needs(AXES),
)
def coulomb_friction(self: Program, state: Tensor, *_: Tensor, c: Tensor, channels: Names, knee: Any) -> Pushes:
    r"""a = -c v / sqrt(v² + knee²)

    equation: a = -c\,v / \sqrt{v^2 + v_0^2}
    feels: brakes the same at any speed, then stops dead
    occurs: rolling resistance of tyres (Wong 2008), sledges, tracked robots, a dragging brake, guides and ball screws
    """
    velocity = self.velocities(state)
    return {channel: -c * velocity[channel] * (velocity[channel] ** 2 + knee**2).rsqrt() for channel in channels}


@_on_yaw("1/s", typical=0.15, limit=2.0, sign=1)
def yaw_linear_drag(self: Program, *given: Tensor, c: Tensor, channels: Names) -> Pushes:
    r"""a_yaw = -c ω

    equation: a_\mathrm{yaw} = -c\,\omega
    feels: stops turning by itself
    occurs: boats, hovercraft and multirotors that turn slowly; damping of a bearing or a rotor's wash
    """
    return linear_drag(self, *given, c=c, channels=channels)


@_on_yaw("1/rad", typical=0.25, limit=3.0, sign=1)
def yaw_quadratic_drag(self: Program, *given: Tensor, c: Tensor, channels: Names) -> Pushes:
    r"""a_yaw = -c ω |ω|

    equation: a_\mathrm{yaw} = -c\,\omega\,|\omega|
    feels: fast spins are capped, slow ones go on
    occurs: hulls and fins that are swept sideways through water or air when turning fast
    """
    return quadratic_drag(self, *given, c=c, channels=channels)


@_on_yaw("rad/s²", typical=0.04, limit=0.5)
def yaw_bias(self: Program, state: Tensor, *_: Tensor, c: Tensor, channels: Names) -> Pushes:
    r"""a_yaw = c

    equation: a_\mathrm{yaw} = c
    feels: pulls to one side with the controls at rest
    occurs: one propeller's torque reaction, a bent rudder or skeg, a tether that twists
    """
    return dict.fromkeys(channels, c + torch.zeros_like(state[..., 0]))


@_force("m/s²", typical=0.05, limit=0.5, choices=_axes, lacks=needs(ONE_COMPONENT, AXES))
def acceleration_bias(self: Program, *given: Tensor, c: Tensor, channels: Names) -> Pushes:
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
    lacks=needs(BODY),
)
def planar_acceleration_bias(self: Program, state: Tensor, *_: Tensor, c: Tensor) -> Pushes:
    r"""(a_forward, a_lateral) = (c₁, c₂)

    equation: (a_\mathrm{forward}, a_\mathrm{lateral}) = (c_1, c_2)
    feels: creeps one way in its own frame, whichever way it points
    occurs: a load that hangs to one side, thrusters that are mounted at an angle, an inertial unit that is not level
    """
    still = torch.zeros_like(state[..., 0])
    return {"forward": c[..., 0] + still, "lateral": c[..., 1] + still}


@_on_springs("1/s²", typical=2.0, limit=50.0)
def stiffness(self: Program, state: Tensor, *_: Tensor, c: Tensor, channels: Names) -> Pushes:
    r"""a = -c x

    equation: a = -c\,x
    feels: is drawn back to the origin, like by a spring
    occurs: moorings, springs and belts, a pendulum near its rest, a tether under tension
    """
    position = self.positions(state)
    return {channel: -c * position[channel] for channel in channels}


@_on_springs("1/(m² s²)", typical=3.0, limit=100.0)
def cubic_stiffness(self: Program, state: Tensor, *_: Tensor, c: Tensor, channels: Names) -> Pushes:
    r"""a = -c x³

    equation: a = -c\,x^3
    feels: free near the origin, a wall far from it
    occurs: rubber mounts, a belt that tightens, clamped beams at large deflections (the Duffing oscillator)
    """
    position = self.positions(state)
    return {channel: -c * position[channel] ** 3 for channel in channels}


@_on_any("m/s²", typical=(0.05, -0.03), limit=0.5, components=("x", "y"))
def slope(self: Program, state: Tensor, *_: Tensor, c: Tensor) -> Pushes:
    r"""world-frame acceleration (c₁, c₂), of vehicles that do not slip its forward component

    equation: \dot v_\mathrm{world} = (c_1, c_2)
    feels: drifts the same way over ground, wherever it points
    occurs: ramps and floors that are not level; what a current does to a boat that is slow to drift with it
    """
    x, y = c.unbind(-1)
    cos, sin = state[..., 2].cos(), state[..., 2].sin()
    return {"forward": cos * x + sin * y, **({"lateral": cos * y - sin * x} if self.slips else {})}


@_where_it_slips(
    "m/s",
    typical=(1.0, 0.5),
    limit=10.0,
    components=("x", "y"),
    profiled=("drag",),
    by_factor=("drag",),
    choices=_drags,
)
def wind(self: Program, state: Tensor, *_: Tensor, c: Tensor, drag: Any) -> Pushes:
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


@_force("1/kg", typical=0.2, limit=1.0, lacks=needs(PLANAR, *THRUSTS))
def lateral_coupling(self: Program, state: Tensor, control: Tensor, *_: Tensor, c: Tensor) -> Pushes:
    r"""a_lateral = c (left - right)

    equation: a_\mathrm{lateral} = c\,(u_\mathrm{left} - u_\mathrm{right})
    feels: moves sideways when it is steered
    occurs: propellers whose wash hits a skeg, a stern that swings, the paddle-wheel effect of a single screw
    """
    left, right = (control[..., self.control_index(name)] for name in controls_of(self, "left", "right"))
    return {"lateral": c * (left - right)}


@_where_it_slips("rad/m²", typical=0.1, limit=1.0)
def weathervane(self: Program, state: Tensor, *_: Tensor, c: Tensor) -> Pushes:
    r"""a_yaw = -c v_x v_y

    equation: a_\mathrm{yaw} = -c\,v_x v_y
    feels: turns its nose into (or out of) the way it slides
    occurs: airframes with fins (positive) and hulls without (the Munk moment, negative)
    """
    forward, lateral, _ = self.body_velocity(state)
    return {"yaw": -c * forward * lateral}


@_on_any("1", typical=0.15, limit=2.0)
def magnus(self: Program, state: Tensor, *_: Tensor, c: Tensor) -> Pushes:
    r"""a_lateral = -c v_x ω

    equation: a_\mathrm{lateral} = -c\,v_x\,\omega
    feels: curves carry it to the inside (or outside)
    occurs: spinning hulls and balls; the added mass of hulls (the u r term of Fossen 2011, chapter 6); the centripetal
        term of a model that forgot that its frame turns
    """
    forward, _, yaw_rate = self.body_velocity(state)
    return {"lateral": -c * forward * yaw_rate}


@_where_it_slips("1", typical=0.3, limit=2.0)
def added_mass(self: Program, state: Tensor, *_: Tensor, c: Tensor) -> Pushes:
    r"""a_forward = c v_y ω

    equation: a_\mathrm{forward} = c\,v_y\,\omega
    feels: loses more speed than by drag in turns in which it slides outwards
    occurs: hulls and airships, which carry more water or air along sideways than ahead (the v r term of Fossen 2011,
        chapter 6)
    """
    _, lateral, yaw_rate = self.body_velocity(state)
    return {"forward": c * lateral * yaw_rate}


@_where_it_slips("1/m", typical=0.2, limit=2.0, sign=1)
def cross_flow(self: Program, state: Tensor, *_: Tensor, c: Tensor) -> Pushes:
    r"""a_lateral = -c v_y |v_y|

    equation: a_\mathrm{lateral} = -c\,v_y\,|v_y|
    feels: fast sideways motion dies out, slow sideways motion and forward motion do not
    occurs: hulls and pontoons that are swept sideways through water (cross-flow drag, Fossen 2011, chapter 6)
    """
    _, lateral, _ = self.body_velocity(state)
    return {"lateral": -c * lateral * lateral.abs()}


@_where_it_slips("m", typical=0.15, limit=1.0)
def lever_arm(self: Program, state: Tensor, *_: Tensor, c: Tensor, mean: Means) -> Pushes:
    r"""a_forward = c ω², a_lateral = -c a_yaw

    equation: a_\mathrm{forward} = c\,\omega^2,\quad a_\mathrm{lateral} = -c\,a_\mathrm{yaw}
    feels: the tracked point swings around another one when turning
    occurs: a camera, a tag or a GPS antenna that is mounted away from the centre of mass
    """
    return {"forward": c * state[..., 5] ** 2, "lateral": -c * mean["yaw"]}


@_where_it_slips("1/s", typical=0.2, limit=5.0, sign=1, profiled=("lead",), choices=_leads)
def side_slip(self: Program, state: Tensor, *_: Tensor, c: Tensor, lead: Any) -> Pushes:
    r"""a_lateral = -c (v_y - k ω)

    equation: a_\mathrm{lateral} = -c\,(v_y - k\,\omega)
    feels: sideways motion dies out, that of forward motion does not
    occurs: keels, wheels and skids, which let forward motion go on and sideways motion die out
    """
    _, lateral, yaw_rate = self.body_velocity(state)
    return {"lateral": -c * (lateral - lead * yaw_rate)}


@_on_any("1/s", typical=0.5, limit=3.0, sign=1, profiled=("x", "y", "radius"), choices=_places)
def sticky_patch(self: Program, state: Tensor, *_: Tensor, c: Tensor, x: Any, y: Any, radius: Any) -> Pushes:
    r"""a = -c v exp(-d²/2r²), d the distance from a place

    equation: a = -c\,v\,\exp(-d^2 / 2 r^2)
    feels: is braked at one place of the ground
    occurs: a carpet, a puddle, mud or a worn place of the floor
    """
    forward, lateral, _ = self.body_velocity(state)
    inside = (-((state[..., 0] - x) ** 2 + (state[..., 1] - y) ** 2) / (2 * radius**2)).exp()
    return {"forward": -c * forward * inside, "lateral": -c * lateral * inside}


@_on_any("m/s²", typical=0.6, limit=10.0, sign=1, null=math.inf, probes=(0.1, 0.2, 0.4, 0.8, 1.6, 3.2), choices=_limits)
def acceleration_limit(self: Program, state: Tensor, *_: Tensor, c: Tensor, channels: Names, mean: Means) -> Pushes:
    r"""a → a / (1 + |a/c|⁴)^¼, so that |a| ≤ c

    equation: a \to a\,(1 + |a / c|^4)^{-1/4}
    feels: never jumps off the line, whatever the command
    occurs: motor drivers with a ramp or a current limit, tyres at the limit of grip
    """
    return {channel: _limited(mean[channel], c) - mean[channel] for channel in channels}


def _limited(value: Tensor, most: Tensor) -> Tensor:
    """A value that stays within a limit, rounded where it reaches it, so that linearisations on both sides agree."""
    within = torch.minimum(torch.maximum(value, -most), most)
    share = within.abs() / torch.maximum(value.abs(), most)
    return within / (1 + share.square().square()).sqrt().sqrt()
