"""STEADY: learn a program's dynamics from measurements alone (IROS 2022).

Each step draws paths of every trajectory from the posterior (the E step) and moves the parameters along the gradient of
the paths' joint log-density (the M step). The observations' weight grows from `first_weight` to 1. Held-out log p(y)
decides which parameters are kept. The paper's E step is the bootstrap particle filter; the others linearise it.
"""

import math

from steady_ppl import (
    FilterError,
    Fit,
    GaussianGuide,
    LinearRamp,
    LookaheadGuide,
    Optimization,
    SMCGuide,
    Trajectories,
    UsageError,
    Validation,
    for_program,
    neglected,
    seeded,
    train,
    why_not_linear,
)
from steady_ppl.likelihood.information import information_of_fit
from steady_ppl.model.problem import Problem
from steady_ppl.smc.genealogy import degeneracy_note

# What the paper and its authors' code use, best with AuthorsHovercraft or AuthorsTruck; hours on two cores:
# steady.fit(program, table, valid, **PAPER). They kept the single best validation, by a bootstrap of 100,000 particles
# at 1 Hz; `train` keeps the latest within an error, by the filter that looks ahead.
PAPER = {
    "guide": "bootstrap",
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
    "patience": 30,
}

GUIDES = {"gaussian": GaussianGuide, "lookahead": LookaheadGuide, "bootstrap": SMCGuide}

# What two cores afford. The first two need normal noise.
DEFAULTS = {
    "lookahead": {"particles": 100, "draws": 64, "gradient_steps": 1},
    "gaussian": {"draws": 30, "gradient_steps": 1},
    "bootstrap": {"particles": 600, "draws": 64, "gradient_steps": 2},
}


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
    first_weight: float = 0.02,
    ramp: float = 1.0,
    validate_every: int = 25,
    validation_particles: int | None = None,
    patience: int = 5,
    seed: int = 0,
    **run,
) -> Fit:
    """Fit `program` to the measurements of `table`; `valid` decides when to stop.

    Args:
        program: the state-space model, changed in place.
        table: the training trajectories; true states, where there are any, are used for a known start only.
        valid: held-out trajectories.
        known_start: the first row's true state is given.
        guide: the E step, one of GUIDES, or "auto": gaussian (lookahead if `particles` is given) where the program's
            noise is normal, else bootstrap, and `notes` say why. Settings that are None come from its DEFAULTS.
        particles: N of the E step, for each trajectory; the Gaussian guide has none.
        draws: M, paths for each trajectory in the M step.
        steps: number of E steps.
        gradient_steps: Adam steps on the draws of each E step.
        learning_rate, betas, final_rate, weight_decay, averaging, batch, validate_every, patience: see `Optimization`.
        validation_particles: N of the filter that judges the held-out trajectories, see `Validation.suited`.
        first_weight: the observation weight at the first step.
        ramp: share of the training over which it grows to 1.
        run: checkpoint, resume and progress of `train`.

    Raises:
        UsageError: no such guide, or it has no particles.
        FilterError: the E step broke down.
        TrainingError: the loss is not finite.
    """
    settings = {name: value for name, value in locals().items() if name not in ("program", "table", "valid", "run")}
    data, notes = for_program(program, table), []
    if guide == "auto":
        reason = why_not_linear(program, data, known_start=known_start)
        guide = "bootstrap" if reason else "gaussian" if particles is None else "lookahead"
        notes += [f"guide bootstrap: {reason}"] if reason else []
    if guide not in GUIDES:
        raise UsageError(f"no guide {guide!r}; there are {', '.join(GUIDES)}, auto")
    if particles is not None and "particles" not in DEFAULTS[guide]:
        raise UsageError(f"guide {guide} has no particles; lookahead and bootstrap have")
    settings["guide"] = guide
    settings |= {name: value for name, value in DEFAULTS[guide].items() if settings[name] is None}
    with seeded(seed, "prepare"):
        program.prepare(data, known_start)
    e_step = GUIDES[guide](
        program,
        tempering=LinearRamp(first_weight, ramp),
        known_start=known_start,
        **{name: settings[name] for name in ("particles", "draws") if name in DEFAULTS[guide]},
    )
    optimization = Optimization.among(settings)
    validation = Validation.suited(program, valid, known_start=known_start, particles=validation_particles)
    notes += validation.notes
    trained = train(program, e_step, data, validation, optimization, known_start=known_start, seed=seed, **run)
    if e_step.in_plain_torch:
        notes.append(f"the E steps ran in plain torch, without compiled kernels: {e_step.in_plain_torch}")
    scarce = degeneracy_note(trained.history[-1].get("roots", math.inf) if trained.history else math.inf)
    if scarce:
        notes.append(scarce + (", or try guide=lookahead" if guide == "bootstrap" else ""))
    blown_up = sum("weights_blown_up" in entry for entry in trained.history)
    if blown_up:
        notes.append(
            f"particles blew up, and count for nothing, in {blown_up} of {len(trained.history)} logged E steps"
        )
    if guide == "gaussian" and not trained.interrupted:
        notes += doubts(program, data, known_start, seed, "guide=lookahead")
    information = None
    if not trained.interrupted:
        with seeded(seed, "information"):
            information, unknown = information_of_fit(Problem(program, data, known_start).without_truth())
        notes += unknown
    return Fit(program, "steady", settings, seed, known_start, trained, notes, information)


def doubts(program, data: Trajectories, known_start: bool, seed: int, instead: str) -> list[str]:
    """Whether the linearised program can be trusted: a filter weighs what it neglects."""
    try:
        with seeded(seed, "doubts"):
            nats = float(neglected(program, data, known_start=known_start).abs().mean())
    except FilterError as error:
        return [f"the filter that looks ahead breaks down on the learned model: {error}"]
    if nats < 0.5:
        return []
    return [f"linearised, the model misses log p(y) by {nats:.1f} nats a trajectory: try {instead}"]
