"""The data sets of the discovery benchmark: drives of a hovercraft with one effect, two or none that its owner lacks.

Every set is made from its name and its seed alone. Sizes go by the limits in `discovery_limits.json`, see
`discovery_limits.py`: the coefficients that a training table shows with 95 % power at the family-wise level.
"""

from __future__ import annotations

import itertools
import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from discovery_limits import KNOWN, TRAIN, Planting, alike, best_alias, owner, plantings, with_effects

from steady_ppl import Trajectories, simulate
from steady_ppl.effects import Effect, find, parsed

__all__ = ["BenchmarkSet", "benchmark_sets", "multiple_of_limit", "owner", "quick", "tables"]

EFFECTS = (
    *("linear_drag", "quadratic_drag", "coulomb_friction", "yaw_linear_drag", "yaw_quadratic_drag", "slope", "wind"),
    *("thrust_asymmetry", "yaw_bias", "thrust_saturation", "dead_zone", "actuator_lag", "actuator_delay"),
    *("battery_sag", "lateral_coupling", "weathervane", "magnus", "lever_arm", "sticky_patch", "bearing_bias"),
    *("landmark_bias", "sensor_scale", "clock_offset", "heavy_tails", "range_dependent_noise", "process_noise"),
)  # all but coloured noise: its limits on these drives are 42 and 13, and it is at most 1
CAPS = {"dead_zone": 0.21, "battery_sag": 0.8, "heavy_tails": 0.45, "actuator_lag": 1.0}
ALONE = ("wind", "process_noise")  # neither in pairs nor withheld: the one needs a drag, the other a declared noise
SINGLE, LARGE, CLEAN, PAIRS, WITHHELD = 10, 4, 200, 30, 60
VALID, TEST = 16, 32
DISTINCT, UNMISTAKABLE = 0.8, 0.7  # correlations of a pair's effects, and of a withheld effect with its best alias
SEEN = 3.0  # of several places or knees those at which the limit is at most so many times the smallest


@dataclass(frozen=True)
class BenchmarkSet:
    """Tables and what is hidden in them.

    Attributes:
        name: unlike any other's.
        stratum: clean, single, large, pair or withheld.
        effects: that the owner's program lacks, as on the command line.
        seed: of the drives.
        withheld: names of effects that are left out of the catalogue.
        known: effects that the drives have and the owner's program as well.
    """

    name: str
    stratum: str
    effects: tuple[str, ...]
    seed: int
    withheld: tuple[str, ...] = ()
    known: tuple[str, ...] = ()

    @property
    def planted(self) -> tuple[str, ...]:
        """The effects by name and place, as a variant is called."""
        return tuple(":".join(part for part in parsed(text)[:2] if part) for text in self.effects)


def tables(chosen: BenchmarkSet) -> tuple[Trajectories, Trajectories, Trajectories]:
    """Train, validation and locked test drives of 101 rows, with their true states."""
    truth = with_effects(owner(chosen.known), chosen.effects)
    train, valid, test = (
        simulate(truth, size, seed=10 * chosen.seed + part) for part, size in enumerate((TRAIN, VALID, TEST), 1)
    )
    return train, valid, test


def benchmark_sets() -> list[BenchmarkSet]:
    """All sets, the strata mixed, so that a part of them has some of each."""
    every = [*_clean(), *_single(), *_large(), *_pairs(), *_withheld()]
    return sorted(every, key=lambda one: zlib.crc32(one.name.encode()))


