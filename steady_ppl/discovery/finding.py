"""What a search amounts to: an effect with its class, confidence and interval, or a curve; and what to drive next."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy import special
from torch import Tensor

from steady_ppl.comparison.scores import RESAMPLES
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.discovery.candidates import Candidate, spread_of, variance_of_places
from steady_ppl.discovery.judges import MIN_GAIN_OF_CURVE
from steady_ppl.discovery.refits import Refit, with_states_of
from steady_ppl.discovery.screening import NOISE_SIZES, Tested
from steady_ppl.discovery.search_state import Found, Search
from steady_ppl.effects import Effect, Variant, attached
from steady_ppl.gaussian.predict import HALF_WIDTH, simulate_again
from steady_ppl.gaussian.smoother import smooth
from steady_ppl.likelihood.maximize import MAX_OBSERVED
from steady_ppl.likelihood.objective import Term, observed
from steady_ppl.likelihood.parameters import elements
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program, unit_of
from steady_ppl.utils.random import seeded
from steady_ppl.utils.text import reason_of

MAX_LOG_SD = 2.0  # of a factor: beyond it nothing is known but the sign
MAX_LOG_RATIO = 100.0  # of an interval's ends: nothing is known beyond it, and it is a number
BAND_COVERAGE = 0.9  # of the whole band of a curve
MAX_SIMULATED_DRIVES = 24  # of each proposed excitation
EXCITATIONS_OF_KIND = 3  # that are held, pushed, stepped and swung


@dataclass(frozen=True)
class Finding:
    """An effect that a program lacks; of noise that is not the declared, which is a test's result, some are None."""

    variant: Variant  # the effect, the best of its class
    kind: str  # dynamics, actuator, sensor or noise
    aliases: list[str]  # names of the effects that these drives cannot tell apart, best first
    confidence: float | None  # the probability that the right one is among them
    coefficient: list[float]
    sd: list[float]  # standard deviation of each number
    interval: list[tuple[float, float]]  # 90 %
    gain: float | None  # nats of held-out log p(y) that it brings
    is_correction: bool = False  # whether it is how a declared noise is, and says nothing of what is missing


@dataclass(frozen=True)
class Shape:
    """A curve where no effect of the catalogue explains the drives."""

    channel: str  # channel, or measurement, that lacks it
    variable: str  # that it depends on
    times: str  # what the curve is multiplied with, empty where it adds by itself
    unit: str
    variable_unit: str
    points: list[float]
    curve: list[float]  # how high it is there
    band: list[float]  # half the width of a band that holds the whole curve with 90 % probability


def findings(search: Search) -> list[Finding]:
    """The effects that were found, the one that brings most first, and then what the noise is."""
    spread = _Spreads(search)
    found = [_finding(search, one, spread(one.candidate.variant)) for one in search.found]
    found += corrections(search, spread)
    found += [_departure(tested) for tested in search.departed]
    return sorted(found, key=lambda finding: (finding.is_correction, -(finding.gain or 0.0)))


def corrections(search: Search, spread: Callable[[Variant], np.ndarray] | None = None) -> list[Finding]:
    """Of declared noise, with which the search began."""
    found, spread = list[Finding](), spread or _Spreads(search)
    for one in search.corrections:
        effect = one.variant.effect
        least, most = effect.between  # beyond which the likelihood is flat
        value = min(max(float(search.final.coefficient(one.variant)), least), most)
        (sd,) = spread(one.variant).tolist()
        low, high = _interval(effect, value, sd, 0.0, 0.0)
        told = ([value], [sd if effect.null == 0 else value * sd], [(max(low, least), min(high, most))])
        found.append(Finding(one.variant, effect.verdict, [one.variant.name], None, *told, one.gain, True))
    return found


def _finding(search: Search, found: Found, spread: np.ndarray) -> Finding:
    variant, effect = found.candidate.variant, found.candidate.variant.effect
    values = search.final.coefficient(variant).flatten().double().numpy()
    is_positive = effect.null != 0  # and learned as its logarithm
    places = np.zeros_like(spread)
    if variant.profiled:
        places = variance_of_places(found.without, found.candidate).sqrt().numpy() / (values if is_positive else 1.0)
    by_factor = 0.0
    if effect.by_factor:  # one for the whole vector: a component near zero tells none
        by_factor = min(MAX_LOG_SD, float(np.linalg.norm(places)) / max(1e-12, float(np.linalg.norm(values))))
    of_each = zip(values.tolist(), spread.tolist(), places.tolist(), strict=True)
    spread = np.hypot(spread, places)
    return Finding(
        variant=variant,
        kind=effect.verdict,
        aliases=[candidate.variant.name for candidate in found.aliases],
        confidence=_confidence(search, found),
        coefficient=values.tolist(),
        sd=(values * spread if is_positive else spread).tolist(),
        interval=[_interval(effect, *told, by_factor) for told in of_each],
        gain=found.candidate.total,
        is_correction=effect.name in NOISE_SIZES,
    )


