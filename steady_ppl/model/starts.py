"""A start that sees the trajectory: `start = "first measurements"`.

The normal prior of `initial` is then centred, trajectory by trajectory, on what its first measurements say. It is an
empirical Bayes prior: these measurements are used twice. So it keeps the standard deviations of `initial`, which are to
be several times those of the sensors, and it depends on the measurements alone. Models that share sensors and `initial`
have the same prior, and their log p(y) can be compared.
"""

from dataclasses import dataclass
from typing import Any, NoReturn

import pyro.distributions as dist
import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import ProgramError
from steady_ppl.model.handlers import Recording, broadcast_event, normal_moments, running, unwrapped
from steady_ppl.model.program import FIRST_MEASUREMENTS, Program
from steady_ppl.utils.angles import wrap

FIRST_READINGS = 5  # of a component: the line through them withstands one that is wrong
SD_OF_MEDIAN = 1.4826  # standard deviations in a median absolute deviation of normal noise


@dataclass(eq=False)
class Centred(Messenger):
    """Move the prior of `initial` to a `centre`, NaN where nothing is known, and widen it, both `(B, D)`."""

    centre: Tensor
    wider: Tensor

    def _pyro_sample(self, message: Any) -> None:
        mean, sd = _moments(message["fn"], message["name"], self.centre.shape[-1])
        own = slice(message["fn"].event_shape.numel())  # other states rest at the start
        centre, wider = self.centre[:, own], self.wider[:, own]
        message["fn"] = dist.Normal(torch.where(centre.isnan(), mean, centre), torch.hypot(sd, wider)).to_event(1)


def require_centred(started: Recording, width: int) -> None:
    """Raise ProgramError where what `initial` samples, of a state of so many components, cannot be centred."""
    if len(started.distributions) != 1:
        _refuse("start", f"{len(started.distributions)} sites")
    for site, fn in started.distributions.items():
        _moments(fn, site, width)


def _moments(fn: Any, site: str, width: int) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of a start."""
    if fn.event_dim != 1 or fn.event_shape.numel() > width or not isinstance(unwrapped(fn), dist.Normal):
        _refuse(site, f"{type(unwrapped(fn)).__name__} with event shape {tuple(fn.event_shape)}")
    return normal_moments(fn, site)


def _refuse(site: str, has: str) -> NoReturn:
    wanted = "needs initial() to sample the whole state as one normal site with independent components"
    raise ProgramError(f'start = "{FIRST_MEASUREMENTS}" {wanted}; site {site!r} is {has}', site=site)


def first_state(program: Program, data: Trajectories | None) -> Tensor:
    """Sample the start of trajectories, as returned by `for_program`, under whatever handlers there are, `(..., D)`.

    Without data it is `initial` as declared.
    """
    if data is None or program.start != FIRST_MEASUREMENTS:
        return program.initial()
    with Centred(*centre_of_start(program, data)):
        return program.initial()


def draw_first_states(program: Program, data: Trajectories | None, *left: int) -> Tensor:
    """Draw starts of trajectories, `(*left, D)`; the last of `left` is their number."""
    with running(*left):
        return broadcast_event(first_state(program, data), left, 1)


@torch.no_grad()
def centre_of_start(program: Program, data: Trajectories) -> tuple[Tensor, Tensor]:
    """What the first measurements say of the state in the first row, NaN where nothing; and by what standard deviation
    a start may be farther from it than `initial` says; both `(B, D)`.

    A component is where a line through its first readings meets the first row (Theil 1950, Sen 1968). It may be as far
    off as the readings scatter about the line, and as the line moves before the first of them. Its rate of change stays
    as declared, but wider by the slope of the line.
    """
    order, angles = program.state_names, program.angles
    centre = data.controls.new_full((len(data), len(order)), torch.nan)
    wider, told = torch.zeros_like(centre), program.told(data)
    for name, (values, error) in told.items():
        time, readings, farther = _first(data, values, error)
        if name in angles:
            readings = readings[0] + wrap(readings - readings[0])
        apart, later = readings.unsqueeze(0) - readings.unsqueeze(1), time.unsqueeze(0) - time.unsqueeze(1)
        slopes = torch.where(later > 0, apart / later, torch.nan).flatten(0, 1).nanmedian(0).values
        slope = torch.where(farther > 0, 0.0, slopes.nan_to_num(0.0))  # a reading that is far off tells no motion
        begins = readings - slope * time
        index, centre_of = order.index(name), begins.nanmedian(0).values
        scatter = SD_OF_MEDIAN * (begins - centre_of).abs().nanmedian(0).values
        moved = torch.stack([scatter, slope * time[0], farther]).nan_to_num(0.0)
        centre[:, index], wider[:, index] = centre_of, moved.norm(dim=0)
        rate = program.derivatives.get(name)
        if rate is not None and rate not in told:
            wider[:, order.index(rate)] = slope.abs()
    return centre, wider


def _first(data: Trajectories, values: Tensor, error: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Times and values of a component's first readings, `(N, B)`, NaN where there are fewer, and by how much the first
    may be off, `(B,)`."""
    rows = len(values)
    at = torch.arange(rows, device=values.device).unsqueeze(-1)
    seen = torch.where(values.isfinite() & data.rows, at, rows)
    first = seen.topk(min(FIRST_READINGS, rows), dim=0, largest=False).values.sort(0).values
    there, place = first < rows, first.clamp(max=rows - 1)
    time, readings = (torch.where(there, part.gather(0, place), torch.nan) for part in (data.elapsed, values))
    return time, readings, error.expand_as(values).gather(0, place)[0]