def quick() -> list[BenchmarkSet]:
    """A set in twenty, of every stratum and kind."""
    every = benchmark_sets()
    wanted = ("quadratic_drag", "slope", "dead_zone", "actuator_lag", "lever_arm", "landmark_bias", "sensor_scale")
    named = {f"single-{effect}-{SINGLE // 2}" for effect in (*wanted, "heavy_tails")}
    few = [one for one in every if one.stratum == "clean"][:6]
    few += [one for one in every if one.name in named]
    few += [one for one in every if one.stratum == "large"][:: 3 * LARGE]
    for stratum, count in (("pair", 3), ("withheld", 4)):
        few += [one for one in every if one.stratum == stratum][:: (PAIRS if stratum == "pair" else WITHHELD) // count]
    return few


def _clean() -> list[BenchmarkSet]:
    return [BenchmarkSet(f"clean-{index}", "clean", (), 10_000 + index) for index in range(CLEAN)]


def _single() -> Iterator[BenchmarkSet]:
    """Each effect at one to six limits, evenly spread over the logarithm."""
    for number, effect in enumerate(EFFECTS):
        for index in range(SINGLE if _can_be_planted(effect, 1) else 0):
            name = f"single-{effect}-{index}"
            random = _random(name)
            share = (index + random.uniform()) / SINGLE
            text = _sized(_choice(effect, 1, random), (1, 6), share, random)
            yield BenchmarkSet(name, "single", (text,), 20_000 + 100 * number + index, known=KNOWN.get(effect, ()))


def _large() -> Iterator[BenchmarkSet]:
    """Each effect at the size at which it is clearly felt, where this is more than six limits."""
    for number, effect in enumerate(EFFECTS):
        large = [planting for planting in _places(effect) if _limits_of(_felt(planting.effect), planting) > 6]
        for index in range(LARGE if large else 0):
            name = f"large-{effect}-{index}"
            random = _random(name)
            planting = large[random.integers(len(large))]
            size = float(np.linalg.norm(_felt(effect)))
            text = _text(planting, size * _direction(planting, random))
            yield BenchmarkSet(name, "large", (text,), 30_000 + 100 * number + index, known=KNOWN.get(effect, ()))


def _pairs() -> Iterator[BenchmarkSet]:
    """Two effects of three to six limits that these drives can tell apart."""
    random = _random("pairs")
    able = [effect for effect in EFFECTS if effect not in ALONE and _can_be_planted(effect, 3)]
    every = list(itertools.combinations(able, 2))
    found = 0
    for index in random.permutation(len(every)):
        both = [_choice(effect, 3, random) for effect in every[index]]
        if alike(both[0].name, both[1].name) >= DISTINCT:
            continue
        texts = tuple(_sized(planting, (3, 6), random.uniform(), random) for planting in both)
        yield BenchmarkSet(f"pair-{found}-{'-'.join(every[index])}", "pair", texts, 40_000 + found)
        found += 1
        if found == PAIRS:
            return


def _withheld() -> Iterator[BenchmarkSet]:
    """Effects of two to six limits that the catalogue lacks: half of them like no other, half of them like one."""
    able = [effect for effect in EFFECTS if effect not in ALONE and _can_be_planted(effect, 2)]
    able = [effect for effect in able if _effect(effect).verdict != "noise"]  # no curve could stand for it
    for part, like_one in enumerate((False, True)):
        group = [e for e in able if (max(best_alias(p.name) for p in _places(e)) >= UNMISTAKABLE) == like_one]
        for index in range(WITHHELD // 2):
            effect = group[index % len(group)]
            name = f"withheld-{'alias' if like_one else 'none'}-{index}-{effect}"
            random = _random(name)
            text = _sized(_choice(effect, 2, random), (2, 6), random.uniform(), random)
            yield BenchmarkSet(name, "withheld", (text,), 50_000 + 100 * part + index, withheld=(effect,))


def _random(name: str) -> np.random.Generator:
    return np.random.default_rng(zlib.crc32(name.encode()))


def _places(effect: str) -> list[Planting]:
    """Where an effect can be seen about as well as anywhere."""
    every = plantings(effect)
    least = min((np.linalg.norm(planting.limit) for planting in every), default=0.0)
    return [planting for planting in every if np.linalg.norm(planting.limit) <= SEEN * least]


def _most(planting: Planting) -> float:
    """How many limits a vehicle can physically show, along the component that is seen worst."""
    return CAPS.get(planting.effect, _effect(planting.effect).limit) / max(planting.limit)


def _can_be_planted(effect: str, limits: float) -> bool:
    return any(_most(planting) >= limits for planting in _places(effect))


def _choice(effect: str, limits: float, random: np.random.Generator) -> Planting:
    able = [planting for planting in _places(effect) if _most(planting) >= limits]
    return able[random.integers(len(able))]


def _sized(planting: Planting, between: Sequence[float], share: float, random: np.random.Generator) -> str:
    """The effect at a size whose logarithm lies a share of the way between two numbers of limits, below its cap."""
    direction = _direction(planting, random)
    low, high = between[0], min(between[1], _most(planting))
    return _text(planting, low * (high / low) ** share / _limits_of(direction, planting) * direction)


def _direction(planting: Planting, random: np.random.Generator) -> np.ndarray:
    """A unit vector, `(k,)`; of one component a sign, physics permitting."""
    effect = _effect(planting.effect)
    if effect.components:
        angle = random.uniform(0, 2 * math.pi)
        return np.array([math.cos(angle), math.sin(angle)])
    sign = 1.0 if effect.sign else random.choice([-1.0, 1.0])
    return np.array([sign])


def text_of_size(effect: str, limits: float) -> str:
    """An effect at a size in detection limits, or the largest that is physical."""
    random = _random(f"{effect} of {limits}")
    planting = min(_places(effect), key=lambda one: float(np.linalg.norm(one.limit)))
    return _sized(planting, (min(limits, _most(planting)),) * 2, 0.0, random)


def multiple_of_limit(text: str) -> float:
    """How many limits an effect is large, as it was planted."""
    name, at, _, values = parsed(text)
    written = text.rpartition("=")[0]
    (planting,) = [one for one in plantings(name) if one.written == written] or [
        next(one for one in plantings(name) if one.name == ":".join(part for part in (name, at) if part))
    ]
    return _limits_of(np.array(values) - _effect(name).null, planting)


def _limits_of(change: np.ndarray, planting: Planting) -> float:
    """How many limits a change of the coefficient is, `(k,)` from where the effect is absent."""
    return float(np.linalg.norm(change / np.array(planting.limit)))


def _felt(effect: str) -> np.ndarray:
    """The size at which an effect is clearly felt, `(k,)` from where it is absent."""
    return np.atleast_1d(_effect(effect).typical) - _effect(effect).null


def _text(planting: Planting, change: np.ndarray) -> str:
    values = _effect(planting.effect).null + change
    return f"{planting.written}={','.join(f'{value:.4g}' for value in values)}"


@cache
def _effect(name: str) -> Effect:
    return find(name, owner())
