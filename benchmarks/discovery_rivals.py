"""Other ways to the missing effect, on the tables of `discovery_sets.py` and with the same catalogue.

Every rival takes (tables, program, *, known_start, withheld, base) and returns a `Ranking` for each of its settings.
Those that differentiate do it over several windows: the benchmark takes the one that turns out best. They and the
smoothed residuals cannot see sensors and noise, whose effects are not in their rankings.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from rival_columns import candidates, evidence
from rival_poses import poses
from rival_regressions import LEVEL, Rows, by_f_ratios, one_by_one, rows_of, sparse, strong, weak
from torch import Tensor

from steady_ppl import Program, Trajectories, for_program
from steady_ppl.discovery.refits import Refit, first_refit, refit_with
from steady_ppl.effects import Variant
from steady_ppl.model.problem import Problem

Tables = Sequence[Trajectories]
WINDOWS = (15, 23, 31, 41, 71)  # rows
LAGS = 10  # rows
NEAR = 0.03  # of the typical coefficient, with which brute force begins


@dataclass(frozen=True)
class Ranking:
    """What a rival says.

    Attributes:
        effects: names of variants, best first; none where it only detects.
        detected: whether it says that anything is missing.
        seconds: on one core.
    """

    effects: tuple[str, ...]
    detected: bool
    seconds: float


def pysindy(tables: Tables, program: Program, *, withheld: Sequence[str] = (), **_: Any) -> dict[str, Ranking]:
    """Poses from bearings, accelerations by Savitzky and Golay, sparse regression by PySINDy's optimiser."""
    return _by_window("pysindy", strong, sparse, tables, program, withheld)


def weak_pysindy(tables: Tables, program: Program, *, withheld: Sequence[str] = (), **_: Any) -> dict[str, Ranking]:
    """The same in weak form (Messenger and Bortz 2021), which needs no acceleration.

    PySINDy's own weak library knows neither second-order equations nor one coefficient in three of them.
    """
    return _by_window("weak pysindy", weak, sparse, tables, program, withheld)


def stepwise(tables: Tables, program: Program, *, withheld: Sequence[str] = (), **_: Any) -> dict[str, Ranking]:
    """Stepwise regression by F ratios and predicted squared error (Klein and Morelli 2006, ch. 5)."""
    return _by_window("stepwise", strong, by_f_ratios, tables, program, withheld)


def _by_window(
    called: str,
    described: Callable[..., list[Rows]],
    chosen: Callable[[Rows, Rows], tuple[list[str], bool]],
    tables: Tables,
    program: Program,
    withheld: Sequence[str],
) -> dict[str, Ranking]:
    began = time.perf_counter()
    drives = [for_program(program, table.without_truth()) for table in tables[:2]]
    found = [poses(program, data) for data in drives]
    shared = time.perf_counter() - began
    rankings = {}
    for window in WINDOWS:
        began = time.perf_counter()
        effects, detected = chosen(*described(program, drives, found, window, withheld))
        rankings[f"{called}, {window} rows"] = Ranking(tuple(effects), detected, shared + time.perf_counter() - began)
    return rankings


def fitted(tables: Tables, program: Program, known_start: bool) -> Refit:
    """The owner's program fitted to the training drives, what several rivals begin with."""
    train, valid = (Problem.of_table(program, table, known_start) for table in tables[:2])
    return first_refit(train, valid.data, seed=0)


def smoothed_residuals(
    tables: Tables,
    program: Program,
    *,
    known_start: bool,
    withheld: Sequence[str] = (),
    base: Refit | None = None,
) -> dict[str, Ranking]:
    """Posterior means of the fitted program's noise, regressed on each effect's columns at the posterior states."""
    from steady_ppl.gaussian.smoother import smooth
    from steady_ppl.likelihood.scores import smoothed

    began = time.perf_counter()
    base = base or fitted(tables, program, known_start)
    data, path = base.folds[0].drives, base.folds[0].path
    at = smoothed(smooth(Problem(base.program, data, known_start), path), data)
    known = evidence(base.program, data, at.states, candidates(base.program, data, withheld))
    effects, detected = one_by_one(rows_of(known, at.channels.mean))
    return {"smoothed residuals": Ranking(tuple(effects), detected, time.perf_counter() - began)}


