"""STEADY−: STEADY whose observations count in full from the first step. What the tempering is worth."""

import dataclasses

from steady_ppl import Fit, Trajectories

from . import steady


def fit(
    program,
    table: Trajectories,
    valid: Trajectories | None = None,
    *,
    known_start: bool = False,
    guide: str = "auto",
    particles: int | None = None,
    draws: int | None = None,
    steps: int = 250,
    gradient_steps: int | None = None,
    learning_rate: float = 1e-2,
    betas: tuple[float, float] = (0.9, 0.99),
    final_rate: float = 0.05,
    weight_decay: float = 1.0,
    averaging: float = 0.98,
    batch: int | None = None,
    validate_every: int = 25,
    validation_particles: int | None = None,
    patience: int = 5,
    seed: int = 0,
    **run,
) -> Fit:
    """Fit as `steady.fit` does, the observation weight 1 throughout (w_obs = 1)."""
    settings = {name: value for name, value in locals().items() if name not in ("program", "table", "valid", "run")}
    fitted = steady.fit(program, table, valid, **settings, first_weight=1.0, ramp=0.0, **run)
    return dataclasses.replace(fitted, recipe="steady-minus")
