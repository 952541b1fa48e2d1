"""Move a program by one row of a table in several substeps, with one draw of noise a row and channel.

With `substeps = K` a row takes K steps of `transition`, each of a K-th of its time. The first one samples the channels;
the others reuse its standardised noise, so that a row still has one latent draw a channel. Effects, actuators and user
code act in every substep. K = 1 is the program itself.

A row's channel is what it is on average over the substeps. Its site has the mean of a row without noise. Its standard
deviation is what one of its own noise, held over the row, changes of that mean, a tenth at least: a program that takes
noise back leaves less of it. A slope in a parameter is then that of a row's average. What is left out is when in the
row the noise came, and what it does to other channels.
"""

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from numbers import Integral
from typing import Any, NamedTuple

import pyro
import pyro.distributions as dist
import torch
from pyro import poutine
from pyro.poutine.messenger import Messenger
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import ProgramError, UsageError
from steady_ppl.kernels.chains import Chain, Step
from steady_ppl.model.actuation import row_spans
from steady_ppl.model.handlers import AtMean, Recording, Standardised, joined, parted, running, unwrapped, with_moments
from steady_ppl.model.program import Program
from steady_ppl.utils.context import bound

MAX_SUBSTEPS = 1000  # of a row
MIN_SHARE_OF_SD = 0.1  # of a channel in a substep, that it has on average over a row at least
MIN_SHARE_OF_PUSH = 1e-3  # of a channel's location, that is pushed at least to be seen in 32 bits
_Part = tuple[tuple[Tensor, Tensor, Tensor], "_Place"]


class _Place(NamedTuple):
    """Where in its row a substep is."""

    begins: bool
    ends: bool


_WHOLE_ROW = _Place(begins=True, ends=True)
_PLACE: ContextVar[_Place] = ContextVar("place in the row", default=_WHOLE_ROW)


def with_substeps(program: Program, count: int) -> Program:
    """Return a copy of a program that takes `count` substeps a row; UsageError unless it is whole, from 1 to 1000."""
    if not is_count(count):
        raise UsageError(f"substeps must be a whole number from 1 to {MAX_SUBSTEPS}, got {count!r}")
    changed = copy.deepcopy(program)
    changed.substeps = int(count)
    return changed


def is_count(value: object) -> bool:
    """Whether a value can be a number of substeps."""
    return isinstance(value, Integral) and not isinstance(value, bool) and 1 <= int(value) <= MAX_SUBSTEPS


def row_ends() -> bool:
    """Whether the `transition` that runs now is the last one of its row."""
    return _PLACE.get().ends


def row_begins() -> bool:
    """Whether the `transition` that runs now is the first one of its row."""
    return _PLACE.get().begins


