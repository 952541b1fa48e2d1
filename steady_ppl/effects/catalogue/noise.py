"""What the noise can be besides normal, constant and white."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.catalogue.planar_forces import no_bearings
from steady_ppl.effects.catalogue.wheels import needs_commanded_speed
from steady_ppl.effects.declaration import Effect
from steady_ppl.model.planar_vehicle import PlanarVehicle
from steady_ppl.model.program import Program


def _groups(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    if len(program.axes) <= 1:
        return [{"channels": program.channel_names}]
    return [{"channels": channels, "at": name} for name, channels in program.axes.items()]


def _no_channels(program: Program) -> str | None:
    return None if program.channels else "the program has no noise channels"


def _no_states_left(program: Program) -> str | None:
    if isinstance(program, PlanarVehicle) or program.motion:
        return None
    return "the program does not say which channels move what (`motion`)"


def _nothing_measured(program: Program) -> str | None:
    return None if program.measurements else "the program measures nothing"


def heavy_tails(self: Any, c: Tensor) -> Tensor:
    return c.clamp(0.005, 0.49)


def measurement_noise(self: Any, state: Tensor, c: Tensor) -> Tensor:
    return c.expand(*state.shape[:-1], len(self.measurements))


def range_dependent_noise(self: Any, state: Tensor, c: Tensor) -> Tensor:
    return (1 + c * self.ranges(state)).clamp(min=0.05)


def process_noise(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor, channels: Sequence[str]
) -> dict[str, Tensor]:
    return dict.fromkeys(channels, c)


def command_noise(
    self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor, c: Tensor
) -> dict[str, Tensor]:
    forward, _, yaw_rate = self.body_velocity(state)
    speed, turn = control[..., self.control_index("speed")], control[..., self.control_index("turn")]
    slow, askew = (speed - forward).abs(), (turn - yaw_rate).abs()
    return {"forward": (1 + c * slow).clamp(min=0.05), "yaw": (1 + c * askew).clamp(min=0.05)}


def coloured_noise(self: Any, c: Tensor, channels: Sequence[str]) -> dict[str, Tensor]:
    return {channel: c.clamp(-0.99, 0.99) for channel in channels}


NOISES = [
    Effect(
        name="heavy_tails",
        form="tails",
        equation=r"y \sim t_\nu,\quad c = 1/\nu",
        text="Student t measurement noise with ν = 1/c degrees of freedom",
        unit="1",
        feels="now and then a measurement is far off",
        occurs="reflections (multipath), wrong associations of detections, a loose contact",
        function=heavy_tails,
        typical=1 / 3,
        limit=0.5,
        sign=1,
        between=(0.0, 0.49),
    ),
    Effect(
        name="measurement_noise",
        form="blur",
        equation=r"\sigma \to c\,\sigma",
        text="σ → c σ of every measurement",
        unit="1",
        feels="sees worse (or better) than its data sheet says",
        occurs="a data sheet for other light, distance or temperature than the sensor has",
        function=measurement_noise,
        typical=1.5,
        limit=2.0,
        sign=1,
        null=1.0,
        lacks=_nothing_measured,
    ),
    Effect(
        name="range_dependent_noise",
        form="blur",
        equation=r"\sigma \to \sigma\,(1 + c\,r)",
        text="σ → σ (1 + c r), r the distance",
        unit="1/m",
        feels="far landmarks are seen worse",
        occurs="cameras (a pixel covers more), radios (less signal), stereo depth",
        function=range_dependent_noise,
        typical=0.1,
        limit=1.0,
        sign=1,
        lacks=no_bearings,
    ),
    Effect(
        name="process_noise",
        form="spread",
        equation=r"\sigma \to c\,\sigma",
        text="σ → c σ of a channel",
        unit="1",
        feels="rougher (or smoother) than the program says",
        occurs="a floor, a sea or a wind that is rougher than was thought; whatever else a program leaves out",
        function=process_noise,
        typical=2.0,
        limit=2.0,
        sign=1,
        null=1.0,
        choices=_groups,
        lacks=_no_channels,
    ),
    Effect(
        name="command_noise",
        form="spread",
        equation=r"\sigma \to \sigma\,(1 + c\,|u - v|)",
        text="σ → σ (1 + c |command - state|)",
        unit="s/m",
        feels="erratic while it catches up with its command",
        occurs="speed controllers that slip and jerk while they accelerate",
        function=command_noise,
        typical=1.0,
        limit=5.0,
        sign=1,
        lacks=needs_commanded_speed,
    ),
    Effect(
        name="coloured_noise",
        form="colour",
        equation=r"n_{t+1} = c\,n_t + \sqrt{1 - c^2}\,\sigma\,\varepsilon",
        text="noise(t+1) = c noise(t) + sqrt(1 - c²) σ ε",
        unit="1",
        feels="is pushed for seconds, not shaken",
        occurs="gusts, waves and turbulence, whose pushes last; ground that undulates",
        function=coloured_noise,
        typical=0.6,
        limit=0.9,
        between=(-0.99, 0.99),
        choices=_groups,
        lacks=_no_states_left,
    ),
]
