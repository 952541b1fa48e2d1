"""Who is at fault: sensor, actuator, dynamics or noise, or that these drives cannot tell.

The covariance of the scores, estimated from simulated drives, is the information matrix: an effect of size β in
direction j moves the expected scores by its column j times β. So what one direction explains can be taken out of all
others, and the kind of direction that leaves least is the one to blame, if the next kind is clearly worse.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from steady_ppl.criticism.perturbations import Direction
from steady_ppl.criticism.residual_maps import ALPHA, standardise, tail_p_value

Array = np.ndarray[Any, Any]
KINDS = ("sensor", "actuator", "dynamics")
TEST_COUNT = 4  # of the mean, the parameters, the scatter and the maps; each at a fourth of the level
MIN_GAIN_OF_KIND = 3.0  # nats of log p(y) between the best kind and the next
SCATTER = "scatter of "  # begins the names of mean squares
STEPS = 4
MAX_INFORMATIVE_SD = 100.0  # so far off the scores say nothing of what would be nearest to the drives
MAX_SCORE_SD = 5.0  # standard deviations of one drive's score, more where most drives' are large
MIN_GAIN_OF_DIRECTION = 2.0  # nats that another direction of the same kind must bring


@dataclass(frozen=True)
class Attribution:
    """What the scores say."""

    kind: str  # "sensor", "actuator", "dynamics", "parameters", "noise", "cannot tell" or "nothing found"
    p_value: float  # of the hypothesis that the program is right, all tests together (Bonferroni)
    mean_p_value: float  # of the hypothesis that no direction is wrong, the program's own parameters let free
    noise_p_value: float  # of the hypothesis that the scatter is right
    parameters_p_value: float  # of the hypothesis that the program's parameters suit these drives
    explained: dict[str, float]  # nats that the best directions of each kind explain
    evidence: list[tuple[str, str, float]]  # the directions picked, best first: (kind, name, z)
    parameters: dict[str, float]  # z of each parameter's score
    noise: dict[str, float]  # z of each mean square
    dispersion: float  # how much more than simulated drives the drives differ in their scores

    @property
    def parameters_misfit(self) -> bool:
        """Whether the program's parameters do not suit these drives, whatever else is wrong."""
        return self.parameters_p_value <= ALPHA / TEST_COUNT

    @property
    def closest_parameters(self) -> list[tuple[str, float]]:
        """The parameter that explains most alone, and those that explain nearly as much, with their z."""
        order = sorted(self.parameters.items(), key=lambda item: -abs(item[1]))
        least = order[0][1] ** 2 - 2 * MIN_GAIN_OF_KIND * max(1.0, self.dispersion) if order else 0.0
        return [(name, z) for name, z in order if z**2 >= least]


@dataclass(frozen=True)
class Scored:
    """Scores made comparable: of the `J` directions that the `P` parameters do not explain, and of the parameters."""

    kinds: list[str]
    names: list[str]
    z: Array  # (1 + M, J), the real set first
    correlation: Array  # (J, J)
    dispersion: Array  # (1 + M, J): how much more than simulated drives the drives of a set differ
    parameters: Array  # (1 + M, P), their z
    parameters_dispersion: Array  # (1 + M, P)
    parameters_correlation: Array  # (P, P)
    parameter_names: list[str]


def scored(real: Sequence[Direction], simulated: Sequence[Direction], sets: int) -> Scored:
    """Take the parameters' scores out of all others, of `B` real and `sets` · `B` simulated drives, and standardise."""
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
        others = _Fitted((covariance * (sets - 1) - values.T @ away) / (sets - 2), own)
        parts.append(others.split(away, free))
    parameters, rest = (np.stack(part) for part in zip(*parts, strict=True))
    sd = fit.spread(free)
    left = fit.left[np.ix_(free, free)] / np.outer(sd, sd)
    return Scored(
        kinds=[real[j].kind for j in np.flatnonzero(free)],
        names=[real[j].name for j in np.flatnonzero(free)],
        z=rest.sum(1),
        correlation=left,
        dispersion=_dispersion(rest, left),
        parameters=parameters.sum(1),
        parameters_dispersion=_dispersion(each / fit.scale, fit.correlation)[:, own],
        parameters_correlation=fit.correlation[np.ix_(own, own)],
        parameter_names=[real[j].name for j in np.flatnonzero(own)],
    )


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
    apart = ((each - size * variance) / np.sqrt(variance)).clip(-MAX_SCORE_SD, MAX_SCORE_SD)
    squares = (apart**2).mean(1)
    weight = correlation**2
    return (squares / np.maximum(squares[1:].mean(0), 1e-300)) @ weight / np.maximum(weight.sum(0), 1e-300)


