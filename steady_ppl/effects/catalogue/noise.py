"""What noise can be besides normal, constant and white."""

from collections import defaultdict
from functools import partial
from itertools import takewhile

from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.catalogue.forces import PLANAR
from steady_ppl.effects.catalogue.sensors import (
    LANDMARKS,
    LISTED,
    SEES_LANDMARKS,
    Columns,
    among,
    beside,
    each_sensor,
    lists_sensors,
)
from steady_ppl.effects.catalogue.wheels import SPEED_AND_TURN
from steady_ppl.effects.declaration import Choices, Effect, Names, Need, Pushes, declare, needs
from steady_ppl.model.planar_vehicle import PlanarVehicle
from steady_ppl.model.program import Program
from steady_ppl.model.roles import controls_of

CHANNELS: Need = (lambda program: program.channels, "the model has no noise channels")
MOTION: Need = (
    lambda program: isinstance(program, PlanarVehicle) or program.motion,
    "the model does not say which channels move what (`motion`)",
)
MEASURED: Need = (lambda program: program.measurements, "the model measures nothing")


def _groups(program: Program, data: Trajectories | None) -> Choices:
    if len(program.axes) <= 1:
        return [{"channels": program.channel_names}]
    return [{"channels": channels, "at": name} for name, channels in program.axes.items()]


def _quantities(program: Program, data: Trajectories | None) -> Choices:
    """Each sensor that the program lists, and the other measurements in one unit together, called by what their names
    have in common."""
    listed = each_sensor()(program, data) if lists_sensors(program) else []
    known = {index for one in listed for index in one["columns"]}
    columns = defaultdict[str, list[int]](list)
    for index, unit in enumerate(program.measurement_units):
        if index not in known:
            columns[unit].append(index)
    if listed and not columns:
        return listed
    if len(columns) == 1 and not listed:
        return [{}]
    names = [[program.measurement_names[index] for index in found] for found in columns.values()]
    letters = [takewhile(lambda at: len(set(at)) == 1, zip(*found, strict=False)) for found in names]
    begins = ["".join(letter for letter, *_ in same).rstrip("_0123456789") for same in letters]
    common = [begin or "_".join(found[:3]) for begin, found in zip(begins, names, strict=True)]
    called = common if len(set(common)) == len(common) else [found[0] for found in names]
    others = [{"columns": tuple(found), "at": at} for found, at in zip(columns.values(), called, strict=True)]
    return [*listed, *others]


NOISE: list[Effect] = []
_noise = partial(declare, NOISE)


def _all_or_one(program: Program, data: Trajectories | None) -> Choices:
    listed = each_sensor()(program, data) if lists_sensors(program) else []
    return [{}, *(one for one in listed if "at" in one)]


@_noise("tails", "1", typical=1 / 3, limit=0.5, sign=1, between=(0.0, 0.49), choices=_all_or_one)
def heavy_tails(self: Program, c: Tensor, columns: Columns = ()) -> Tensor:
    r"""Student t measurement noise with ν = 1/c degrees of freedom, of all measurements or of one sensor

    equation: y \sim t_\nu,\quad c = 1/\nu
    feels: now and then a measurement is far off
    occurs: reflections (multipath), wrong associations of detections, a loose contact
    """
    return c.clamp(0.005, 0.49)


@_noise("blur", "1", typical=1.5, limit=2.0, sign=1, null=1.0, choices=_quantities, lacks=needs(MEASURED))
def measurement_noise(self: Program, state: Tensor, c: Tensor, columns: tuple[int, ...] = ()) -> Tensor:
    r"""σ → c σ of the measurements in one unit, or of one sensor

    equation: \sigma \to c\,\sigma
    feels: sees worse (or better) than its data sheet says
    occurs: a data sheet for other light, distance or temperature than the sensor has
    """
    count = len(self.measurements)
    return (1 + (c - 1) * among(columns, c.new_zeros(count))).expand(*state.shape[:-1], count)


@_noise(
    "blur", "1/m", typical=0.1, limit=1.0, sign=1, choices=each_sensor(*SEES_LANDMARKS), lacks=needs(PLANAR, LANDMARKS)
)
def range_dependent_noise(self: Program, state: Tensor, c: Tensor, columns: Columns = ()) -> Tensor:
    r"""σ → σ (1 + c r), r the distance

    equation: \sigma \to \sigma\,(1 + c\,r)
    feels: far landmarks are seen worse
    occurs: cameras (a pixel covers more), radios (less signal), stereo depth
    """
    away = self.ranges(state)
    if columns:
        away = beside(away, columns, len(self.measurements))
    return (1 + c * away).clamp(min=0.05)


@_noise("blur", "s/m", typical=0.3, limit=5.0, sign=1, choices=each_sensor(), lacks=needs(LISTED))
def speed_dependent_noise(self: Program, state: Tensor, c: Tensor, columns: Columns) -> Tensor:
    r"""σ → σ (1 + c v), v the speed, one sensor

    equation: \sigma \to \sigma\,(1 + c\,v)
    feels: sees worse while it moves
    occurs: cameras that blur, sensors that shake, wheels that skip
    """
    forward, lateral, _ = self.body_velocity(state)
    speed = (forward.square() + lateral.square() + 1e-8).sqrt().unsqueeze(-1)
    return (1 + c * speed * among(columns, state.new_zeros(len(self.measurements)))).clamp(min=0.05)


@_noise("spread", "1", typical=2.0, limit=2.0, sign=1, null=1.0, choices=_groups, lacks=needs(CHANNELS))
def process_noise(self: Program, *_: Tensor, c: Tensor, channels: Names) -> Pushes:
    r"""σ → c σ of a channel

    equation: \sigma \to c\,\sigma
    feels: rougher (or smoother) than the model says
    occurs: a floor, a sea or a wind that is rougher than was thought; whatever else a model leaves out
    """
    return dict.fromkeys(channels, c)


@_noise("spread", "s/m", typical=1.0, limit=5.0, sign=1, lacks=needs(PLANAR, *SPEED_AND_TURN))
def command_noise(self: Program, state: Tensor, control: Tensor, *_: Tensor, c: Tensor) -> Pushes:
    r"""σ → σ (1 + c |command - state|)

    equation: \sigma \to \sigma\,(1 + c\,|u - v|)
    feels: erratic while it catches up with its command
    occurs: speed controllers that slip and jerk while they accelerate
    """
    forward, _, yaw_rate = self.body_velocity(state)
    speed, turn = (control[..., self.control_index(name)] for name in controls_of(self, "speed", "turn"))
    slow, askew = (speed - forward).abs(), (turn - yaw_rate).abs()
    return {"forward": (1 + c * slow).clamp(min=0.05), "yaw": (1 + c * askew).clamp(min=0.05)}


@_noise("colour", "1", typical=0.6, limit=0.9, between=(-0.99, 0.99), choices=_groups, lacks=needs(MOTION))
def coloured_noise(self: Program, c: Tensor, channels: Names) -> Pushes:
    r"""noise(t+1) = c noise(t) + sqrt(1 - c²) σ ε

    equation: n_{t+1} = c\,n_t + \sqrt{1 - c^2}\,\sigma\,\varepsilon
    feels: is pushed for seconds, not shaken
    occurs: gusts, waves and turbulence, whose pushes last; ground that undulates
    """
    return {channel: c.clamp(-0.99, 0.99) for channel in channels}
