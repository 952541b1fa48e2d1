"""SVI: the same program and the same loop as STEADY, with a guide that has parameters instead of a particle filter.

The ELBO's bound on log p(y) is climbed in the program's and the guide's parameters together (Kingma and Welling 2014;
for state-space models Krishnan, Shalit and Sontag 2017). Held-out log p(y), from the same filter as for STEADY, decides
which parameters are kept.
"""

import functools

from pyro.infer.autoguide import AutoNormal

from steady_ppl import (
    AutoRollout,
    Fit,
    InferenceNetwork,
    LinearRamp,
    Optimization,
    SmootherGuide,
    Trajectories,
    UsageError,
    Validation,
    for_program,
    seeded,
    train,
    why_not_linear,
)

# A network that reads the measurements, one for all drives, as in the paper's baseline; independent normals for each
# interval's noise of each drive; the linearised posterior of each drive, every number of which is then learned.
GUIDES = {
    "network": InferenceNetwork,
    "mean-field": functools.partial(AutoRollout, auto=AutoNormal),
    "smoother": SmootherGuide,
}
LINEARIZING = ("network", "smoother")  # they begin at the linearised program, see `why_not_linear`
NETWORK = ("width", "centred")  # settings that it alone has


def fit(
    program,
    table: Trajectories,
    valid: Trajectories | None = None,
    *,
    known_start: bool = False,
    guide: str = "network",
    width: int | None = None,
    centred: bool | None = None,
    draws: int = 8,
    guide_rate: float = 1.0,
    first_kl_weight: float = 20.0,
    annealing: float = 0.5,
    steps: int = 1500,
    learning_rate: float = 3e-3,
    betas: tuple[float, float] = (0.9, 0.99),
    final_rate: float = 0.05,
    weight_decay: float = 1.0,
    gradient_norm: float | None = 1.0,
    averaging: float = 0.98,
    batch: int | None = None,
    validate_every: int = 75,
    validation_particles: int | None = None,
    patience: int = 10,
    seed: int = 0,
    **run,
) -> Fit:
    """Fit `program` to the measurements of `table`; `valid` decides when to stop.

    Args:
        program: the state-space model, changed in place; its noise is normal, but for the mean-field guide, which takes
            any that is reparameterised.
        table: the training trajectories; true states, where there are any, are used for a known start only.
        valid: held-out trajectories.
        known_start: the first row's true state is given.
        guide: one of GUIDES.
        width, centred: of the network alone, see `InferenceNetwork`, which has their defaults.
        draws: of each trajectory a step.
        guide_rate: learning rate of the guide's parameters relative to the program's.
        first_kl_weight, annealing: the KL divergence's weight at the first step, and the share of the training over
            which it changes to 1; below 1 it is KL annealing (Bowman et al. 2016), above 1 it tempers the observations.
        steps: gradient steps.
        learning_rate, betas, final_rate, weight_decay, gradient_norm, averaging, batch, validate_every, patience: see
            `Optimization`.
        validation_particles: N of the filter that judges the held-out trajectories.
        run: checkpoint, resume and progress of `train`.

    Raises:
        UsageError: no such guide, or it has no such setting or takes no batch, or the program's noise is not normal
            and the guide needs it to be.
        TrainingError: the loss is not finite.
    """
    settings = {name: value for name, value in locals().items() if name not in ("program", "table", "valid", "run")}
    if guide not in GUIDES:
        raise UsageError(f"no guide {guide!r}; there are {', '.join(GUIDES)}")
    own = {name: settings[name] for name in NETWORK if settings[name] is not None}
    if own and guide != "network":
        raise UsageError(f"guide {guide} has no {' and no '.join(own)}; network has")
    data = for_program(program, table)
    reason = why_not_linear(program, data, known_start=known_start) if guide in LINEARIZING else None
    if reason:
        raise UsageError(f"guide {guide} begins at the linearised model: {reason}; guide mean-field does without")
    with seeded(seed, "prepare"):
        program.prepare(data, known_start)
        q = GUIDES[guide](
            program,
            data,
            draws=draws,
            known_start=known_start,
            annealing=LinearRamp(first_kl_weight, annealing),
            rate=guide_rate,
            **own,
        )
    if guide == "network":
        settings |= {name: getattr(q, name) for name in NETWORK}
    optimization = Optimization.among(settings)
    validation = Validation.suited(program, valid, known_start=known_start, particles=validation_particles)
    trained = train(program, q, data, validation, optimization, known_start=known_start, seed=seed, **run)
    return Fit(program, "svi", settings, seed=seed, known_start=known_start, trained=trained, notes=validation.notes)
