"""A program, its drives and what is known of their start: what every question of log p(y) is about; and the joint
density of all of it, which the M step and SVI differentiate."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace

import pyro
import pyro.distributions as dist
from pyro.distributions import constraints
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.model.handlers import KnownStart, Observing, masked
from steady_ppl.model.program import Program, for_program
from steady_ppl.model.starts import first_state
from steady_ppl.model.substeps import row_inputs, sample_channels


@dataclass(frozen=True)
class Problem:
    """A state-space model and drives, with or without their exact start; public functions take the three one by one.

    Raises:
        DataError: a known start, and some first state is not given.
    """

    program: Program
    data: Trajectories  # as returned by `for_program`
    known_start: bool = False  # the first states are certain

    def __post_init__(self) -> None:
        if self.known_start:
            self.data.require_known_start()

    @classmethod
    def of_table(cls, program: Program, table: Trajectories, known_start: bool) -> Problem:
        """The columns of a table that a program reads, without the true states but for a known start."""
        return cls(program, for_program(program, table), known_start).without_truth()

    def without_truth(self) -> Problem:
        """The same without the true states, but for a known start."""
        return replace(self, data=self.data.without_truth(keep_start=self.known_start))

    def subset(self, index: Sequence[int] | Tensor) -> Problem:
        return replace(self, data=self.data.subset(index))


class Joint:
    """The program as a Pyro model of whole trajectories, every step evaluated at once.

    The site `states` carries what a guide knows about the states, at density one; with the channel noise that goes with
    them the transitions need no loop over time. Draws, if any, are at dimension −3, rows at −2, trajectories at −1.
    Priors of the program's parameters are counted once a call. With `known_start` the first state is not scored.
    """

    def __init__(self, program: Program, *, known_start: bool = False) -> None:
        self.program, self.known_start = program, known_start

    def __call__(self, data: Trajectories) -> None:
        """The model. `data` is as returned by `for_program`."""
        for name, prior in self.program.priors.items():
            pyro.factor(f"prior of {name}", prior.log_prob(getattr(self.program, name)).sum())
        rows, trajectories = data.time.shape
        dimension = len(self.program.states)
        with pyro.plate("trajectory", trajectories, dim=-1):
            with pyro.plate("row", rows, dim=-2), masked(data.rows):
                states = pyro.sample("states", dist.ImproperUniform(constraints.real_vector, (), (dimension,)))
            certain = KnownStart(data.known_start) if self.known_start else nullcontext()
            with pyro.plate("first_row", 1, dim=-2), certain:
                first_state(self.program, data)
            with pyro.plate("interval", rows - 1, dim=-2), masked(data.transitions):
                sample_channels(self.program, states[..., :-1, :, :], *row_inputs(self.program, data))
            with pyro.plate("observed_row", rows, dim=-2), Observing(data.measurements, data.observed):
                self.program.observe(states)