def innovations(
    tables: Tables, program: Program, *, known_start: bool, base: Refit | None = None, **_: Any
) -> dict[str, Ranking]:
    """Two tests of the fitted program's one-step predictions on the validation drives, which only detect.

    Normalised innovations squared (Bar-Shalom, Li and Kirubarajan 2001, 5.4) are χ² in number, two-sided; the whitened
    innovations' autocorrelations likewise (Ljung and Box 1978), summed over drives and components.
    """
    from scipy import stats

    began = time.perf_counter()
    base = base or fitted(tables, program, known_start)
    white, seen = _whitened(base, known_start)
    count = int(seen.sum())
    squares = stats.chi2.cdf(float(white.square().sum()), count)
    lengths = seen.sum(0).clamp(min=LAGS + 1)
    total, degrees = 0.0, 0
    for lag in range(1, LAGS + 1):
        correlation = (white[lag:] * white[:-lag]).sum(0) / white.square().sum(0).clamp(min=1e-9)
        total += float((lengths * (lengths + 2) / (lengths - lag) * correlation.square()).sum())
        degrees += int((seen.sum(0) > LAGS).sum())
    boxed = stats.chi2.sf(total, degrees)
    seconds = time.perf_counter() - began
    return {
        "nis": Ranking((), bool(2 * min(squares, 1 - squares) < LEVEL), seconds),
        "ljung-box": Ranking((), bool(boxed < LEVEL), seconds),
    }


def _whitened(base: Refit, known_start: bool) -> tuple[Tensor, Tensor]:
    """Independent standard normal innovations under the program, `(T, B, K)`, and where there are any."""
    from steady_ppl.gaussian.kalman import track
    from steady_ppl.gaussian.predict import predict

    data, path = base.folds[0].held_out, base.folds[0].held_out_path
    tracked = track(Problem(base.program, data, known_start), path)
    found = predict(base.program, data, tracked, [1])[1]
    linear = tracked.linearization
    spread = linear.state @ tracked.covariances[:-1] @ linear.state.mT + linear.noise @ linear.noise.mT
    seen = torch.where(found.observed[..., None], linear.measurement[1:], 0.0)
    own = torch.where(found.observed, 1 / linear.precision[1:], 1.0)
    root = torch.linalg.cholesky(seen @ spread @ seen.mT + torch.diag_embed(own))
    white = torch.linalg.solve_triangular(root, found.error[..., None], upper=False)[..., 0]
    return torch.where(found.observed, white, 0.0), found.observed


def brute_force(
    tables: Tables,
    program: Program,
    *,
    known_start: bool,
    withheld: Sequence[str] = (),
    base: Refit | None = None,
) -> dict[str, Ranking]:
    """Refit the program with every candidate, at every place, and rank by held-out log p(y): minutes a set.

    It detects where the best one's gain over drives is significant by a paired t test at Bonferroni's level.
    """
    from dataclasses import replace

    from scipy import stats

    began = time.perf_counter()
    base = base or fitted(tables, program, known_start)
    data = replace(base.folds[0].drives, states=base.folds[0].path.states)
    gains: dict[str, Tensor] = {}
    for variant in candidates(base.program, data, withheld):
        for value in _beginnings(variant):
            refit = refit_with(base, variant, value)
            gain = torch.full_like(base.held_out, -1e9) if isinstance(refit, str) else refit.held_out - base.held_out
            if variant.name not in gains or float(gain.sum()) > float(gains[variant.name].sum()):
                gains[variant.name] = gain
    order = sorted(gains, key=lambda name: -float(gains[name].sum()))
    test = stats.ttest_1samp(gains[order[0]].numpy(), 0.0, alternative="greater")
    detected = bool(test.pvalue < LEVEL / len(order))
    return {"brute force": Ranking(tuple(order), detected, time.perf_counter() - began)}


def _beginnings(variant: Variant) -> Sequence[Any]:
    """Coefficients near that without the effect, where the fit is; of one without end its finite probes."""
    effect, typical = variant.effect, torch.as_tensor(variant.effect.typical)
    if math.isinf(effect.null):
        return effect.probes
    return [(effect.null + NEAR * (typical - effect.null)).tolist()]


RIVALS = {
    "pysindy": pysindy,
    "weak pysindy": weak_pysindy,
    "stepwise": stepwise,
    "smoothed residuals": smoothed_residuals,
    "innovations": innovations,
    "brute force": brute_force,
}
