"""What a search has come to: its rounds, the effects that were found, and the program that has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from steady_ppl.criticism.step_size import StepCheck
from steady_ppl.discovery.candidates import CLEAR_GAIN, MAX_NATS_OF_RIVAL, TIE_NATS, Candidate, Screening
from steady_ppl.discovery.judges import MIN_GAIN_OF_CURVE
from steady_ppl.discovery.noise_first import Correction
from steady_ppl.discovery.refits import Refit
from steady_ppl.discovery.screening import FAMILY_LEVEL, NOISE_SIZES, Tested
from steady_ppl.effects import attached
from steady_ppl.likelihood.outliers import Outliers
from steady_ppl.utils.journal import close_journal

MAX_EFFECTS = 5  # in a program
LOOKING, FINER = "testing and fitting effects", "looking again at a finer time step"  # that may be interrupted


@dataclass(frozen=True)
class Round:
    """What was tested, fitted and chosen."""

    screening: Screening  # the tests of the program so far
    candidates: list[Candidate]  # those that were fitted, best first
    chosen: Candidate | None  # what is added, None when the round ends the search

    @property
    def nothing_found(self) -> bool:
        return self.screening.tests.p_value > FAMILY_LEVEL


@dataclass(frozen=True)
class Found:
    """An effect that was chosen."""

    candidate: Candidate  # the best
    candidates: list[Candidate]  # all that were fitted in its place, best first
    without: Refit  # the program without it

    @property
    def rivals(self) -> list[Candidate]:
        """Those that may be what the best stands for: what imitates anything is no rival of an explanation."""
        return [c for c in self.candidates if c.is_explanation or not self.candidate.is_explanation]

    @property
    def aliases(self) -> list[Candidate]:
        """Those that these drives cannot tell from the best, itself first, wherever its knee is."""
        best = self.candidate
        close = [c for c in self.rivals if c.total >= best.total - TIE_NATS and not c.against_its_sign]
        return [best, *(c for c in close if c is not best and c.variant.name != best.variant.name)]

    @property
    def contenders(self) -> list[Candidate]:
        """The best and those that were nearly as good in its place."""
        best = self.candidate
        others = (c for c in self.rivals if c.variant.name != best.variant.name)
        near = [c for c in others if c.total > best.total - MAX_NATS_OF_RIVAL]
        return [c for c in (best, *near) if isinstance(c.refit, Refit)]


@dataclass
class Search:
    """The state of a search: what it has come to so far."""

    as_it_stands: Refit  # the program, fitted
    base: Refit  # the same with noise that is corrected, from which the search begins
    final: Refit  # the program with all effects that were found, fitted
    step: StepCheck  # the base beside itself at finer steps; all else is at the step that suits
    gained: float  # nats that fitting the program as it stands gained on the training drives
    outliers: list[Outliers] = field(default_factory=list)  # of the training and of the validation drives
    corrections: list[Correction] = field(default_factory=list)  # of the noise that it declares
    with_found: StepCheck | None = None  # the final program of the coarser search that asked for this step
    asks: StepCheck | None = None  # the final program, where it asks for a finer step
    rounds: list[Round] = field(default_factory=list)  # the last tests the final program unless the search ended early
    found: list[Found] = field(default_factory=list)  # the effects that were added
    curves: list[Candidate] = field(default_factory=list)  # fitted in place of the first effect, best first
    taken_back: dict[str, str] = field(default_factory=dict)  # effects with which the program failed, and how
    notes: list[str] = field(default_factory=list)  # what could not be done
    interrupted: str = ""  # what was being done when an interrupt (Ctrl-C) came; empty as a rule
    cut_short: bool = False  # whether the interrupt came before the search had ended

    def interrupt(self, doing: str, *, cut_short: bool = True) -> None:
        """End with what has been found so far."""
        close_journal()
        self.interrupted, self.cut_short = doing, cut_short

    @property
    def is_complete(self) -> bool:
        """Whether the tests of the last round found nothing more that an effect or a curve could bring."""
        tests = self.rounds[-1].screening.tests
        quiet = not any(tested.p_value <= tests.critical for tested in tests.tested if not tested.departure)
        return quiet and not self.cut_short

    @property
    def is_full(self) -> bool:
        """Whether it has as many effects as it may; factors on noise take no place."""
        return sum(one.candidate.variant.effect.name not in NOISE_SIZES for one in self.found) >= MAX_EFFECTS

    @property
    def departed(self) -> list[Tested]:
        """What says, in the last tests, that the fitted noise is not the declared; a missing effect may say so too."""
        if self.interrupted == LOOKING:
            return []
        tests = self.rounds[-1].screening.tests
        return [tested for tested in tests.tested if tested.departure and tested.p_value <= tests.critical]

    @property
    def curve(self) -> Candidate | None:
        """The curve that gains more than all effects; where the noise departs as well, it must be significant."""
        best = next((curve for curve in self.curves if curve.is_judged), None)
        if best is None or best.total <= self.gain + MIN_GAIN_OF_CURVE:
            return None
        tests = self.rounds[0].screening.tests
        of_all = min(tested.p_value for tested in tests.tested if tested.is_curve)
        return best if not self.departed or best.total > CLEAR_GAIN or of_all <= tests.critical else None

    @property
    def gain(self) -> float:
        """Held-out log p(y) of the final program above the first, nats."""
        return float((self.final.held_out - self.base.held_out[: len(self.final.held_out)]).sum())


def with_places_of(final: Refit, found: Sequence[Found]) -> list[Found]:
    """What was found, with the knees and places that the final program has."""
    there = {variant.name: variant for variant in attached(final.program)}

    def moved(one: Found) -> Found:
        candidate, variant = one.candidate, there.get(one.candidate.variant.name)
        if variant is None or variant.profiled == candidate.variant.profiled:
            return one
        return replace(one, candidate=replace(candidate, tested=candidate.tested.at(variant)))

    return [moved(one) for one in found]