def _interval(effect: Effect, value: float, sd: float, of_places: float, by_factor: float) -> tuple[float, float]:
    """With 90 % probability, lopsided by what is uncertain by a factor: `by_factor` is the sd of its logarithm."""
    if effect.null != 0:
        return _around(value, HALF_WIDTH * math.hypot(sd, of_places))
    by = HALF_WIDTH * math.hypot(sd, math.sqrt(max(0.0, of_places**2 - (by_factor * value) ** 2)))
    low, high = sorted(_around(value, HALF_WIDTH * by_factor))
    return value - math.hypot(by, value - low), value + math.hypot(by, high - value)


def _around(value: float, by: float) -> tuple[float, float]:
    """An interval that is symmetric in the logarithm."""
    by = min(by, MAX_LOG_RATIO)
    return value * math.exp(-by), value * math.exp(by)


class _Spreads:
    """See `Screening.spread_of`. Where the program that was found has not been tested, by what is observed there."""

    def __init__(self, search: Search) -> None:
        self.search = search

    def __call__(self, variant: Variant) -> np.ndarray:
        screening, final = self.search.rounds[-1].screening, self.search.final
        (there,) = [known for known in attached(final.program) if known.name == variant.name]
        if any(part.owner == there.parameter for part in screening.parameters):
            return screening.spread_of(final, variant).numpy()
        parts = elements(final.program)
        if len(final.maxima[0].information) < len(parts):  # fits by draws tell none: that of its own test
            (tested,) = [
                one.candidate.tested for one in self.search.found if one.candidate.variant.name == variant.name
            ]
            return math.sqrt(final.first_share) * tested.sd
        return spread_of(final, variant, parts, self._observed).numpy()

    @cached_property
    def _observed(self) -> Tensor:
        """The information; where it cannot be observed, as the fit has it."""
        final, fold = self.search.final, self.search.final.folds[0]
        known = final.maxima[0].information
        if len(known) > MAX_OBSERVED:
            return known
        try:
            seen = observed(Term.alone(fold.fitting(final.program), fold.path), known)
            why = "" if seen is not None else "it diverges beside what was found"
        except Exception as error:  # also of the program's own code, on parameters that nobody tried before
            seen, why = None, reason_of(error)
        if seen is None:
            self.search.notes.append(f"intervals are by the slopes of the fit, whose curvature cannot be seen: {why}")
            return known
        return seen


def _confidence(search: Search, found: Found) -> float:
    """Posterior probability of the class; a curve is less likely before than a candidate, or than none."""
    totals = {c.variant.name: c.total for c in found.rivals if isinstance(c.refit, Refit)}
    totals[found.candidate.variant.name] = found.candidate.total  # its knee may have moved
    curve = max((c.total for c in search.curves if isinstance(c.refit, Refit)), default=-math.inf)
    others = [0.0, found.candidate.total + curve - search.gain - MIN_GAIN_OF_CURVE]
    whole = np.logaddexp.reduce([*totals.values(), *others])
    return float(np.exp(np.logaddexp.reduce([totals[c.variant.name] for c in found.aliases]) - whole))


def _departure(tested: Tested) -> Finding:
    factor, sd = 1 + float(tested.coefficient[0]), float(tested.sd[0])
    interval, name = _around(factor, HALF_WIDTH * sd / factor), tested.variant.name
    return Finding(tested.variant, "noise", [name], None, [factor], [sd], [interval], None, True)


def shape_of(search: Search, program: Program) -> Shape | None:
    """The curve, if that is what was found."""
    if (curve := search.curve) is None or not isinstance(curve.refit, Refit):
        return None
    variant = curve.variant
    heights = curve.refit.coefficient(variant)
    width = float(-special.ndtri((1 - BAND_COVERAGE) / 2 / len(heights))) * math.sqrt(curve.refit.first_share)
    channel = variant.at.partition("~")[0]
    variable = variant.options.get("variable", "reading")
    about = program.measurement_names[0] if channel == "all" else channel
    return Shape(
        channel=channel,
        variable=variable,
        times=variant.options.get("times", ""),
        unit=variant.unit,
        variable_unit=unit_of(program, about if variable == "reading" else variable),
        points=[float(knot) for knot in variant.options["knots"]],
        curve=[float(value) for value in heights],
        band=[width * float(sd) for sd in curve.tested.sd],
    )


