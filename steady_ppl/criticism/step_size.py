"""Whether a program's own time step suits its drives: the first suspect where model and measurements differ.

A program moves by steps, a vehicle in continuous time. What a coarse step gets wrong looks like physics: a delay, a
lever arm, a drag. So a program is compared with itself at finer substeps before anything else is suspected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import FilterError, UsageError
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import find_path, require_found, resting_path, smooth
from steady_ppl.likelihood.maximize import Maximum, maximise, widen_noise
from steady_ppl.likelihood.parameter_posterior import pseudo_inverse
from steady_ppl.likelihood.parameters import elements, values_of
from steady_ppl.likelihood.scores import widens
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.model.stability import can_be_cut, counts_rows, is_step
from steady_ppl.model.substeps import MAX_SUBSTEPS, with_substeps
from steady_ppl.utils.random import seeded
from steady_ppl.utils.text import reason_of

MIN_GAIN = 3.0  # nats, of all drives together, from which a finer step counts
MAX_SHIFT = 2.0  # nats that watched parameters of another step lie below the maximum: two standard deviations
MAX_DECREMENT = 1.0  # nats that a scoring step may promise; beyond it more steps may gain far more
REFIT_PRECISION = 0.005  # nats
MAX_SUBSTEPS_TRIED = 32  # of a trial, unless more are asked for; a program may always be tried at twice its own
MAX_REFIT_STEPS = 25  # scoring steps of a fit
MAX_NATS_A_NUMBER = 50.0  # log-density of a measured number in its own spread; of sixteen digits it is 37 at most
UNKNOWN = "whether the time step suits is not known"


@dataclass(frozen=True)
class StepTrial:
    """A program with some number of substeps a row; names, values and covariance are of its `P` watched numbers."""

    substeps: int  # of a row
    log_likelihood: float  # log p(y) of all drives, linearised
    decrement: float  # what a scoring step would add, nats; zero where parameters are not refitted
    program: Program  # with the parameters of this trial
    path: ReferencePath  # of the drives, along which it was linearised
    names: tuple[str, ...] = ()
    values: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))  # (P,)
    covariance: Tensor = field(default_factory=lambda: torch.zeros(0, 0, dtype=torch.float64))  # (P, P)

    def shift(self, other: StepTrial) -> float:
        """Nats that the other trial's watched parameters lie below this one's maximum, to second order."""
        change = other.values - self.values
        return 0.5 * float(change @ pseudo_inverse(self.covariance) @ change)

    def largest_difference(self, other: StepTrial) -> str:
        """The watched number that differs most from the other trial's, and by how much, in words."""
        apart = ((other.values - self.values) / self.covariance.diagonal().clamp(min=1e-300).sqrt()).abs()
        return f"{self.names[int(apart.argmax())]} by {float(apart.max()):.1f} standard deviations"


@dataclass(frozen=True)
class StepCheck:
    """A program beside itself at finer steps, on the same drives.

    The first trial has the program's own number of substeps, each further one twice as many, to the first that changes
    neither log p(y) nor the watched parameters by what counts, or to one too many that loses.
    """

    trials: tuple[StepTrial, ...]
    max_shift: float  # nats by which the watched parameters may move
    uncompared: str | None = None  # why nothing is known of steps finer than the suited one

    @property
    def suited(self) -> StepTrial:
        """The trial with the fewest substeps, beyond which twice as many change nothing that counts."""
        for index, trial in enumerate(self.trials):
            if not any(_differs(trial, finer, self.max_shift) for finer in self.trials[index + 1 :]):
                break
        return trial

    @property
    def settled(self) -> bool:
        """Whether twice as many substeps as the suited ones were tried and change nothing that counts."""
        return self.uncompared is None and (len(self.trials) == 1 or self.suited is not self.trials[-1])

    @property
    def gain(self) -> float:
        """Nats that the suited step is ahead of the program's own."""
        return self.suited.log_likelihood - self.trials[0].log_likelihood

    @property
    def too_coarse(self) -> bool:
        """Whether finer steps gain more than `MIN_GAIN` nats, or move what is watched by more than `max_shift`."""
        return self.suited is not self.trials[0]

    @property
    def sentence(self) -> str:
        """What is to be said first where a finer step gains nats or moves parameters far; empty otherwise."""
        own, suited = self.trials[0], self.suited
        if self.gain > MIN_GAIN:
            said = f"gain {self.gain:.0f} nats"
            if suited is self.trials[-1]:
                coarser = self.trials[-2]
                gain = suited.log_likelihood - coarser.log_likelihood
                if gain > MIN_GAIN:
                    said += f", the last doubling {gain:.0f} of them: more substeps may gain more"
                else:
                    said += f", the last doubling moves {suited.largest_difference(coarser)}: more may move it on"
        elif self.too_coarse and suited.shift(own) > MAX_SHIFT:
            said = f"move {suited.largest_difference(own)}"
        else:
            return ""
        return f"the model's own time step is too coarse: {self._finer_steps(said)}"

    @property
    def note(self) -> str:
        """What is to be noted where a finer step moves parameters a little; empty otherwise."""
        if not self.too_coarse or self.sentence:
            return ""
        return self._finer_steps(f"move {self.suited.largest_difference(self.trials[0])}")

    def _finer_steps(self, effect: str) -> str:
        finer, own = self.suited.substeps, self.trials[0].substeps
        return f"{finer} substeps a row instead of {own} {effect} (fit with --substeps {finer})"

    @property
    def figures(self) -> dict[str, object]:
        """Everything as a plain dict, ready for JSON."""
        return {
            "substeps": self.suited.substeps,
            "settled": self.settled,
            "uncompared": self.uncompared,
            "gain": self.gain,
            "shift": self.suited.shift(self.trials[0]),
            "trials": [{"substeps": t.substeps, "log_likelihood": t.log_likelihood} for t in self.trials],
        }