def advance(program: Program, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Tensor:
    """Return the state `(..., D)` after a row; handlers meet the channels' sites of the first substep.

    Args:
        state: `(..., D)`.
        control: `(..., U)`, held over the row, or `(..., K U)` as `acting_controls` gives them.
        time: `(...)` s since the trajectory's first row.
        step: `(...)` s, of the row.

    Raises:
        ProgramError: with more than one substep, a channel's noise has no location and scale.
    """
    if program.substeps == 1:
        return program.transition(state, control, time, step)
    (first, place), *others = _parts(program, control, time, step)
    with Recording() as seen, within_row(*place):
        state = program.transition(state, *first)
    noise = {site: standardised(fn, seen.values[site], site) for site, fn in seen.distributions.items()}
    for after, _ in _through(program, state, others, noise):
        state = after
    return state


def mean_step(program: Program, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Tensor:
    """Return where a row ends without noise; arguments and result are those of `advance`."""
    with running(*state.shape[:-1]), AtMean():
        return advance(program, state, control, time, step)


def noisy_step(program: Program, state: Tensor, noise: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Tensor:
    """Return where a row ends under noise `(..., C)` in standard deviations; the rest is as in `advance`."""
    with running(*state.shape[:-1]), Standardised(noise):
        return advance(program, state, control, time, step)


def row_chain(program: Program, state: Tensor, noise: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Chain:
    """Return `noisy_step` of rows `(rows, B, ·)` as a chain of substeps."""
    steps = []
    for given, place in _parts(program, control, time, step):
        name = "the last substep" if place.ends else "the first substep" if place.begins else "a substep"
        named = dict(zip(("control", "time", "step"), given, strict=True))
        steps.append(Step(name, partial(_noisy_substep, program, place), named))
    return Chain(steps, ("state", state), ("noise", noise))


def sample_channels(program: Program, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> None:
    """Sample a row's channels at their sites, and move nowhere; arguments are those of `advance`."""
    if program.substeps == 1:
        program.transition(state, control, time, step)
    else:
        _sample(program, state, control, time, step)


def sample_row(program: Program, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Tensor:
    """Sample a row's channels at their sites and move on with them; arguments and result are those of `advance`."""
    if program.substeps == 1:
        return program.transition(state, control, time, step)
    noise = _sample(program, state, control, time, step)
    for after, _ in _through(program, state, _parts(program, control, time, step), noise):
        state = after
    return state


@torch.no_grad()
def channel_values(
    program: Program, data: Trajectories, states: Tensor, noise: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Return what channels are, by site as `noise`, along states `(M, T + 1, B, D)` of data for the program.

    `noise` is site → `(M, T, B, ...)`, in standard deviations.
    """
    before = states[..., :-1, :, :]
    with running(*before.shape[:-1]):
        channels = _on_average(program, before, *row_inputs(program, data))
    moments = {site: location_and_scale(fn, site) for site, fn in channels.items()}
    return {site: loc + scale * noise[site] for site, (loc, scale) in moments.items()}


def channel_scales(program: Program, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Tensor:
    """Return by what channels vary within a substep, on average over a row without noise, `(..., C)`; see `advance`.

    A push of this size, held over a row, moves its end as one standard deviation of noise does.
    """
    found = []
    for _, seen in _through(program, state, _parts(program, control, time, step), 0.0):
        scales = {site: location_and_scale(fn, site)[1] for site, fn in seen.distributions.items()}
        found.append(joined(scales, seen.distributions, state.shape[:-1]))
    return _mean(found)


class RowInputs(NamedTuple):
    """What a program is given beside its state in each row, in the order of `advance`."""

    control: Tensor  # (T, B, U), or (T, B, K U) as `acting` gives them
    time: Tensor  # (T, B) s since the trajectory's first row
    step: Tensor  # (T, B) s


def row_inputs(program: Program, data: Trajectories) -> RowInputs:
    """Return what drives give the program in every row that it moves on from."""
    return RowInputs(acting_controls(program, data)[:-1], data.elapsed[:-1], data.steps)


def all_rows(program: Program, data: Trajectories, **along: Tensor) -> dict[str, Tensor]:
    """Return points `(P, T, B, ·)` by name and `row_inputs` there, all rows of all points in front: `(P T, B, ·)`."""
    count = len(next(iter(along.values())))
    given = {name: value.expand(count, *value.shape) for name, value in row_inputs(program, data)._asdict().items()}
    return {name: value.flatten(0, 1) for name, value in (along | given).items()}


def acting_controls(program: Program, data: Trajectories) -> Tensor:
    """Return the controls of drives as they act on the program, `(T + 1, B, U)`; see `acting`."""
    return acting(program, data.controls, data.elapsed)


def acting(program: Program, commands: Tensor, elapsed: Tensor) -> Tensor:
    """Return what actuators make of commands `(rows, B, U)` at `elapsed` s `(rows, B)`.

    It is as `commands`, or where they change within a row the substeps' controls side by side, `(…, K U)`.
    """
    count = program.substeps
    if count == 1 or not program.acts_on_commands or len(elapsed) < 2:
        return program.actuators(commands, elapsed)
    rows, drives, controls = commands.shape
    shares = torch.arange(count, dtype=elapsed.dtype, device=elapsed.device) / count
    times = (elapsed.unsqueeze(1) + shares[:, None] * row_spans(elapsed).unsqueeze(1)).flatten(0, 1)
    act = program.actuators(program.between_rows(commands, elapsed), times)
    return act.unflatten(0, (rows, count)).movedim(1, 2).reshape(rows, drives, count * controls)


def row_controls(program: Program, control: Tensor) -> Tensor:
    """Return acting controls averaged over each row's substeps, `(..., U)` of `(..., U)` or `(..., K U)`."""
    controls = len(program.controls)
    if control.shape[-1] == controls:
        return control
    return control.unflatten(-1, (program.substeps, controls)).mean(-2)


def within_row(begins: bool = False, ends: bool = False) -> AbstractContextManager[None]:
    """Run a `transition` as one that no row begins or ends with, so that what counts rows stays as it is; unless it
    `begins` or `ends` one."""
    return bound(_PLACE, _Place(begins, ends))


@dataclass(eq=False)
class Held(Messenger):
    """Give channels the noise that a row already has: site → value in scales, or one value for every site."""

    noise: Mapping[str, Tensor] | float

    def _pyro_sample(self, message: Any) -> None:
        if message["is_observed"]:
            return
        loc, scale = location_and_scale(message["fn"], message["name"])
        noise = self.noise if isinstance(self.noise, float) else self.noise[message["name"]]
        message["value"] = loc + scale * noise


def location_and_scale(fn: Any, site: str) -> tuple[Tensor, Tensor]:
    """Return location and scale of a channel's distribution, each `(...)` or `(..., C)`; ProgramError without them."""
    base = unwrapped(fn)
    if not isinstance(base, dist.Normal | dist.StudentT | dist.Laplace | dist.Cauchy):
        kinds = "with a location and a scale (Normal, StudentT, Laplace, Cauchy), which can be held over a row"
        what = f"site {site!r} is {type(base).__name__}: substeps need channel noise {kinds}"
        raise ProgramError(what, site=site)
    return base.loc, base.scale


def standardised(fn: Any, value: Tensor, site: str) -> Tensor:
    """Return a channel's value in scales from its location; 0 where it has no noise."""
    loc, scale = location_and_scale(fn, site)
    return (value - loc) / torch.where(scale > 0, scale, torch.ones_like(scale))


def _parts(program: Program, control: Tensor, time: Tensor, step: Tensor) -> Iterator[_Part]:
    """Control, time and step of every substep, and its place in the row.

    Its first one has a place of its own only where the program keeps something of its row: each place is a kernel.
    """
    count, controls = program.substeps, len(program.controls)
    short = step / count
    held = [control] * count if control.shape[-1] == controls else control.split(controls, -1)
    for index, acting_now in enumerate(held):
        begins = index == 0 and bool(program.kept_names)
        yield (acting_now, time + index * short, short), _Place(begins, index == count - 1)


def _noisy_substep(program: Program, place: _Place, state: Tensor, noise: Tensor, *given: Tensor) -> Tensor:
    with running(*state.shape[:-1]), Standardised(noise), within_row(*place):
        return program.transition(state, *given)


def _sample(program: Program, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> dict[str, Tensor]:
    channels = _on_average(program, state, control, time, step)
    return {site: standardised(fn, pyro.sample(site, fn), site) for site, fn in channels.items()}


def _on_average(program: Program, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> dict[str, Any]:
    """Site → the distribution of its average over a row; with one substep its own."""
    given, left = (control, time, step), state.shape[:-1]
    _, first = next(_through(program, state, _parts(program, *given), 0.0))
    kinds = first.distributions
    if program.substeps == 1:
        return kinds
    moments = {site: location_and_scale(fn, site) for site, fn in kinds.items()}
    loc, scale = (joined({site: both[i] for site, both in moments.items()}, kinds, left) for i in range(2))
    reach = 1 + MIN_SHARE_OF_PUSH * (loc / torch.where(scale > 0, scale, torch.ones_like(scale))).abs().detach()
    count = scale.shape[-1]
    units = torch.cat([scale.new_zeros(1, count), torch.eye(count).to(scale)]).view(1 + count, *[1] * len(left), count)
    states, noise = state.expand(1 + count, *state.shape), parted(units * reach, kinds)
    rows = _through(program, states, _parts(program, *given), noise)
    still, *pushed = _mean([joined(seen.values, kinds, (1 + count, *left)) for _, seen in rows])
    change = torch.stack([one[..., index] - still[..., index] for index, one in enumerate(pushed)], -1) / reach
    locs, scales = parted(still, kinds), parted(torch.maximum(change, MIN_SHARE_OF_SD * scale), kinds)
    return {site: with_moments(fn, locs[site], scales[site]) for site, fn in kinds.items()}


def _through(
    program: Program, state: Tensor, parts: Iterable[_Part], noise: Mapping[str, Tensor] | float
) -> Iterator[tuple[Tensor, Recording]]:
    """The state after each substep with given noise in scales, and what was sampled in it."""
    for given, place in parts:
        with poutine.block(), Recording() as seen, Held(noise), within_row(*place):
            state = program.transition(state, *given)
        yield state, seen


def _mean(values: Sequence[Tensor]) -> Tensor:
    return sum(values[1:], values[0]) / len(values)
