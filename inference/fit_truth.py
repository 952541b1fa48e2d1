"""FitTruth: the same program, trained on the true states. What bearings are measured against; no robot has it.

The guide's sites are Deltas at the true states and the channel noise that explains them, so that the same loop becomes
supervised learning. It still stops on held-out log p(y), as every other recipe does.
"""

from steady_ppl import Fit, Optimization, Trajectories, TruthGuide, Validation, for_program, seeded, train


def fit(
    program,
    table: Trajectories,
    valid: Trajectories | None = None,
    *,
    known_start: bool = False,
    steps: int = 500,
    learning_rate: float = 1e-2,
    weight_decay: float = 1.0,
    averaging: float = 0.98,
    validate_every: int = 50,
    validation_particles: int | None = None,
    patience: int = 5,
    seed: int = 0,
    **run,
) -> Fit:
    """Fit `program` to the true states of `table`.

    Args:
        program: the state-space model, changed in place.
        table: the training trajectories, every x. column filled.
        valid: held-out trajectories.
        known_start: the first row's true state is given to the filter of the validation.
        steps: gradient steps, each on all trajectories.
        validation_particles: N of the filter that judges the held-out trajectories, see `Validation.suited`.
        run: checkpoint, resume and progress of `train`.
    """
    settings = {name: value for name, value in locals().items() if name not in ("program", "table", "valid", "run")}
    return supervised(program, for_program(program, table), valid, "fit-truth", settings, **run)


def supervised(program, data: Trajectories, valid: Trajectories | None, recipe: str, settings: dict, **run) -> Fit:
    """Fit `program` to the states of `data`, whoever says that they are these; `settings` as of `fit`."""
    seed, known_start = settings["seed"], settings["known_start"]
    with seeded(seed, "prepare"):
        program.prepare(data, known_start)
    optimization = Optimization.among(settings)
    validation = Validation.suited(program, valid, known_start=known_start, particles=settings["validation_particles"])
    trained = train(
        program, TruthGuide(program), data, validation, optimization, known_start=known_start, seed=seed, **run
    )
    return Fit(program, recipe, settings, seed=seed, known_start=known_start, trained=trained, notes=validation.notes)
