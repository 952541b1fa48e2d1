"""Who is at fault: sensor, actuator, dynamics or noise, or that these drives cannot tell.

The covariance of the scores, estimated from simulated drives, is the information matrix: an effect of size β in
direction j moves the expected scores by its column j times β. So what one direction explains can be taken out of all
others, and the kind of direction that leaves least is the one to blame, if the next kind is clearly worse.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from steady_ppl.criticism.perturbations import Direction
from steady_ppl.criticism.residual_maps import CHECK_LEVEL, Array, standardise, tail_p_values

FAULT_KINDS = ("sensor", "actuator", "dynamics")  # of directions
MIN_GAIN_OF_KIND = 3.0  # nats of log p(y) between the best kind and the next
SCATTER = "scatter of "  # begins the names of mean squares
MAX_DIRECTIONS = 4  # of a kind, that are picked one after the other
MAX_INFORMATIVE_SD = 100.0  # so far off the scores say nothing of what would be nearest to the drives
MAX_SCORE_SD = 5.0  # standard deviations of one drive's score, more where most drives' are large
MIN_GAIN_OF_DIRECTION = 2.0  # nats that another direction of the same kind must bring


@dataclass(frozen=True)
class Attribution:
    """What the scores say."""

    kind: str  # "sensor", "actuator", "dynamics", "parameters", "noise", "cannot tell" or "nothing found"
    p_value: float  # of the hypothesis that the program is right, all tests together
    p_values: dict[str, float]  # of "mean", "parameters", "noise" and "maps": that nothing is wrong with them
    level: float  # of each of these, with which all together keep the level of a check
    explained: dict[str, float]  # nats that the best directions of each kind explain
    evidence: list[tuple[str, str, float]]  # the directions picked, best first: (kind, name, z)
    parameters: dict[str, float]  # z of each parameter's score
    noise: dict[str, float]  # z of each mean square
    dispersion: float  # how much more than simulated drives the drives differ in their scores


@dataclass(frozen=True)
class Scored:
    """Scores of `J` directions, made comparable."""

    kinds: list[str]
    names: list[str]
    z: Array  # (1 + M, J), the real set first
    correlation: Array  # (J, J)
    dispersion: Array  # (1 + M, J): how much more than simulated drives the drives of a set differ

    def p_values(self, widest: Array) -> Array:
        """Of the hypothesis that no direction of a set is wrong, `(1 + M,)`; wrong noise scatters scores no wider than
        `widest`."""
        z = self.z / np.sqrt(np.minimum(self.dispersion, widest).clip(1.0))
        return tail_p_values(np.abs(z).max(-1)) if self.names else np.ones(len(z))

    def explaining(self, kind: str, widened: float) -> tuple[list[int], float]:
        """Some directions of a kind, picked one after the other, and the nats that they explain, less their price."""
        z, correlation = self.z[0] / widened, self.correlation
        members = np.array([own == kind for own in self.kinds])
        picked, nats = list[int](), list[float]()
        for step in range(min(MAX_DIRECTIONS, len(z))):
            spread = correlation.diagonal()
            left = np.where(members & (spread > 0.02), z**2 / np.maximum(spread, 0.02), 0.0)
            j = int(left.argmax())
            gain = 0.5 * float(left[j]) - (MIN_GAIN_OF_DIRECTION if step else 0.0)
            if gain <= 0:
                break
            picked.append(j)
            nats.append(gain)
            column = correlation[:, j] / max(float(spread[j]), 1e-12)
            z = z - column * z[j]
            correlation = correlation - np.outer(column, correlation[j])
        return picked, sum(nats)


def scored(real: Sequence[Direction], simulated: Sequence[Direction], sets: int) -> tuple[Scored, Scored]:
    """Standardise scores of `B` real and `sets` · `B` simulated drives: what the parameters' leave of the others', and
    the parameters' own."""
    order = {direction.name: direction for direction in real}
    simulated = [direction for direction in simulated if direction.name in order]
    real = [order[direction.name] for direction in simulated]
    own = np.array([d.kind == "parameter" for d in real])
    scores = [torch.cat([ours.scores, theirs.scores]).double() for ours, theirs in zip(real, simulated, strict=True)]
    each = _without_outliers(torch.stack(scores, -1).numpy().reshape(1 + sets, -1, len(real)))  # (1 + M, B, J)
    covariance = np.einsum("mbi,mbj->ij", each[1:], each[1:]) / (sets - 1)
    fit = _Fitted(covariance, own)
    free = ~own & (fit.left.diagonal() > 0.02) & (covariance.diagonal() > 1e-20)
    parts = [fit.split(each[0], free)]
    for values in each[1:]:  # compared with the others, as the real set is: what fits itself looks small
        away = values * sets / (sets - 1)
        parts.append(_Fitted((covariance * (sets - 1) - values.T @ away) / (sets - 2), own).split(away, free))
    parameters, rest = (np.stack(part) for part in zip(*parts, strict=True))
    sd = fit.spread(free)
    left = fit.left[np.ix_(free, free)] / np.outer(sd, sd)
    of_parameters = _dispersion(each / fit.scale, fit.correlation)[:, own]

    def of(chosen: Array, scores: Array, correlation: Array, dispersion: Array) -> Scored:
        members = [real[j] for j in np.flatnonzero(chosen)]
        kinds, names = [one.kind for one in members], [one.name for one in members]
        return Scored(kinds, names, scores.sum(1), correlation, dispersion)

    others = of(free, rest, left, _dispersion(rest, left))
    return others, of(own, parameters, fit.correlation[np.ix_(own, own)], of_parameters)