def attribute(scores: Scored, noise: dict[str, Array], maps_p_value: float) -> Attribution:
    """Decide who is at fault.

    Args:
        noise: name of a mean square or the like → its value in the real and every simulated set, `(1 + M,)`.
        maps_p_value: of the hypothesis that the maps hold nothing.
    """
    scatter = np.stack([values / values[1:].mean() for name, values in noise.items() if name.startswith(SCATTER)])
    widest = scatter.max(0)[:, None]  # wrong noise scatters no score wider
    z = scores.z / np.sqrt(np.minimum(scores.dispersion, widest).clip(1.0))
    mean_p = tail_p_value(np.abs(z).max(-1))
    squares, _ = standardise(np.stack(list(noise.values()), -1))
    noise_p = tail_p_value(np.abs(squares).max(-1))
    own = scores.parameters / np.sqrt(np.minimum(scores.parameters_dispersion, widest).clip(1.0))
    own_p = tail_p_value(np.abs(own).max(-1)) if scores.parameter_names else 1.0
    widened = math.sqrt(min(max(1.0, float(scores.dispersion[0].mean())), float(widest[0, 0])))
    by_kind = {
        kind: _explaining(scores.z[0] / widened, scores.correlation, [own == kind for own in scores.kinds])
        for kind in KINDS
        if kind in scores.kinds
    }
    explained = {kind: sum(nats) for kind, (_, nats) in by_kind.items()}
    best = max(explained, key=lambda kind: explained[kind])
    others = [nats for kind, nats in explained.items() if kind != best]
    every = [True] * len(scores.parameter_names)
    of_own = sum(_explaining(scores.parameters[0] / widened, scores.parameters_correlation, every)[1])
    each = ALPHA / TEST_COUNT
    if own_p <= each and (mean_p > each or of_own > explained[best]):
        kind = "parameters"
    elif mean_p <= each:
        near = np.abs(scores.z[0]).max() <= MAX_INFORMATIVE_SD
        kind = best if near and explained[best] - max(others, default=0.0) >= MIN_GAIN_OF_KIND else "cannot tell"
    elif noise_p <= each:
        kind = "noise"
    else:
        kind = "cannot tell" if maps_p_value <= each else "nothing found"
    return Attribution(
        kind=kind,
        p_value=min(1.0, TEST_COUNT * min(mean_p, own_p, noise_p, maps_p_value)),
        mean_p_value=mean_p,
        noise_p_value=noise_p,
        parameters_p_value=own_p,
        explained=explained,
        evidence=[(scores.kinds[j], scores.names[j], float(scores.z[0, j])) for j in by_kind[best][0]],
        parameters=dict(zip(scores.parameter_names, scores.parameters[0].tolist(), strict=True)),
        noise=dict(zip(noise, squares[0].tolist(), strict=True)),
        dispersion=float(scores.dispersion[0].mean()),
    )


def _explaining(z: Array, correlation: Array, members: Sequence[bool]) -> tuple[list[int], list[float]]:
    """Some directions, picked one after the other, and the nats that each explains, less its price."""
    picked: list[int] = []
    nats: list[float] = []
    for step in range(min(STEPS, len(z))):
        spread = correlation.diagonal()
        free = np.array(members) & (spread > 0.02)
        left = np.where(free, z**2 / np.maximum(spread, 0.02), 0.0)
        j = int(left.argmax())
        gain = 0.5 * float(left[j]) - (MIN_GAIN_OF_DIRECTION if step else 0.0)
        if gain <= 0:
            break
        picked.append(j)
        nats.append(gain)
        column = correlation[:, j] / max(float(spread[j]), 1e-12)
        z = z - column * z[j]
        correlation = correlation - np.outer(column, correlation[j])
    return picked, nats
