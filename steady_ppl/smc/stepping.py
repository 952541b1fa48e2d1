"""A program's methods on particles, as they are written; `compiled` runs them as kernels."""

from contextlib import nullcontext
from typing import Any

from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.model.handlers import Observing, Recording, Standardised, running
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import acting_controls, advance, standardised
from steady_ppl.smc.genealogy import event_dims

Row = int | Tensor  # a row, or one of each trajectory, `(B,)`


def at_row(values: Any, row: Row) -> Any:
    """What a tensor or array `(rows, B, ...)` has at a row, `(B, ...)`."""
    if isinstance(row, int):
        return values[row]
    at = row if isinstance(values, Tensor) else row.numpy()  # numpy takes a tensor of one number for the number
    return values[at, range(len(row))]


class Stepping:
    """The program's own lines, through Pyro; its arguments are those of `smc.filter.particle_filter`."""

    def __init__(self, program: Program, data: Trajectories, observation_weight: float | Tensor) -> None:
        self.program, self.data, self.observation_weight = program, data, observation_weight
        self.steps, self.elapsed, self.controls = data.steps, data.elapsed, acting_controls(program, data)
        self.event_dims: dict[str, int] = {}  # of each site of `transition`, known after the first

    def transition(self, row: Row, state: Tensor, noise: Tensor | None) -> tuple[Tensor, dict[str, Tensor]]:
        """Move states `(N, B, D)` on from a row: the next ones, and each site's values `(N, B, ...)`, which with
        several substeps are in standard deviations (see `substeps.channel_values`).

        Args:
            noise: `(N, B, C)`, in standard deviations of the channels; None: drawn by the program.
        """
        given = nullcontext() if noise is None else Standardised(noise.unsqueeze(1))
        control, time, step = (at_row(part, row)[None] for part in (self.controls, self.elapsed, self.steps))
        with running(state.shape[0], 1, state.shape[1]), Recording() as recording, given:
            moved = advance(self.program, state.unsqueeze(1), control, time, step)
        self.event_dims = event_dims(recording)
        values = recording.values
        if self.program.substeps > 1:
            values = {site: standardised(fn, values[site], site) for site, fn in recording.distributions.items()}
        return moved.squeeze(1), {site: value.squeeze(1) for site, value in values.items()}

    def log_density(self, row: Row, state: Tensor) -> Tensor:
        """Tempered log-density of a row's measurements, `(N, B)`."""
        measurements, observed = (at_row(part, row)[None] for part in (self.data.measurements, self.data.observed))
        measured = Observing(measurements, observed, self.observation_weight)
        with running(state.shape[0], 1, state.shape[1]), Recording() as recording, measured:
            self.program.observe(state.unsqueeze(1))
        return recording.total().squeeze(-2)
