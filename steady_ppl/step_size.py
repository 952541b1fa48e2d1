"""Whether a program's own time step suits its drives: the first suspect where model and measurements differ.

A program moves by steps, a vehicle in continuous time. What a coarse step gets wrong looks like physics: a delay, a
lever arm, a drag. So a program is compared with itself at finer substeps before anything else is suspected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from steady_ppl.data import Trajectories
from steady_ppl.elements import elements, values_of
from steady_ppl.errors import FilterError, UsageError
from steady_ppl.gaussian_smoother import find_path, require_found, resting_path, smooth
from steady_ppl.likelihood_fit import roomy_path
from steady_ppl.linearization import Path
from steady_ppl.maximum_likelihood import Maximum, maximise
from steady_ppl.program import Program
from steady_ppl.scores import widens
from steady_ppl.stability import can_be_cut, counts_rows, is_step
from steady_ppl.substeps import MAX_SUBSTEPS, with_substeps

MIN_GAIN = 3.0  # nats, of all drives together, from which a finer step counts
MAX_SHIFT = 2.0  # nats that watched parameters of another step lie below the maximum: two standard deviations
MAX_DECREMENT = 1.0  # nats that a scoring step at a finer step may promise; beyond it its refit may gain far more
UNFITTED = 0.2  # share of what a scoring step promises at the program's own step, for parameters that are not fitted
UNSETTLED = 50.0  # nats that a scoring step may promise at the program's own step; beyond it a look excludes nothing
PRECISION = 0.005  # nats, of refits
FINEST = 32  # substeps of a trial, at most, unless more are asked for; a program may always be tried at twice its own
REFITS = 25  # scoring steps of a fit
UNKNOWN = "whether the time step suits is not known"


@dataclass(frozen=True)
class StepTrial:
    """A program with some number of substeps a row.

    Attributes:
        substeps: of a row.
        log_likelihood: log p(y) of all drives, linearised.
        decrement: what a scoring step would add, nats; zero where parameters are not refitted.
        program: with the parameters of this trial.
        path: of the drives, along which it was linearised.
        names, values, covariance: of the learnable numbers that are watched, `(P,)`, `(P,)`, `(P, P)`.
    """

    substeps: int
    log_likelihood: float
    decrement: float
    program: Program
    path: Path
    names: tuple[str, ...] = ()
    values: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    covariance: Tensor = field(default_factory=lambda: torch.zeros(0, 0, dtype=torch.float64))

    @property
    def reachable(self) -> float:
        """Log p(y) after another scoring step, as far as the score says."""
        return self.log_likelihood + self.decrement

    def shift(self, other: StepTrial) -> float:
        """Nats that the other trial's watched parameters lie below this one's maximum, to second order."""
        if not self.names:
            return 0.0
        change = other.values - self.values
        return 0.5 * float(change @ torch.linalg.pinv(self.covariance) @ change)

    def farthest(self, other: StepTrial) -> tuple[str, float]:
        """The watched number that differs most from the other trial's, and by how many standard deviations."""
        spread = self.covariance.diagonal().clamp(min=1e-300).sqrt()
        apart = ((other.values - self.values) / spread).abs()
        index = int(apart.argmax())
        return self.names[index], float(apart[index])


