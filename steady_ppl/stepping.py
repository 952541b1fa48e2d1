"""How a filter runs a program's methods on its particles: as they are written, here, or compiled (`compiled`)."""

from __future__ import annotations

from contextlib import nullcontext

from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.model.handlers import Observing, Recording, Standardised, running
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import acting_controls, advance, standardised
from steady_ppl.resampling import take


class Stepping:
    """The program's own lines, through Pyro.

    Args:
        program: the state-space model.
        data: as returned by `for_program`.
        observation_weight: tempers the observations' log-density; `(B,)` for one a trajectory.

    Attributes:
        event_dims: event dimension of each site of `transition`, known after the first.
    """

    def __init__(self, program: Program, data: Trajectories, observation_weight: float | Tensor) -> None:
        self.program, self.data, self.observation_weight = program, data, observation_weight
        self.steps, self.elapsed, self.controls = data.steps, data.elapsed, acting_controls(program, data)
        self.event_dims: dict[str, int] = {}

    def transition(
        self, row: int, state: Tensor, ancestors: Tensor | None, noise: Tensor | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Move on by one interval.

        Args:
            row: the interval's first row.
            state: `(N, B, D)`.
            ancestors: `(N, B)`, which of these move on; None: each.
            noise: `(N, B, C)`, in standard deviations of the channels; None: drawn by the program.

        Returns:
            The next states `(N, B, D)` and each site's values `(N, B, ...)`; with several substeps these are in
            standard deviations, see `substeps.channel_values`.
        """
        if ancestors is not None:
            state = take(state, ancestors)
        recording = Recording()
        given = nullcontext() if noise is None else Standardised(noise.unsqueeze(1))
        control, time, step = self.controls[row, None], self.elapsed[row, None], self.steps[row, None]
        with running(state.shape[0], 1, state.shape[1]), recording, given:
            moved = advance(self.program, state.unsqueeze(1), control, time, step)
        self.event_dims = {site: fn.event_dim for site, fn in recording.distributions.items()}
        values = recording.values
        if self.program.substeps > 1:
            values = {site: standardised(fn, values[site], site) for site, fn in recording.distributions.items()}
        return moved.squeeze(1), {site: value.squeeze(1) for site, value in values.items()}

    def log_density(self, row: int, state: Tensor) -> Tensor:
        """Tempered log-density of a row's measurements, `(N, B)`."""
        recording = Recording()
        measured = Observing(self.data.measurements[row, None], self.data.observed[row, None], self.observation_weight)
        with running(state.shape[0], 1, state.shape[1]), recording, measured:
            self.program.observe(state.unsqueeze(1))
        return recording.total().squeeze(-2)
