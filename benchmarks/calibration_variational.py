"""SVI's guides beside the others: draws of a guide that has been trained on the drives it is asked about.

The program is the one that made the drives and does not move. A variational posterior is as near as its family lets it
be, and no test of SVI's own tells how near: its ranks say so. Its densities are right all the same, so p(y) by
importance sampling from it is unbiased.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from pyro.infer.importance import vectorized_importance_weights
from torch import Tensor

from steady_ppl import (
    InferenceNetwork,
    LinearRamp,
    Optimization,
    Paths,
    Program,
    SmootherGuide,
    Trajectories,
    Validation,
    VariationalGuide,
    train,
)
from steady_ppl.model.problem import Joint

Family = Callable[..., VariationalGuide]
FAMILIES: dict[str, Family] = {"svi smoother": SmootherGuide, "svi network": InferenceNetwork}
STEPS, BATCH, DRAWS_A_STEP = 600, 100, 8
AT_ONCE = 500  # draws of one drive


class Variational:
    """A guide that `refresh` trains and then draws paths from, as the path guides do.

    Args:
        program: the state-space model.
        family: the guide's class.
        draws: M.
    """

    paths: Paths

    def __init__(self, program: Program, family: Family, draws: int) -> None:
        self.program, self.family, self.draws = program, family, draws

    def refresh(self, data: Trajectories, progress: float) -> dict[str, float]:
        """Train on `data`, then draw."""
        guide = trained(self.program, self.family, data)
        guide.draws = self.draws
        with torch.no_grad():
            self.paths, *_ = guide.roll_out(data)
        return {}


def trained(program: Program, family: Family, data: Trajectories) -> VariationalGuide:
    """The guide after its training on `data` as in recipe `svi`, with a program that stays as it is."""
    guide = family(program, data, draws=DRAWS_A_STEP, annealing=LinearRamp(20.0, 0.5))
    optimization = Optimization(steps=STEPS, learning_rate=3e-3, gradient_norm=1.0, batch=BATCH, patience=STEPS)
    train(program, guide, data, Validation(), optimization, progress=False)
    return guide


def log_weights(program: Program, family: Family, data: Trajectories, count: int) -> Tensor:
    """log p(y, x) − log q(x) of draws of a guide trained on one drive, `(count,)`."""
    guide = trained(program, family, data)
    guide.draws = AT_ONCE
    with torch.no_grad():
        found = [
            vectorized_importance_weights(Joint(program), guide, data, num_samples=AT_ONCE, max_plate_nesting=2)[0]
            for _ in range(math.ceil(count / AT_ONCE))
        ]
    return torch.cat(found)[:count]