def _differs(trial: StepTrial, finer: StepTrial, max_shift: float) -> bool:
    """Whether a finer step gains more than `MIN_GAIN` nats, or moves what is watched without losing as many."""
    gain = finer.log_likelihood - trial.log_likelihood
    return gain > MIN_GAIN or (gain > -MIN_GAIN and finer.shift(trial) > max_shift)


@torch.no_grad()
def check_step(
    program: Program,
    data: Trajectories,
    at: Maximum | ReferencePath | None = None,
    *,
    known_start: bool = False,
    watched: Sequence[str] | None = None,
    max_shift: float = MAX_SHIFT,
    finest: int = MAX_SUBSTEPS_TRIED,
) -> StepCheck:
    """Compare a program with itself at twice, four times … the substeps, refitted to the same drives.

    Fits at finer steps are made only where one look does not exclude that they gain: log p(y) with the parameters as
    they are is no higher there, and a scoring step would hardly move them. Where two steps differ, the coarser one is
    fitted from the finer one's parameters too, and judged there unless that is `MIN_GAIN` nats worse. A finer step that
    loses may have been fitted badly, from parameters that a coarse one has bent: finer ones still are tried as long as
    each halves what is lacking. A network keeps its parameters.

    Args:
        program: with normal noise; see `linearize`.
        data: as returned by `for_program`.
        at: the program's maximum on these drives, or a path near their posterior means, from which it is fitted to them
            first; found when None.
        watched: names of the parameters whose values a finer step must not move either; all but those of noise when
            None, of which a program that holds something within each substep needs more in shorter ones.
        max_shift: nats by which it may move them.
        finest: substeps of a trial, at most; a program may always be tried at twice its own.

    Raises:
        FilterError: the program cannot be smoothed as it is.
    """
    try:
        parts = elements(program)
    except UsageError:  # a network: too many to be refitted by scoring steps
        parts = None
    refits = parts is not None
    if isinstance(at, Maximum) and not at.names:  # fitted by draws: nothing is known of its curvature
        at = at.path
    if not is_step(program, data):  # in substeps it is another model, whose parameters are others
        watched = ()
    elif parts is not None and watched is None:
        watched = [part.owner for part, noise in zip(parts, widens(program, parts, data), strict=True) if not noise]
    names = watched or ()

    def trial(substeps: int, like: Program, path: ReferencePath, steps: int) -> StepTrial:
        changed = with_substeps(like, substeps)
        problem = Problem(changed, data, known_start)
        if not refits:
            ahead = smooth(problem, path, kernels=False)
            require_found(ahead, problem)
            return StepTrial(substeps, float(ahead.log_likelihood.sum()), 0.0, changed, resting_path(ahead, data))
        if steps:
            with seeded(substeps, "wider noise"):
                path = widen_noise(problem, path)
        return _trial(changed, data, maximise(problem, path, steps=steps, precision=REFIT_PRECISION), names)

    def again(coarse: StepTrial, fine: StepTrial) -> StepTrial:
        try:
            found = trial(coarse.substeps, fine.program, fine.path, MAX_REFIT_STEPS)
        except Exception:  # it diverges with these parameters, drives do not tell them apart, or its own code fails
            return coarse
        return found if found.log_likelihood > coarse.log_likelihood - MIN_GAIN else coarse

    own = program.substeps
    most = min(MAX_SUBSTEPS, max(finest, 2 * own))
    if isinstance(at, Maximum):
        first = _trial(program, data, at, names)
    else:
        first = trial(own, program, at or find_path(Problem(program, data, known_start)), 0)
    if counts_rows(program):  # in substeps its delay is another
        return StepCheck((first,), max_shift, f"{UNKNOWN}: `actuators` counts rows, which are shorter in substeps")
    if 2 * own > most:
        return StepCheck((first,), max_shift, f"{UNKNOWN}: {own} substeps a row are as many as are tried")
    trials, lacking, reason = [first], math.inf, None
    begun_from: dict[int, float] = {}  # substeps → log p(y) of the finer fit from which theirs was begun again
    try:
        if refits and not (isinstance(at, Maximum) and first.decrement < MAX_DECREMENT):
            trials = [again(first, first)]
        (first,) = trials
        look = trial(2 * own, first.program, first.path, 0)
        moves = look.decrement - first.decrement > min(max_shift, MAX_DECREMENT)
        before, after = (one.log_likelihood + one.decrement for one in (first, look))  # a scoring step
        if first.decrement < MAX_DECREMENT and after < before + 0.5 * MIN_GAIN and not moves:
            return StepCheck((first,), max_shift)
        if not can_be_cut(program, data):
            return StepCheck((first,), max_shift, f"{UNKNOWN}: `transition` is no step in `step`")
        go_on = True
        while go_on and 2 * trials[-1].substeps <= most:
            coarse = trials[-1]
            fine = trial(2 * coarse.substeps, coarse.program, coarse.path, MAX_REFIT_STEPS)
            trials.append(fine)
            if refits and _differs(coarse, fine, max_shift):  # several maxima of one program are no matter of its step
                trials[-2] = again(coarse, fine)
                begun_from[coarse.substeps] = fine.log_likelihood
            best = max(trials[:-1], key=lambda one: one.log_likelihood)
            lacked, lacking = lacking, best.log_likelihood - fine.log_likelihood
            if lacking > MIN_GAIN:
                go_on = refits and lacking < 0.5 * lacked
            else:
                near = trials[-2] if trials[-2].log_likelihood > best.log_likelihood - MIN_GAIN else best
                lacking, go_on = math.inf, _differs(near, fine, max_shift)
        for index in reversed(range(len(trials) - 2)):
            coarse, fine = trials[index : index + 2]
            risen = fine.log_likelihood > begun_from.get(coarse.substeps, -math.inf) + MIN_GAIN
            if refits and risen and _differs(coarse, fine, max_shift):
                trials[index] = again(coarse, fine)
    except Exception as error:  # also of the program's own code, in steps that nobody tried before
        reason = f"{UNKNOWN}: with {2 * trials[-1].substeps} substeps a row {reason_of(error)}"
    found = StepCheck(tuple(trials), max_shift)
    return replace(found, uncompared=_uncompared(found, reason))


