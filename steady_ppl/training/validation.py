"""Held-out log p(y): the stopping rule of every method, at the rows and with the filter that a recipe chooses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import require
from steady_ppl.gaussian.linearize import why_not_linear
from steady_ppl.likelihood.evidence import log_likelihood
from steady_ppl.model.program import Program, for_program
from steady_ppl.smc.filter import STEPS_WORTH_COMPILING
from steady_ppl.utils.random import seeded

SEVERAL = 10  # validations are in a training


@dataclass(frozen=True)
class Validation:
    """Held-out log p(y): the stopping rule of every method.

    Attributes:
        data: the validation table, as returned by `for_program`; None trains to the last step.
        particles: N of the filter; the same random numbers are used at every validation.
        known_start: start at the true first state.
        every: use every n-th row's measurements (10 Hz to 1 Hz).
        look_ahead: with a filter that looks ahead; `particles` can then be a twentieth.
        reason: why it does not, where that was wanted.
    """

    data: Trajectories | None = None
    particles: int = 2000
    known_start: bool = False
    every: int = 10
    look_ahead: bool = False
    reason: str | None = None

    @property
    def notes(self) -> list[str]:
        """What a fit should say of it."""
        if self.reason is None:
            return []
        return [f"held-out drives were judged by the bootstrap filter at every tenth row: {self.reason}"]

    @classmethod
    def suited(
        cls, program: Program, table: Trajectories | None, *, known_start: bool = False, particles: int | None = None
    ) -> Validation:
        """Looking ahead at every row where the program's noise is normal, else by the bootstrap at every tenth.

        Args:
            table: the held-out drives, if there are any.
            particles: N; 100 looking ahead and 2000 otherwise when not given.
        """
        if table is None:
            return cls(None, known_start=known_start)
        data = for_program(program, table)
        reason = why_not_linear(program, data, known_start=known_start)
        usual = 100 if reason is None else 2000
        count = usual if particles is None else particles
        require(count >= 1, "validation_particles", count, "at least 1")
        if reason is not None:
            return cls(data, count, known_start, reason=reason)
        return cls(data, count, known_start, every=1, look_ahead=True)

    def __call__(self, program: Program, seed: int) -> list[float]:
        """Log p(y) of each held-out trajectory."""
        assert self.data is not None
        with seeded(seed, "validate"):
            values = log_likelihood(
                program,
                self.data,
                particles=self.particles,
                known_start=self.known_start,
                every=self.every,
                look_ahead=self.look_ahead,
                kernels=SEVERAL * self.particles * self.data.time.numel() >= STEPS_WORTH_COMPILING,
            )
        return values.tolist()


def as_good(candidate: Sequence[float], best: Sequence[float]) -> bool:
    """Whether held-out log p(y) is no worse than the best, up to one standard error of the paired difference.

    Log p(y) at 1 Hz hardly feels how wide the process noise is; its differences late in a training are smaller than
    what the choice of held-out drives moves. Among equals the later parameters have seen more of the full observation
    weight (the one-standard-error rule of Breiman et al. 1984, towards the later instead of the smaller model).

    Args:
        candidate, best: log p(y) of each held-out trajectory; empty when nothing is held out.
    """
    if not candidate or not best:
        return True
    loss = torch.tensor(best, dtype=torch.float64) - torch.tensor(candidate, dtype=torch.float64)
    if len(loss) < 2:
        return bool(loss.mean() <= 0)
    return bool(loss.mean() <= loss.std() / math.sqrt(len(loss)))
