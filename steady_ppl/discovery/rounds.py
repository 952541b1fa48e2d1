"""What a search has come to: its rounds, and the effects that were found."""

from __future__ import annotations

from dataclasses import dataclass, field

from steady_ppl.criticism.step_size import StepCheck
from steady_ppl.discovery.candidates import NATS, NO_DOUBT, Candidate, Screening
from steady_ppl.discovery.refits import Refit
from steady_ppl.discovery.screening import LEVEL, Tested

MARGIN = 3.0  # nats by which a curve must be better than named effects


@dataclass(frozen=True)
class Round:
    """What was tested, fitted and chosen.

    Attributes:
        screening: the tests of the program so far.
        candidates: those that were fitted, best first.
        chosen: what is added, None when the round ends the search.
    """

    screening: Screening
    candidates: list[Candidate]
    chosen: Candidate | None

    @property
    def quiet(self) -> bool:
        """Whether the tests found nothing."""
        return self.screening.tests.p_value > LEVEL


@dataclass(frozen=True)
class Found:
    """An effect that was chosen.

    Attributes:
        candidate: the best.
        candidates: all that were fitted in its place, best first.
        without: the program without it.
    """

    candidate: Candidate
    candidates: list[Candidate]
    without: Refit

    @property
    def alike(self) -> list[Candidate]:
        """Those that these drives cannot tell from the best, itself first."""
        best = self.candidate.total
        close = [c for c in self.candidates if c.total >= best - NATS]
        return [self.candidate, *(c for c in close if c is not self.candidate and not c.against_its_sign)]


@dataclass
class Search:
    """What a search came to.

    Attributes:
        known_start: the first states are certain.
        base: the program as it stands, fitted.
        gained: nats that fitting the program as it stands gained on the training drives.
        rounds: in their order; the last tests the final program unless the search ended early.
        found: the effects that were added.
        final: the program with all of them, fitted.
        step: the program as it stands beside itself at finer steps; all else is at the step that suits.
        with_found: the program with what was found beside itself at finer steps, where these asked for a second search
            at the step that suits; None where they did not.
        curves: fits of curves in place of the first effect, best first, where effects alone did not explain the drives.
        broke: effects that were taken back because the program with them blew up on drives of its own.
    """

    known_start: bool
    base: Refit
    final: Refit
    step: StepCheck
    gained: float
    with_found: StepCheck | None = None
    rounds: list[Round] = field(default_factory=list)
    found: list[Found] = field(default_factory=list)
    curves: list[Candidate] = field(default_factory=list)
    broke: list[str] = field(default_factory=list)

    @property
    def is_complete(self) -> bool:
        """Whether the tests of the last round found nothing more that an effect or a curve could bring."""
        tests = self.rounds[-1].screening.tests
        return not any(tested.p_value <= tests.critical for tested in tests.tested if not tested.departure)

    @property
    def departed(self) -> list[Tested]:
        """What says, in the last tests, that the fitted noise is not the declared."""
        tests = self.rounds[-1].screening.tests
        return [tested for tested in tests.tested if tested.departure and tested.p_value <= tests.critical]

    @property
    def curve(self) -> Candidate | None:
        """The curve that explains the drives better than all effects that were found; where the noise alone may be what
        the tests found, one that is significant itself."""
        best = next((curve for curve in self.curves if isinstance(curve.refit, Refit)), None)
        if best is None or best.total <= self.gain + MARGIN:
            return None
        tests = self.rounds[0].screening.tests
        of_all = min(tested.p_value for tested in tests.tested if tested.is_curve)
        return best if not self.departed or best.total > NO_DOUBT or of_all <= tests.critical else None

    @property
    def needs_a_name(self) -> bool:
        """Whether neither a curve nor departed noise can be what the tests found."""
        return self.curve is None and not self.departed

    @property
    def gain(self) -> float:
        """Held-out log p(y) of the final program above the first, nats."""
        return float((self.final.held_out - self.base.held_out[: len(self.final.held_out)]).sum())
