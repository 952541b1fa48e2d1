"""What a search amounts to: an effect with its class, confidence and interval, or a curve."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats

from steady_ppl.discovery.candidates import Candidate
from steady_ppl.discovery.curves import unit_of
from steady_ppl.discovery.profile import variance_of_places
from steady_ppl.discovery.refits import Refit
from steady_ppl.discovery.screening import Tested
from steady_ppl.discovery.search import MIN_GAIN_OF_CURVE, Found, Search
from steady_ppl.effects import Variant, attached
from steady_ppl.model.program import Program

INTERVAL = 0.9
RESAMPLES = 2000


@dataclass(frozen=True)
class Finding:
    """An effect that a program lacks; of noise that is not the declared, which is a test's result, some are None."""

    variant: Variant  # the effect, the best of its class
    kind: str  # dynamics, actuator, sensor or noise
    alike: list[str]  # names of the effects that these drives cannot tell apart, best first
    confidence: float | None  # the probability that the right one is among them
    coefficient: list[float]
    sd: list[float]  # standard deviation of each number
    interval: list[tuple[float, float]]  # 90 %
    gain: float | None  # nats of held-out log p(y) that it brings


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
    """The effects that were found, the one that brings most first."""
    found = [_finding(search, one) for one in search.found]
    found += [_departure(search, tested) for tested in search.departed]
    return sorted(found, key=lambda finding: -(finding.gain or 0.0))


def _finding(search: Search, found: Found) -> Finding:
    refit = search.final
    variant, effect = found.candidate.variant, found.candidate.variant.effect
    values = refit.coefficient(variant).flatten().double().numpy()
    spread = _spread(search, variant, len(values))
    if variant.profiled:
        places = variance_of_places(found.without, found.candidate)
        scale = values if effect.null != 0 else 1.0  # of its logarithm
        spread = np.sqrt(spread**2 + places.numpy() / scale**2)
    by = stats.norm.isf((1 - INTERVAL) / 2)
    if effect.null != 0:  # positive, learned as its logarithm
        interval = [(v * math.exp(-by * s), v * math.exp(by * s)) for v, s in zip(values, spread, strict=True)]
        spread = values * spread
    else:
        interval = [(v - by * s, v + by * s) for v, s in zip(values, spread, strict=True)]
    alike = found.alike
    return Finding(
        variant=variant,
        kind=effect.verdict,
        alike=[candidate.variant.name for candidate in alike],
        confidence=_confidence(search, found, alike),
        coefficient=values.tolist(),
        sd=spread.tolist(),
        interval=[(float(low), float(high)) for low, high in interval],
        gain=found.candidate.total,
    )


def _spread(search: Search, variant: Variant, count: int) -> np.ndarray:
    """Standard deviations in the space in which the coefficient is learned, of a fit to all drives."""
    screening = search.rounds[-1].screening
    information = screening.information[""]
    ridge = 1e-10 * float(information.diagonal().max()) * torch.eye(len(information)).double()
    covariance = torch.linalg.inv(information + ridge)  # what the drives do not tell has a huge variance
    learned = [part.name.split("[")[0] for part in screening.parameters]
    (there,) = [known for known in attached(search.final.program) if known.name == variant.name]
    index = [i for i, name in enumerate(learned) if name == there.parameter]
    assert len(index) == count
    return (search.final.first_share * covariance.diagonal()[index]).clamp(min=0).sqrt().numpy()


def _confidence(search: Search, found: Found, alike: Sequence[Candidate]) -> float:
    """Posterior probability of the class; all candidates and none are alike before, a curve is less likely by
    `MIN_GAIN_OF_CURVE`."""
    totals = {id(c): c.total for c in found.candidates if isinstance(c.refit, Refit)}
    curve = max((c.total for c in search.curves if isinstance(c.refit, Refit)), default=-math.inf)
    rivals = [0.0, found.candidate.total + curve - search.gain - MIN_GAIN_OF_CURVE]
    whole = np.logaddexp.reduce([*totals.values(), *rivals])
    return float(np.exp(np.logaddexp.reduce([totals[id(c)] for c in alike]) - whole))


def _departure(search: Search, tested: Tested) -> Finding:
    factor, sd = 1 + float(tested.coefficient[0]), float(tested.sd[0])
    by = stats.norm.isf((1 - INTERVAL) / 2) * sd / factor
    return Finding(
        variant=tested.variant,
        kind="noise",
        alike=[tested.variant.name],
        confidence=None,
        coefficient=[factor],
        sd=[sd],
        interval=[(factor * math.exp(-by), factor * math.exp(by))],
        gain=None,
    )


def shape_of(search: Search, program: Program) -> Shape | None:
    """The curve, if that is what was found."""
    curve = search.curve
    if curve is None or not isinstance(curve.refit, Refit):
        return None
    variant = curve.variant
    heights = curve.refit.coefficient(variant)
    wide = float(stats.norm.isf((1 - INTERVAL) / 2 / len(heights))) * math.sqrt(curve.refit.first_share)
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
        band=[wide * float(sd) for sd in curve.tested.sd],
    )


def gain_interval(candidate: Candidate, seed: int) -> tuple[float, float] | None:
    """95 % bootstrap interval, over drives, of a candidate's held-out gain; None where it was fitted on one fold."""
    if isinstance(candidate.refit, str) or len(candidate.refit.programs) == 1:
        return None
    gain = candidate.gain.double().numpy() - candidate.charge / len(candidate.gain)
    random = np.random.default_rng(seed)
    totals = random.choice(gain, (RESAMPLES, len(gain))).sum(1)
    low, high = np.quantile(totals, [0.025, 0.975])
    return float(low), float(high)
