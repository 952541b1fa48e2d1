"""What the owner of the discovery benchmark believes, and how small an effect its drives can show.

    python benchmarks/discovery_limits.py        measures the limits again, two minutes

Detection limits are coefficients found with 95 % power at the family-wise level. They depend on the program and on how
it is driven, so they are measured once, on drives without any effect, and kept in `discovery_limits.json`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from steady_ppl import Program, for_program, load_program, simulate
from steady_ppl.discovery.candidates import Screening, screen_program
from steady_ppl.discovery.effect_scores import columns_of
from steady_ppl.discovery.refits import Refit, first_refit
from steady_ppl.discovery.screening import MIN_SHARE_OF_INFORMATION, Screened
from steady_ppl.effects import Sizes, Variant, attached, catalogue, chosen_variant, parsed
from steady_ppl.model.problem import Problem

Array = np.ndarray
MODEL = Path(__file__).resolve().parents[1] / "models" / "hovercraft.py"
FILE = Path(__file__).with_name("discovery_limits.json")
TRAIN = 16
REFERENCE, SETS, SEED = 64, 200, 9  # more drives than a training table has, to average over manoeuvres
NOISE = (0.08, 0.08, 0.05)  # forward and lateral m/s², yaw rad/s²
DRAG = 0.06  # 1/m, through which wind acts
KNOWN = {"wind": (f"quadratic_drag={DRAG}",)}  # what drives and program have besides when an effect is planted
RELATED = 0.3  # correlations below this are not kept


@dataclass(frozen=True)
class Planting:
    """An effect at a place, and what a training table shows of it.

    Attributes:
        name: the effect and, after a colon, where.
        written: the same with knee or place, as on the command line.
        unit: of the coefficient.
        limit: the detection limit, `(k,)`, counted from where the effect is absent.
    """

    name: str
    written: str
    unit: str
    limit: tuple[float, ...]

    @property
    def effect(self) -> str:
        """The effect's name."""
        return self.name.partition(":")[0]


def owner(known: Sequence[str] = ()) -> Program:
    """The owner's program: the hovercraft without drag, its declared noise the true one, everything learnable.

    Args:
        known: effects that it has, as on the command line. Wind is planted on a program with the quadratic drag through
            which it acts, because the catalogue's wind is what it adds to that drag: -k (v-w)|v-w| + k v|v|.
    """
    program = load_program(MODEL)
    program.noise = torch.tensor(NOISE)
    program.guesses = ()  # type: ignore[misc]
    return with_effects(program, known)


def with_effects(program: Program, effects: Sequence[str]) -> Program:
    """A program with effects as on the command line."""
    for text in effects:
        name, at, options, value = parsed(text)
        program = program.with_effect(chosen_variant(program, name, at, **options), value)
    return program


@cache
def plantings(effect: str) -> tuple[Planting, ...]:
    """All places, knees and the like at which an effect can be planted."""
    stored = [Planting(**{**entry, "limit": tuple(entry["limit"])}) for entry in _stored()["limits"]]
    return tuple(planting for planting in stored if planting.effect == effect)


def alike(one: str, other: str) -> float:
    """How much the scores of two candidates correlate, by their names; 0 for less than `RELATED`."""
    return 1.0 if one == other else _stored()["alike"].get(one, {}).get(other, 0.0)


def best_alias(name: str) -> float:
    """The largest correlation with a candidate of another effect."""
    effect = name.partition(":")[0]
    others = _stored()["alike"].get(name, {}).items()
    return max((found for other, found in others if other.partition(":")[0] != effect), default=0.0)


@cache
def _stored() -> dict[str, Any]:
    return json.loads(FILE.read_text())