class _Fitted:
    """A covariance of scores `(J, J)`, and what of every score those of the parameters, `own` `(J,)`, explain."""

    def __init__(self, covariance: Array, own: Array) -> None:
        self.own, self.scale = own, np.sqrt(np.maximum(covariance.diagonal(), 1e-300))
        self.correlation = covariance / np.outer(self.scale, self.scale)
        of_own = self.correlation[np.ix_(own, own)]
        self.by_own = self.correlation[:, own] @ np.linalg.pinv(of_own, rcond=1e-6, hermitian=True)  # regression (J, P)
        self.left = self.correlation - self.by_own @ self.correlation[own]  # what the parameters leave of it

    def split(self, values: Array, free: Array) -> tuple[Array, Array]:
        """Scores `(B, J)` of the parameters and, less what those explain, of the `free`, in standard deviations."""
        values = values / self.scale
        own = values[:, self.own]
        return own, (values - own @ self.by_own.T)[:, free] / self.spread(free)

    def spread(self, free: Array) -> Array:
        """Standard deviations of what is left of the `free` scores; those of fewer sets may leave hardly any."""
        return np.sqrt(np.maximum(self.left.diagonal()[free], 1e-3))


def _without_outliers(each: Array) -> Array:
    """Less the simulated mean, and no drive's score much larger than most drives' of its set: past a landmark closely
    the linearised program's are, by chance."""
    each = each - each[1:].mean(0)
    sd = np.maximum(each[1:].std(0), 1e-300)
    most = MAX_SCORE_SD * sd * np.median(np.abs(each) / sd, axis=1, keepdims=True).clip(1.0)
    return each.clip(-most, most)


def _dispersion(each: Array, correlation: Array) -> Array:
    """Mean square of what the drives' scores `(1 + M, B, J)` differ by, over that of simulated drives, `(1 + M, J)`.

    A direction that is wrong moves all drives' scores alike, in proportion to what each could tell of it; noise that is
    wrong moves them apart. Directions that go together share their dispersion. One drive does not differ: infinite.
    """
    sets, drives, _ = each.shape
    if drives < 2:
        return np.full((sets, each.shape[-1]), np.inf)
    variance = np.maximum(each[1:].var(0), 1e-300)
    size = each.sum(1, keepdims=True) / variance.sum(0)
    squares = (((each - size * variance) / np.sqrt(variance)).clip(-MAX_SCORE_SD, MAX_SCORE_SD) ** 2).mean(1)
    weight = correlation**2
    return (squares / np.maximum(squares[1:].mean(0), 1e-300)) @ weight / np.maximum(weight.sum(0), 1e-300)


def _together(each: Array) -> tuple[float, float]:
    """The p-value of several tests together, of their p-values `(tests, 1 + M)`, and the level of each with which all
    keep that of a check: as many independent tests as the simulated sets' smallest p-values are like (Šidák)."""
    smallest = each.min(0)
    median = float(np.median(smallest[1:]).clip(1e-6, 0.5))
    effective = min(max(1.0, math.log(0.5) / math.log1p(-median)), len(each))
    together = -math.expm1(effective * math.log1p(-min(float(smallest[0]), 1 - 1e-12)))
    return together, -math.expm1(math.log1p(-CHECK_LEVEL) / effective)


def _nearly_normal(name: str, values: Array) -> Array:
    """Mean squares by their logarithms: where a fit leaves the noise open by a factor they are far from normal."""
    return np.log(np.maximum(values, 1e-12)) if name.startswith(SCATTER) else values


def attribute(scores: Scored, parameters: Scored, noise: dict[str, Array], maps: Array) -> Attribution:
    """Decide who is at fault by the two of `scored`, by mean squares and the like, and by the p-values of the
    hypothesis that the maps hold nothing, each of the real and every simulated set `(1 + M,)`."""
    scatter = np.stack([values / values[1:].mean() for name, values in noise.items() if name.startswith(SCATTER)])
    widest = scatter.max(0)[:, None]  # wrong noise scatters no score wider
    squares, _ = standardise(np.stack([_nearly_normal(*one) for one in noise.items()], -1))
    each = {
        "mean": scores.p_values(widest),
        "parameters": parameters.p_values(widest),
        "noise": tail_p_values(np.abs(squares).max(-1)),
        "maps": maps,
    }
    together, level = _together(np.stack([*each.values()]))
    p_values = {what: float(values[0]) for what, values in each.items()}
    dispersion = float(scores.dispersion[0].mean())
    widened = math.sqrt(min(max(1.0, dispersion), float(widest[0, 0])))
    by_kind = {kind: scores.explaining(kind, widened) for kind in FAULT_KINDS if kind in scores.kinds}
    explained = {kind: nats for kind, (_, nats) in by_kind.items()}
    best = max(explained, key=lambda kind: explained[kind])
    others = [nats for kind, nats in explained.items() if kind != best]
    _, of_own = parameters.explaining("parameter", widened)
    wrong = {what for what, p_value in p_values.items() if p_value <= level}
    if "parameters" in wrong and ("mean" not in wrong or of_own > explained[best]):
        kind = "parameters"
    elif "mean" in wrong:
        near = np.abs(scores.z[0]).max() <= MAX_INFORMATIVE_SD
        kind = best if near and explained[best] - max(others, default=0.0) >= MIN_GAIN_OF_KIND else "cannot tell"
    elif "noise" in wrong:
        kind = "noise"
    else:
        kind = "cannot tell" if "maps" in wrong else "nothing found"
    return Attribution(
        kind=kind,
        p_value=together,
        p_values=p_values,
        level=level,
        explained=explained,
        evidence=[(scores.kinds[j], scores.names[j], float(scores.z[0, j])) for j in by_kind[best][0]],
        parameters=dict(zip(parameters.names, parameters.z[0].tolist(), strict=True)),
        noise=dict(zip(noise, squares[0].tolist(), strict=True)),
        dispersion=dispersion,
    )
