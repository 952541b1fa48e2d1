"""STEADY: learn a program's dynamics from measurements alone, by tempered particle filtering (IROS 2022).

Each step runs the program as a particle filter on every drive (the E step), draws paths from the surviving lineages,
and moves the parameters along the gradient of the paths' joint log-density (the M step). The observations' weight grows
from `first_weight` to 1. Held-out log p(y) decides which parameters are kept.
"""

from steady_ppl import (
    Fit,
    LinearRamp,
    Optimization,
    SMCGuide,
    Trajectories,
    Validation,
    for_program,
    seeded,
    train,
)

# What the paper and its authors' code use, best with AuthorsHovercraft or AuthorsTruck; hours on two cores:
# steady.fit(program, table, valid, **PAPER). They kept the single best validation; `train` the latest within an error.
PAPER = {
    "particles": 20_000,
    "draws": 10,
    "steps": 40_000,
    "gradient_steps": 1,
    "learning_rate": 1e-4,
    "betas": (0.9, 0.999),
    "final_rate": 1.0,
    "weight_decay": 1.0,
    "averaging": 0.0,
    "batch": 1,
    "first_weight": 0.001,
    "ramp": 1.0,
    "validate_every": 500,
    "validation_particles": 100_000,
    "patience": 30,
}

GUIDES = {"bootstrap": SMCGuide}


def fit(
    program,
    table: Trajectories,
    valid: Trajectories | None = None,
    *,
    known_start: bool = False,
    guide: str = "bootstrap",
    particles: int = 300,
    draws: int = 30,
    steps: int = 250,
    gradient_steps: int = 2,
    learning_rate: float = 1e-2,
    betas: tuple[float, float] = (0.9, 0.99),
    final_rate: float = 0.05,
    weight_decay: float = 1.0,
    averaging: float = 0.98,
    batch: int | None = None,
    first_weight: float = 0.02,
    ramp: float = 1.0,
    validate_every: int = 25,
    validation_particles: int = 2000,
    patience: int = 5,
    seed: int = 0,
    **run,
) -> Fit:
    """Fit `program` to the measurements of `table`; `valid` decides when to stop.

    Args:
        program: the state-space model, changed in place.
        table: the training drives; true states, where there are any, are used for a known start only.
        valid: held-out drives.
        known_start: the first row's true state is given.
        guide: the E step, one of GUIDES.
        particles: N of the E step, for each drive.
        draws: M, paths for each drive in the M step.
        steps: number of E steps.
        gradient_steps: Adam steps on the draws of each E step.
        first_weight: the observation weight at the first step.
        ramp: share of the training over which it grows to 1.
        run: checkpoint, resume and progress of `train`.
    """
    settings = {name: value for name, value in locals().items() if name not in ("program", "table", "valid", "run")}
    data = for_program(program, table)
    with seeded(seed, "prepare"):
        program.prepare(data, known_start)
    e_step = GUIDES[guide](
        program, particles=particles, draws=draws, tempering=LinearRamp(first_weight, ramp), known_start=known_start
    )
    optimization = Optimization(
        steps=steps,
        gradient_steps=gradient_steps,
        learning_rate=learning_rate,
        betas=betas,
        final_rate=final_rate,
        weight_decay=weight_decay,
        averaging=averaging,
        batch=batch,
        validate_every=validate_every,
        patience=patience,
    )
    held_out = for_program(program, valid) if valid is not None else None
    validation = Validation(held_out, particles=validation_particles, known_start=known_start)
    trained = train(program, e_step, data, validation, optimization, known_start=known_start, seed=seed, **run)
    return Fit(program, "steady", settings, seed=seed, known_start=known_start, trained=trained)
