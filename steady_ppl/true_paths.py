"""The channel noise that explains given states, for supervised learning."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError, ProgramError
from steady_ppl.model.handlers import Recording, Replaying, running
from steady_ppl.model.program import Program, names
from steady_ppl.model.substeps import acting_controls, sample_row
from steady_ppl.smc.genealogy import Paths
from steady_ppl.utils.angles import wrap

PASSES = 30  # of Gauss and Newton's method
AT_REST = 1e-9  # of a channel's size and unit, by which noise may still move when it is found
Noise = dict[str, Tensor]


@torch.no_grad()
def true_paths(program: Program, data: Trajectories) -> Paths:
    """The true states with the channel noise that leads from one to the next.

    Gauss and Newton's method from zero noise: least squares on the differences that a unit of each channel makes; one
    pass is exact where the next state is affine in the noise. What noise cannot explain (a position that does not
    follow from the velocity) is left over, and the more of that, the more precise the derivatives must be: the program
    runs in double precision. Angles are compared on the circle.

    Args:
        program: the state-space model.
        data: as returned by `for_program`, all states known.

    Raises:
        DataError: a state is unknown.
        ProgramError: no noise is found within `PASSES`, or the start is not one site.
    """
    states = data.states
    if states is None or not bool(torch.isfinite(states[data.rows]).all()):
        raise DataError("supervised learning needs the true state of every row: the table's x. columns are incomplete")
    states = torch.where(data.rows[..., None], states, states[:1])
    exact, within = copy.deepcopy(program).double(), data.to(torch.float64)
    before, after = states[:-1].double(), states[1:].double()
    controls = acting_controls(exact, within)[:-1]

    def run(noise: dict[str, Tensor]) -> tuple[Tensor, Recording]:
        recording = Recording()
        with running(*before.shape[:-1]), recording, Replaying(noise):
            after = sample_row(exact, before, controls, within.elapsed[:-1], within.steps)
        return after, recording

    _, probe = run({})
    noise = {site: value.new_zeros(value.shape) for site, value in probe.values.items()}
    angles = [names(program.states).index(angle) for angle in program.angles]
    for _ in range(PASSES):
        noise, moved = _improved(run, noise, after, angles)
        if not moved:
            break
    else:
        raise ProgramError(
            f"program {type(program).__name__}: no channel noise was found that leads from one true state to the next "
            "(transition bends too much in its noise): supervised learning cannot tell which it was",
            site="transition",
        )

    start = Recording()
    with running(1, before.shape[1]), start:
        program.initial()
    if len(start.values) != 1:
        raise ProgramError("supervised learning needs initial() to sample the whole state as one site", site="initial")
    (site,) = start.values
    width = start.distributions[site].event_shape.numel()  # other states rest at the start
    event_dims = {s: fn.event_dim for s, fn in (start.distributions | probe.distributions).items()} | {"states": 1}
    return Paths(
        states=states[None],
        start={site: states[None, :1, :, :width]},
        noise={s: value[None].to(states.dtype) for s, value in noise.items()},
        event_dims=event_dims,
    )


def _improved(
    run: Callable[[Noise], tuple[Tensor, Recording]], noise: Noise, after: Tensor, angles: Sequence[int]
) -> tuple[Noise, bool]:
    """Noise after one pass towards the states `after`, and whether it moved."""
    base, _ = run(noise)
    columns, places = [], []
    for site, value in noise.items():
        for channel in range(value[0, 0].numel()):
            unit = noise | {site: value.clone()}
            _channel(unit[site], channel).add_(1.0)
            columns.append(run(unit)[0] - base)
            places.append((site, channel))
    effect, difference = torch.stack(columns, -1).double(), after - base
    for index in angles:
        difference[..., index] = wrap(difference[..., index])
    change = (torch.linalg.pinv(effect) @ difference.double().unsqueeze(-1)).squeeze(-1).to(after.dtype)
    found = {site: value.clone() for site, value in noise.items()}
    for index, (site, channel) in enumerate(places):
        _channel(found[site], channel).add_(change[..., index])
    reached = torch.stack([_channel(found[site], channel) for site, channel in places], -1)
    return found, bool((change.abs() > AT_REST * (1 + reached.abs())).any())


def _channel(value: Tensor, channel: int) -> Tensor:
    """A view of one channel of a site's value, `(T, B)`."""
    return value.reshape(*value.shape[:2], -1)[..., channel]