def measure_limits() -> None:
    """Write `discovery_limits.json`, from drives of the owner's program itself."""
    tested = _screened(owner())
    limits = [planting for planting in _plantings(tested) if planting.effect != "wind"]
    windy = _plantings(_screened(owner(KNOWN["wind"])))
    limits += [planting for planting in windy if planting.written == f"wind:drag={DRAG}"]
    order = [effect.name for effect in catalogue(owner())]
    limits.sort(key=lambda planting: order.index(planting.effect))
    lines = ",\n".join(json.dumps(vars(planting), ensure_ascii=False) for planting in limits)
    pairs = ",\n".join(f'"{name}": {json.dumps(found)}' for name, found in _related(tested[1].tests).items())
    FILE.write_text(f'{{"limits": [\n{lines}\n],\n"alike": {{\n{pairs}\n}}}}\n', encoding="utf-8")


def _screened(program: Program) -> tuple[Refit, Screening]:
    """The program fitted to a reference set of its own drives, and every candidate's test there."""
    train, valid = (
        for_program(program, simulate(program, size, seed=seed)) for size, seed in ((REFERENCE, SEED), (4, SEED + 1))
    )
    base = first_refit(Problem(program, train, True), valid, seed=SEED)
    return base, screen_program(base, program, sets=SETS, seed=SEED)


def _plantings(screened: tuple[Refit, Screening]) -> list[Planting]:
    """Every place and knee with its limit, of several probes the smallest; a training table has fewer drives."""
    base, screening = screened
    fewer = math.sqrt(REFERENCE / TRAIN)
    seen = replace(base.folds[0].drives, states=base.folds[0].path.states)
    alive = [tested for tested in screening.tests.tested if not (tested.untestable or tested.is_curve)]
    reach = float(alive[0].detection_limit[0] / alive[0].sd[0])
    have = {variant.name for variant in attached(base.program)}
    found = {
        planting.written: planting
        for tested in alive
        if tested.departure
        for planting in [_planting(tested.variant, fewer * tested.detection_limit)]
    }
    sizes = Sizes(base.program, seen)
    every = [sizes.of(v) for effect in catalogue(base.program) for v in effect.variants(base.program, seen)]
    for column in columns_of([variant for variant in every if variant.name not in have]):
        information = screening.information.get(f"{column.variant.label} {column.probe}")
        sd = None if information is None else _deviation(information, len(screening.parameters))
        if sd is None:
            continue
        planting = _planting(column.variant, fewer * reach * sd)
        best = found.get(planting.written)
        if best is None or sum(planting.limit) < sum(best.limit):
            found[planting.written] = planting
    return list(found.values())


def _deviation(information: Tensor, fitted: int) -> Array | None:
    """A coefficient's standard deviations, the fitted parameters let free; None where these explain it."""
    own, across, whole = information[:fitted, :fitted], information[:fitted, fitted:], information[fitted:, fitted:]
    left = whole - across.T @ torch.linalg.solve(own, across)
    if bool((left.diagonal() <= MIN_SHARE_OF_INFORMATION * whole.diagonal()).any()):
        return None
    return left.inverse().diagonal().sqrt().numpy()


def _planting(variant: Variant, limit: Array) -> Planting:
    options = [f"{name}={value:.3g}" for name, value in variant.profiled.items()]
    rounded = tuple(float(f"{one:.3g}") for one in limit.tolist())
    return Planting(variant.name, ":".join([variant.name, *options]), variant.effect.unit, rounded)


def _related(screened: Screened) -> dict[str, dict[str, float]]:
    """Correlations of effects' scores by name, the largest first."""
    called = [None if tested.is_curve else tested.variant.name for tested in screened.tested]
    rows = {name: row for name, row in zip(called, screened.correlations.tolist(), strict=True) if name}
    related = {}
    for name in sorted(rows):
        others = sorted(zip(rows[name], called, strict=True), key=lambda pair: -pair[0])
        related[name] = {
            other: round(value, 3) for value, other in others if value > RELATED and other not in (None, name)
        }
    return related


if __name__ == "__main__":
    measure_limits()