@dataclass(frozen=True)
class StepCheck:
    """A program beside itself at finer steps, on the same drives.

    Attributes:
        trials: the program's own number of substeps first, then twice as many each time, to the first that changes
            neither log p(y) nor the watched parameters by what counts, or the second in a row whose fit loses.
        max_shift: nats by which the watched parameters may move.
        uncompared: why the program was fitted at no finer step, None where it was or where one look excluded a gain.
    """

    trials: tuple[StepTrial, ...]
    max_shift: float = MAX_SHIFT
    uncompared: str | None = None

    @property
    def suited(self) -> StepTrial:
        """The trial with the fewest substeps, beyond which twice as many change nothing that counts."""
        return next(
            trial
            for index, trial in enumerate(self.trials)
            if not any(_differs(trial, finer, self.max_shift) for finer in self.trials[index + 1 :])
        )

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
        """Whether finer steps make the drives likelier by more than `MIN_GAIN` nats, or move what is watched by more
        than `max_shift`."""
        return self.suited is not self.trials[0]

    @property
    def sentence(self) -> str:
        """What is to be said first where a finer step makes the drives likelier or moves parameters far; empty
        otherwise."""
        if self.gain > MIN_GAIN:
            said = f"{self._instead} gain {self.gain:.0f} nats"
            if not self.settled:
                coarser, last = self.trials[-2:]
                gain = last.log_likelihood - coarser.log_likelihood
                if gain > MIN_GAIN:
                    said += f", the last doubling {gain:.0f} of them: more substeps may gain more"
                else:
                    name, far = last.farthest(coarser)
                    said += f", the last doubling moves {name} by {far:.1f} standard deviations"
        elif self.too_coarse and self.suited.shift(self.trials[0]) > MAX_SHIFT:
            said = f"{self._instead} move {self._farthest}"
        else:
            return ""
        return f"the program's own time step is too coarse: {said} ({self._option})"

    @property
    def note(self) -> str:
        """What is to be noted where a finer step moves parameters a little; empty otherwise."""
        if not self.too_coarse or self.sentence:
            return ""
        return f"{self._instead} move {self._farthest} ({self._option})"

    @property
    def _farthest(self) -> str:
        name, far = self.suited.farthest(self.trials[0])
        return f"{name} by {far:.1f} standard deviations"

    @property
    def _instead(self) -> str:
        return f"{self.suited.substeps} substeps a row instead of {self.trials[0].substeps}"

    @property
    def _option(self) -> str:
        return f"fit with --substeps {self.suited.substeps}"

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
    at: Maximum | Path | None = None,
    *,
    known_start: bool = False,
    watched: Sequence[str] | None = None,
    max_shift: float = MAX_SHIFT,
    finest: int = FINEST,
) -> StepCheck:
    """Compare a program with itself at twice, four times … the substeps, refitted to the same drives.

    Fits are made only where one look at a finer step does not exclude that it gains: its log p(y) with the parameters
    as they are is no higher, and a scoring step would hardly move them. Where two steps differ, the coarser one is
    fitted from the finer one's parameters too, and judged there unless that is `MIN_GAIN` nats worse. A finer step that
    loses may have been fitted badly, from parameters that a coarse one has bent: one finer still is tried. A network
    keeps its parameters.

    Args:
        program: with normal noise; see `linearize`.
        data: as returned by `for_program`.
        at: the program's maximum on these drives, or a path near their posterior means; found when None.
        known_start: the first state is certain.
        watched: names of the parameters whose values a finer step must not move either; all but those of noise when
            None, of which a program that holds something within each substep needs more in shorter ones.
        max_shift: nats by which it may move them.
        finest: substeps of a trial, at most; a program may always be tried at twice its own.

    Raises:
        FilterError: the program cannot be smoothed as it is.
    """

    refits = can_refit(program)
    if isinstance(at, Maximum) and not at.names:  # fitted by draws: nothing is known of its curvature
        at = at.path
    if not is_step(program, data):  # in substeps it is another model, whose parameters are others
        watched = ()
    elif refits and watched is None:
        watched = [part.name.split("[")[0] for part in elements(program) if not widens(program, part, data)]
    names = watched or ()

    def trial(substeps: int, like: Program, path: Path, steps: int) -> StepTrial:
        changed = with_substeps(like, substeps)
        if not refits:
            ahead = smooth(changed, data, path, known_start=known_start, kernels=False)
            require_found(ahead, changed, data)
            return StepTrial(substeps, float(ahead.log_likelihood.sum()), 0.0, changed, resting_path(ahead, data))
        if steps:
            path = roomy_path(changed, data, known_start, path)
        maximum = maximise(changed, data, path, known_start=known_start, steps=steps, precision=PRECISION)
        return _trial(changed, maximum, names)

    def again(coarse: StepTrial, fine: StepTrial) -> StepTrial:
        try:
            found = trial(coarse.substeps, fine.program, fine.path, REFITS)
        except FilterError:  # at the coarser step the finer one's parameters diverge
            return coarse
        return found if found.log_likelihood > coarse.log_likelihood - MIN_GAIN else coarse

    own = program.substeps
    most = min(MAX_SUBSTEPS, max(finest, 2 * own))
    if isinstance(at, Maximum):
        first = _trial(program, at, names)
    else:
        first = trial(own, program, at or find_path(program, data, known_start=known_start), 0)
    if counts_rows(program):  # in substeps its delay is another
        return StepCheck((first,), max_shift, f"{UNKNOWN}: `actuators` counts rows, which are shorter in substeps")
    if 2 * own > most:
        return StepCheck((first,), max_shift, f"{UNKNOWN}: {own} substeps a row are as many as are tried")
    trials, reason = [first], None
    try:
        look = trial(2 * own, program, first.path, 0)
        allowed = max(min(max_shift, MAX_DECREMENT), UNFITTED * first.decrement)
        moves = look.decrement - first.decrement > allowed
        fitted = not refits or first.decrement < UNSETTLED
        if fitted and look.reachable < first.reachable + 0.5 * MIN_GAIN and not moves:
            return StepCheck((first,), max_shift)
        if not can_be_cut(program, data):
            return StepCheck((first,), max_shift, f"{UNKNOWN}: `transition` is no step in `step`")
        if refits and not isinstance(at, Maximum):
            first = trial(own, program, first.path, REFITS)
        trials, lost = [first], False
        trials.append(trial(2 * own, first.program, first.path, REFITS))
        while True:
            coarse, fine = trials[-2:]
            if refits and _differs(coarse, fine, max_shift):  # several maxima of one program are no matter of its step
                trials[-2] = again(coarse, fine)
            lost, lost_before = fine.log_likelihood < trials[-2].log_likelihood - MIN_GAIN, lost
            go_on = _differs(trials[-2], fine, max_shift) or (lost and not lost_before)
            if not go_on or 2 * fine.substeps > most:
                break
            trials.append(trial(2 * fine.substeps, fine.program, fine.path, REFITS))
    except FilterError as error:  # paths of the coarser step lead nowhere at the finer one: nothing speaks for that one
        if len(trials) == 1:
            reason = f"{UNKNOWN}: with {2 * own} substeps a row {error}"
    return StepCheck(tuple(trials), max_shift, reason)


def can_refit(program: Program) -> bool:
    """Whether a program has few enough learnable numbers to be refitted by scoring steps."""
    try:
        elements(program)
    except UsageError:
        return False
    return True


def _trial(program: Program, maximum: Maximum, watched: Sequence[str]) -> StepTrial:
    parts = elements(program)
    chosen = [index for index, part in enumerate(parts) if part.name.split("[")[0] in watched]
    covariance = torch.linalg.pinv(maximum.information) if chosen else torch.zeros(0, 0, dtype=torch.float64)
    return StepTrial(
        program.substeps,
        float(maximum.log_likelihood.sum()),
        maximum.decrement or 0.0,
        program,
        maximum.path,
        tuple(parts[index].name for index in chosen),
        values_of([parts[index] for index in chosen]),
        covariance[chosen][:, chosen],
    )
