"""A program, its drives and what is known of their start: what every question of log p(y) is about."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.model.program import Program, for_program


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
