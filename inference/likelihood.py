"""Likelihood: the parameters under which the linearised program makes the measurements most likely.

Scoring steps (Gauss–Newton with a learned curvature), what system identification calls the prediction-error method. For
programs of some dozens of learnable numbers with normal noise: seconds where gradient steps take minutes. A network
has too many numbers for it, and nothing but the numbers' fewness keeps it from explaining noise.
"""

import copy

import torch

from steady_ppl import (
    FilterError,
    Fit,
    Trained,
    Trajectories,
    UsageError,
    Validation,
    fit_by_likelihood,
    for_program,
    seeded,
    why_not_linear,
)
from steady_ppl.errors import require
from steady_ppl.kernels.rows import fallback_notes, kernel_failures
from steady_ppl.likelihood.information import information_of_fit
from steady_ppl.likelihood.maximize import MIN_GAIN_OF_START
from steady_ppl.likelihood.parameter_posterior import undetermined
from steady_ppl.likelihood.parameters import elements, set_values, values_of
from steady_ppl.model.problem import Problem
from steady_ppl.utils.progress import stages
from steady_ppl.utils.text import reason_of

from .steady import doubts


def fit(
    program,
    table: Trajectories,
    valid: Trajectories | None = None,
    *,
    known_start: bool = False,
    steps: int = 25,
    starts: int = 1,
    validation_particles: int | None = None,
    seed: int = 0,
) -> Fit:
    """Fit `program` to the measurements of `table`; `valid` is judged before and after, and decides nothing.

    Args:
        program: the state-space model, changed in place.
        table: the training trajectories; true states, where there are any, are used for a known start only.
        valid: held-out trajectories.
        known_start: the first row's true state is given.
        steps: scoring steps at most.
        starts: fits; those after the first begin elsewhere, and the likeliest is kept.
        validation_particles: N of the filter that judges the held-out trajectories, see `Validation.suited`.
        seed: of the search for paths.

    Raises:
        UsageError: a program that cannot be linearised, or a network.
        FilterError: the trajectories cannot be smoothed.
    """
    settings = {"known_start": known_start, "steps": steps, "starts": starts}
    settings |= {"validation_particles": validation_particles, "seed": seed}
    require(starts >= 1, "starts", repr(starts), "at least 1")
    data = for_program(program, table).without_truth(keep_start=known_start)
    reason = why_not_linear(program, data, known_start=known_start)
    if reason:
        raise UsageError(f"recipe likelihood needs a model that can be linearised: {reason.split(': looking')[0]}")
    if data.time.is_cuda:
        raise UsageError("recipe likelihood computes on the CPU: leave --device out")
    notes, history = [], []
    validation = Validation.suited(program, valid, known_start=known_start, particles=validation_particles)
    with seeded(seed, "prepare"):
        program.prepare(data, known_start)

    def judge(step: int) -> None:
        if validation.data is not None:
            held_out = validation(program, seed)
            history.append({"step": float(step), "log_likelihood": sum(held_out) / len(held_out)})

    with stages(("judging", 1), ("", 6), ("judging", 1), ("looking for doubts", 1)) as begin:
        begin()
        try:
            judge(0)
        except FilterError as error:
            notes.append(f"as declared, the model cannot follow the held-out trajectories: {error}")
        begin()
        declared = copy.deepcopy(program)
        with kernel_failures() as why:
            with seeded(seed, "paths"):
                maximum = fit_by_likelihood(program, data, known_start=known_start, steps=steps)
            for start in range(1, starts):
                other = elsewhere(declared, program, maximum.information, (seed, "start", start))
                try:
                    with seeded(seed, "paths", start):
                        found = fit_by_likelihood(other, data, known_start=known_start, steps=steps)
                except Exception as error:  # also of the program's own code, at numbers that nobody tried before
                    notes.append(f"start {start + 1} came to nothing: {reason_of(error)}")
                    continue
                if (more := found.objective - maximum.objective) > MIN_GAIN_OF_START:
                    notes.append(f"start {start + 1} ended {more:.2g} nats above those before it")
                    program.load_state_dict(other.state_dict())
                    maximum = found
        notes += fallback_notes(why)
        begin()
        judge(maximum.steps)
        begin()
        doubtful = doubts(program, data, known_start, seed, "recipe steady with guide=lookahead")
    if not maximum.converged:
        notes.append(
            f"not converged after {maximum.steps} steps, another would gain {maximum.decrement:.2g} nats: take more "
            f"(--steps {4 * steps})"
        )
    problem = Problem(program, data, known_start)
    notes += undetermined(problem, maximum.path)
    information, unknown = information_of_fit(problem, maximum.path, maximum.information)
    notes += validation.notes + doubtful + unknown
    trained = Trained(history, kept=maximum.steps)
    return Fit(program, "likelihood", settings, seed, known_start, trained, notes, information)


def elsewhere(declared, fitted, information, key):
    """A copy of the program as declared, with numbers at random about where a fit ended.

    A logarithm moves by as much as the fit moved it, from .5 to 3. A number with a unit moves as far, or by ten of its
    standard deviations.
    """
    program = copy.deepcopy(declared)
    parts = elements(program)
    has_unit = torch.tensor([part.has_unit for part in parts])
    ended, sd = values_of(elements(fitted)), information.diagonal().clamp(min=1e-12).rsqrt()
    moved = (values_of(parts) - ended).abs()
    size = torch.where(has_unit, torch.maximum(moved, 10 * sd), moved.clamp(0.5, 3.0))
    with seeded(*key):
        set_values(parts, ended + size * torch.randn_like(size))
    return program
