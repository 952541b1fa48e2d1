"""How often `check` reports a fault on drives that the fit has not seen, of right models and of others.

    python benchmarks/unseen.py [--sets 50] [--only BEGINNING ...] [--results FILE] [--workers 2]

A job makes drives in the continuous worlds of `continuous_worlds.py`, fits the program that a user would write to some
of them by a recipe, and checks it on others. Asked for: a fault of a right model in 5 % of the sets, an effect of
twice its detection limit in 90 %, with the kind right in 85 %. Writes `results/unseen.md` and exits with 1 when a must
is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from continuous_drives import simulate
from continuous_effects import Planted
from continuous_groups import GROUPS, user_program
from continuous_searches import LIMITS, SOURCES, sized
from resumable import Record, digest, plain, run
from scipy import stats

import steady_ppl
from steady_ppl import check, with_substeps
from steady_ppl.criticism.attribution import FAULT_KINDS
from steady_ppl.effects import find
from steady_ppl.runs.recipes import find_recipe

FOLDER = Path(__file__).parent
RESULT = FOLDER / "results" / "unseen.jsonl"
RECIPES = FOLDER.parent / "inference"
ENGINE = digest(Path(steady_ppl.__file__).parent, RECIPES, files=[*SOURCES, *sorted(RECIPES.glob("*.py"))])
HOVERCRAFT = "hovercraft paper x1 known"
VEHICLES = {HOVERCRAFT: 4, "boat": 4, "cart": 2, "pendulum": 8}  # and the substeps at which their programs are right
MULTIPLE = 2.0  # of the detection limit
LEVEL, MIN_POWER, MIN_RIGHT = 0.05, 0.9, 0.85


@dataclass(frozen=True)
class Setting:
    """What is fitted and checked on which drives."""

    name: str
    recipe: str
    train: int  # drives
    others: int  # drives that are checked; 0: those of the fit
    sets: float = 1.0  # share of the sets
    planted: bool = False


SETTINGS = (
    Setting("likelihood, 16, others", "likelihood", 16, 32),
    Setting("steady, 16, others", "steady", 16, 32),
    Setting("likelihood, 6, others", "likelihood", 6, 12, 0.5),
    Setting("likelihood, 8, its own", "likelihood", 8, 0, 0.5),
    Setting("likelihood, 4, its own", "likelihood", 4, 0, 0.5),
    Setting("likelihood, 1, its own", "likelihood", 1, 0, 0.5),
    Setting("likelihood, 16, others, an effect", "likelihood", 16, 32, planted=True),
)


def judged(name: str, vehicle: str, setting: Setting, index: int) -> Record:
    """The record of a job, whose name seeds its drives."""
    torch.set_num_threads(1)
    group, planted = GROUPS[vehicle], None
    if setting.planted:
        effects = [one for one in group.effects if one in json.loads(LIMITS.read_text())[vehicle] and one != "wind"]
        effect = effects[index % len(effects)]
        planted = sized(effect, json.loads(LIMITS.read_text())[vehicle][effect], MULTIPLE, name)
    drives = _drives(vehicle, planted, setting, zlib.crc32(name.encode()))
    train = drives.subset(range(setting.train))
    others = drives.subset(range(setting.train, setting.train + setting.others)) if setting.others else train
    program = with_substeps(user_program(group), VEHICLES[vehicle])
    began = time.perf_counter()
    fit = find_recipe(setting.recipe)(program, train, known_start=group.known_start, seed=index)
    fitted = time.perf_counter()
    found = check(fit, others, seed=index)
    said = found.figures
    record: Record = {
        "vehicle": vehicle,
        "setting": setting.name,
        "seconds": [fitted - began, time.perf_counter() - fitted],
    }
    record |= {"who": said["who"], "p_value": said["p_value"], "p_values": said["evidence"]["p_values"]}
    record |= {"step": bool(found.step.sentence), "gain": said["gain_of_longer_fit"], "verdict": said["verdict"]}
    if planted is not None:
        record |= {"planted": planted.name, "kind": find(planted.name, program).verdict}
    return plain(record)


def _drives(vehicle: str, planted: Planted | None, setting: Setting, seed: int) -> steady_ppl.Trajectories:
    world = replace(GROUPS[vehicle].world, effects=() if planted is None else (planted,))
    return simulate(world, setting.train + setting.others, seed=seed)


def jobs_of(sets: int, only: list[str] | None) -> dict[str, tuple[str, str, Setting, int]]:
    """Arguments of `judged` by name."""
    found = {}
    for index in range(sets):
        for setting in SETTINGS:
            for vehicle in VEHICLES:
                name = f"{setting.name}: {vehicle} {index}"
                if index < setting.sets * sets and (only is None or any(name.startswith(one) for one in only)):
                    found[name] = (name, vehicle, setting, index)
    return found


def interval(count: int, total: int) -> tuple[float, float]:
    """The exact 95 % interval of a share (Clopper and Pearson)."""
    found = stats.binomtest(count, total).proportion_ci()
    return float(found.low), float(found.high)


def table(records: list[Record]) -> tuple[list[str], bool]:
    """The table of these records in Markdown, and whether nothing that must hold is missed."""
    head = "| fitted and checked | vehicle | sets | faults reported | 95 % interval | p-values uniform | kind right |"
    lines, good = [head, f"|{'---|' * 7}"], True
    for setting in SETTINGS:
        of_setting = [one for one in records if one["setting"] == setting.name and "failed" not in one]
        for vehicle in (*VEHICLES, None):
            chosen = [one for one in of_setting if vehicle in (None, one["vehicle"])]
            if not chosen:
                continue
            reported = [one for one in chosen if one["who"] != "nothing found"]
            low, high = interval(len(reported), len(chosen))
            right = [one for one in reported if one["who"] == one.get("kind") or one.get("kind") not in FAULT_KINDS]
            beside = "two-sided" if setting.others else "greater"  # on its own drives a fit has scores of zero
            uniform = stats.kstest([one["p_value"] for one in chosen], "uniform", alternative=beside)
            if setting.planted:
                met = len(reported) >= MIN_POWER * len(chosen) and len(right) >= MIN_RIGHT * len(reported)
            elif setting.others:
                met = low <= LEVEL <= high
            else:
                met = len(reported) <= (LEVEL + 2 * (LEVEL * (1 - LEVEL) / len(chosen)) ** 0.5) * len(chosen)
            good = good and (met or vehicle is not None)
            cells = [setting.name, vehicle or "all", str(len(chosen)), f"{len(reported) / len(chosen):.1%}"]
            cells += [f"{low:.1%} to {high:.1%}", "" if setting.planted else f"p = {uniform.pvalue:.2f}"]
            cells += [f"{len(right) / max(1, len(reported)):.0%}" if setting.planted else ""]
            lines.append(f"| {' | '.join(cells)} |")
    return lines, good


def main() -> int:
    """Fit and check what is left, write the table and judge it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=50)
    parser.add_argument("--only", nargs="+")
    parser.add_argument("--results", type=Path, default=RESULT)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    jobs = jobs_of(arguments.sets, arguments.only)
    records = run(
        judged, jobs, arguments.results, version=ENGINE, workers=arguments.workers, said=lambda one: one["verdict"][:90]
    )
    lines, good = table(records)
    text = ["# Checks on drives that the fit has not seen", "", *lines]
    arguments.results.with_suffix(".md").write_text("\n".join(text) + "\n", encoding="utf-8")
    print("\n".join(text))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