def gain_interval(candidate: Candidate, seed: int) -> tuple[float, float] | None:
    """95 % bootstrap interval, over drives, of a candidate's held-out gain; None where it was fitted on one fold."""
    if not candidate.is_judged:
        return None
    gain = candidate.gain.double().numpy() - candidate.charge / len(candidate.gain)
    totals = np.random.default_rng(seed).choice(gain, (RESAMPLES, len(gain))).sum(1)
    low, high = np.quantile(totals, [0.025, 0.975])
    return float(low), float(high)


@dataclass(frozen=True)
class NextRun:
    """Controls to drive next."""

    between: list[str]  # the class
    way: str  # how they are made, in words
    controls: dict[str, list[float]]  # control → its values, one a row
    step: float  # s, of a row
    separation: float  # nats by which one such drive tells the first member of the class from the nearest other
    usual: float  # the same of the drives that there are


@torch.no_grad()
def next_run(found: Found, seed: int) -> NextRun | None:
    """The best of some ways of driving within the limits that were driven; None where none beats the drives there are.

    Each is simulated with the best member of the class; the others are judged by how much less likely they find it.
    """
    members = [(c.variant.name, c.refit) for c in found.aliases if isinstance(c.refit, Refit)]
    refits = [refit for _, refit in members]
    data = refits[0].folds[0].drives
    usual = _separation(refits, data.controls, seed)
    better = []
    for way, controls in _excitations(data, seed):
        apart = _separation(refits, controls.unsqueeze(1).expand_as(data.controls), seed)
        if math.isfinite(apart) and apart > max(0.0, usual):
            better.append((apart, way, controls))
    if not better:
        return None
    separation, way, controls = max(better, key=lambda one: one[0])
    order = refits[0].program.control_names
    return NextRun(
        between=[name for name, _ in members],
        way=way,
        controls={name: [round(v, 4) for v in controls[:, i].tolist()] for i, name in enumerate(order)},
        step=data.median_step,
        separation=separation,
        usual=usual if math.isfinite(usual) else 0.0,
    )


def _separation(refits: list[Refit], controls: Tensor, seed: int) -> float:
    """Nats a drive by which the first member is told from the nearest other."""
    fold, (program, *others) = refits[0].folds[0], [refit.judges.programs[0] for refit in refits]
    count = min(MAX_SIMULATED_DRIVES, len(fold.drives))
    drives = replace(fold.drives.subset(range(count)), controls=controls[:, :count].contiguous())
    starts = fold.path.states[0, :count].unsqueeze(0)
    with seeded(seed, "next run"):
        again, truth = simulate_again(program, drives, starts, len(program.channels))

    def log_likelihood(judge: Program) -> Tensor:
        problem = Problem(judge, with_states_of(judge, again), fold.known_start)
        return smooth(problem, with_states_of(judge, truth), passes=4).log_likelihood

    own = log_likelihood(program)
    apart = [float((own - log_likelihood(other)).mean()) for other in others]
    return min(apart) if all(map(math.isfinite, apart)) else math.nan


def _excitations(data: Trajectories, seed: int) -> Iterator[tuple[str, Tensor]]:
    """Ways of driving: held, stepped and swept between the limits that were driven."""
    driven = data.controls[:-1][data.transitions]
    low, high = driven.amin(0), driven.amax(0)
    rows, count = len(data.controls), driven.shape[-1]
    time = torch.arange(rows).to(driven) / max(1, rows - 1)
    middle = (low + high) / 2
    with seeded(seed, "ways of driving"):
        for index in range(EXCITATIONS_OF_KIND):
            held = torch.where(torch.rand(count) < 0.5, low, high)
            yield f"hold {index + 1}: one level throughout", held.expand(rows, count).clone()
            least = torch.zeros_like(low).clamp(low, high)
            push = torch.where((time < (0.2, 0.4, 0.6)[index]).unsqueeze(-1), high, least)
            yield f"push and coast: full for {(20, 40, 60)[index]} % of the time, then as little as was driven", push
            levels = low + (high - low) * torch.rand(5, count)
            held = levels[(time * 4.999).long()]
            yield f"steps {index + 1}: five random levels", held
            periods = torch.tensor([2.0, 3.0, 5.0]).to(driven)[(torch.arange(count) + index) % 3]
            swept = middle + (high - low) / 2 * (2 * torch.pi * periods * time.unsqueeze(-1)).sin()
            yield f"swing {index + 1}: sines between the limits", swept
