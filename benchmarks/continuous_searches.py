"""Searches of a group's drives by `discover`: records, detection limits on clean drives, and sizes by these limits."""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from continuous_drives import simulate
from continuous_effects import Planted
from continuous_groups import GROUPS, MODELS, WIND_DRAG, Group, both_have, user_program
from resumable import Record, digest, plain

import steady_ppl
from steady_ppl import Program, discover
from steady_ppl.discovery.result import Discovery
from steady_ppl.effects import chosen_variant

FOLDER = Path(__file__).parent
LIMITS = FOLDER / "results" / "continuous-limits.json"
TRAIN, VALID = 16, 16
SOURCES = [
    FOLDER / "continuous_drives.py",
    FOLDER / "continuous_effects.py",
    FOLDER / "continuous_worlds.py",
    FOLDER / "continuous_wheels.py",
    FOLDER / "continuous_programs.py",
    MODELS / "car.py",
    MODELS / "hovercraft.py",
    MODELS / "gps_boat.py",
]
ENGINE = digest(Path(steady_ppl.__file__).parent, files=SOURCES)


def judged(name: str, group: str, index: int, planted: Planted | None = None) -> Record:
    """Return the record of a job: what `discover` says of 16 + 16 drives.

    Args:
        name: of the job, which seeds the drives.
        group: the group's name.
        index: seed of `discover`.
        planted: the effect that the program lacks.
    """
    torch.set_num_threads(1)
    chosen, seed = GROUPS[group], zlib.crc32(name.encode())
    began = time.perf_counter()
    found = discovered(chosen, seed, index, planted)
    record: Record = {"group": group, "index": index, "seed": seed, "seconds": round(time.perf_counter() - began, 1)}
    if planted is not None:
        options = dict(planted.options)
        limits = {one["effect"]: one["detection_limit"] for one in found.figures["candidates"]}
        record |= {"planted": {"effect": planted.name, "value": list(planted.value), "options": options}}
        record |= {"limit": limits.get(planted.name)}  # on these very drives, where its size was given
    return plain(record | said(found))


def discovered(group: Group, seed: int, index: int, planted: Planted | None = None) -> Discovery:
    """Run `discover` on the drives of a seed."""
    effects = () if planted is None else (planted, *both_have(planted.name))
    drives = simulate(replace(group.world, effects=effects), TRAIN + VALID, seed=seed)
    train, valid = drives.subset(range(TRAIN)), drives.subset(range(TRAIN, TRAIN + VALID))
    program = user_program(group, "" if planted is None else planted.name)
    return discover(program, train, valid, known_start=group.known_start, seed=index)


def said(found: Discovery) -> Record:
    """Return what is kept of a discovery."""
    figures = found.figures
    keys = ("effect", "kind", "class", "confidence", "coefficient", "sd", "interval_90", "options", "correction")
    effects = [{key: one[key] for key in keys} for one in figures["effects"]]
    first = effects[0] if effects else {}
    return {
        "verdict": figures["verdict"],
        "effect": figures["effect"],
        "class": figures["class"],
        "p_value": figures["p_value"],
        "coefficient": first.get("coefficient"),
        "sd": first.get("sd"),
        "interval_90": first.get("interval_90"),
        "found": effects,
        "substeps": getattr(found.after.program, "substeps", 1),
        "sentence": figures["sentence"],
        "converged": found.search.base.converged,
        "notes": list(found.notes),
        "doubts": list(found.doubts),
    }


def limits_of(group: str, effect: str = "") -> Record:
    """Return the detection limits of a group's effects by `discover` on clean drives.

    Args:
        group: the group's name.
        effect: "wind" for that alone, whose program and world have a drag.
    """
    torch.set_num_threads(1)
    chosen, name = GROUPS[group], f"limits {group} {effect}"
    known = replace(chosen, world=replace(chosen.world, effects=both_have(effect)))
    program, seed = user_program(chosen, effect), zlib.crc32(name.encode())
    drives = simulate(known.world, TRAIN + VALID, seed=seed)
    train, valid = drives.subset(range(TRAIN)), drives.subset(range(TRAIN, TRAIN + VALID))
    figures = discover(program, train, valid, known_start=chosen.known_start, seed=0).figures
    wanted = [effect] if effect else [one for one in chosen.effects if one != "wind"]
    return {
        one["effect"]: _limit(program, one)
        for one in figures["candidates"]
        if one["effect"] in wanted and one["detection_limit"] is not None
    }


def _limit(program: Program, candidate: Mapping[str, Any]) -> Record:
    """Return one effect's limit, `(k,)`, its options, sign and physical bound."""
    effect, options = chosen_variant(program, candidate["effect"]).effect, dict(candidate["options"])
    limit = np.atleast_1d(candidate["detection_limit"]).astype(float)
    if candidate["effect"] == "wind":  # its push grows with wind times drag, as long as it is slower than the vehicle
        limit, options = limit * options["drag"] / WIND_DRAG, {"drag": WIND_DRAG}
    return plain(
        {
            "limit": limit.tolist(),
            "unit": candidate["unit"],
            "options": options,
            "sign": effect.sign,
            "most": float(effect.limit),
        }
    )


def sized(effect: str, limit: Mapping[str, Any], multiple: float, name: str) -> Planted:
    """Return an effect at a multiple of its detection limit, below its physical bound.

    The sign is random where physics leaves it free; a vector has a random direction. `name`, the job's, seeds both.
    """
    random = np.random.default_rng(zlib.crc32(name.encode()))
    least = np.array(limit["limit"])
    if len(least) == 1:
        direction = np.array([limit["sign"] or random.choice([-1.0, 1.0])])
    else:
        angle = random.uniform(0, 2 * math.pi)
        direction = np.array([math.cos(angle), math.sin(angle)])
    size = multiple / float(np.linalg.norm(direction / least))
    value = min(size, float(limit["most"])) * direction
    return Planted(effect, tuple(float(f"{one:.4g}") for one in value), dict(limit["options"]))
