"""The channel noise that explains given states, for supervised learning."""

from __future__ import annotations

import torch
from torch import Tensor

from steady_ppl.data import Trajectories
from steady_ppl.errors import DataError, ProgramError
from steady_ppl.paths import Paths
from steady_ppl.planar_vehicle import wrap
from steady_ppl.program import Program, acting_controls, names
from steady_ppl.sites import Recording, Replaying, running


@torch.no_grad()
def true_paths(program: Program, data: Trajectories) -> Paths:
    """The true states with the channel noise that leads from one to the next.

    The program is run at zero noise and at a unit of each channel; where the next state is affine in the noise, least
    squares on these runs gives the noise exactly. What noise cannot explain (a position that does not follow from the
    velocity) is left over. Angles are compared on the circle.

    Args:
        program: the state-space model.
        data: as returned by `for_program`, all states known.

    Raises:
        DataError: a state is unknown.
        ProgramError: the next state is not affine in the channel noise, or the start is not one site.
    """
    states = data.states
    if states is None or not bool(torch.isfinite(states[data.rows]).all()):
        raise DataError("supervised learning needs the true state of every row: the table's x. columns are incomplete")
    states = torch.where(data.rows[..., None], states, states[:1])
    before, after = states[:-1], states[1:]

    controls = acting_controls(program, data)[:-1]

    def run(noise: dict[str, Tensor]) -> tuple[Tensor, Recording]:
        recording = Recording()
        with running(*before.shape[:-1]), recording, Replaying(noise):
            after = program.transition(before, controls, data.elapsed[:-1], data.steps)
        return after, recording

    _, probe = run({})
    zero = {site: value.new_zeros(value.shape) for site, value in probe.values.items()}
    base, _ = run(zero)
    columns, places = [], []
    for site, value in zero.items():
        for channel in range(value[0, 0].numel()):
            unit = zero | {site: value.clone()}
            unit[site].reshape(*value.shape[:2], -1)[..., channel] = 1.0
            columns.append(run(unit)[0] - base)
            places.append((site, channel))
    effect = torch.stack(columns, -1).double()
    difference = after - base
    for index in (names(program.states).index(angle) for angle in program.angles):
        difference[..., index] = wrap(difference[..., index])
    solution = (torch.linalg.pinv(effect) @ difference.double().unsqueeze(-1)).squeeze(-1).to(states.dtype)
    noise = {site: value.clone() for site, value in zero.items()}
    for index, (site, channel) in enumerate(places):
        noise[site].reshape(*noise[site].shape[:2], -1)[..., channel] = solution[..., index]

    start = Recording()
    with running(1, before.shape[1]), start:
        program.initial()
    replayed = run(noise)[0] - base
    predicted = (effect @ solution.double().unsqueeze(-1)).squeeze(-1).to(states.dtype)
    if bool(((replayed - predicted).norm(dim=-1) > 1e-2 * predicted.norm(dim=-1) + 1e-3).any()):
        raise ProgramError(
            f"program {type(program).__name__}: the next state is not affine in the channel noise: supervised learning "
            "cannot tell which noise led from one true state to the next",
            site="transition",
        )
    if len(start.values) != 1:
        raise ProgramError("supervised learning needs initial() to sample the whole state as one site", site="initial")
    (site,) = start.values
    width = start.distributions[site].event_shape.numel()  # other states rest at the start
    event_dims = {s: fn.event_dim for s, fn in (start.distributions | probe.distributions).items()} | {"states": 1}
    return Paths(
        states=states[None],
        start={site: states[None, :1, :, :width]},
        noise={s: value[None] for s, value in noise.items()},
        event_dims=event_dims,
    )