def _uncompared(found: StepCheck, failure: str | None) -> str | None:
    """Why nothing is known of steps finer than the suited one: fits there failed, or lost before they had converged."""
    finer = [trial for trial in found.trials if trial.substeps > found.suited.substeps]
    lost = [trial for trial in finer if trial.log_likelihood < found.suited.log_likelihood - MIN_GAIN]
    if failure and (len(found.trials) == 1 or finer == lost != []):
        return failure
    doubtful = [trial for trial in lost if trial.decrement > MAX_DECREMENT]
    if finer == lost and doubtful:
        counts = " and ".join(str(trial.substeps) for trial in doubtful)
        return f"{UNKNOWN}: fits with {counts} substeps a row have not converged"
    return None


def _trial(program: Program, data: Trajectories, maximum: Maximum, watched: Sequence[str]) -> StepTrial:
    likely, decrement = float(maximum.log_likelihood.sum()), maximum.decrement or 0.0
    in_own_spread = likely + sum(
        len(seen) * math.log(float(seen.std()) or 1.0) for seen in _seen(data) if len(seen) > 1
    )
    most = MAX_NATS_A_NUMBER * int(data.observed.sum())
    if not bool(maximum.information.isfinite().all()) or in_own_spread > most:
        raise FilterError("its likelihood has no maximum on these trajectories: a standard deviation goes to zero")
    found = StepTrial(program.substeps, likely, decrement, program, maximum.path)
    if not (chosen := {i: part for i, part in enumerate(elements(program)) if part.owner in watched}):
        return found
    at, parts = list(chosen), list(chosen.values())
    covariance = pseudo_inverse(maximum.information)[at][:, at]
    return replace(found, names=tuple(part.name for part in parts), values=values_of(parts), covariance=covariance)


def _seen(data: Trajectories) -> list[Tensor]:
    """What each sensor said, `(M,)` each."""
    return [data.measurements[..., k][data.observed[..., k]].double() for k in range(data.measurements.shape[-1])]
