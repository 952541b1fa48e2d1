"""What `discover` reports on vehicles that move in continuous time: false alarms, and effects that are planted.

    python benchmarks/continuous.py alarms  [--sets 25] [--only GROUP ...] [--workers 2]
    python benchmarks/continuous.py limits  [--only GROUP ...] [--workers 2]
    python benchmarks/continuous.py planted [--sets 2] [--only GROUP ...] [--effect NAME[=NUMBER[,NUMBER]] ...]
                                            [--times 2 3]
    python benchmarks/continuous.py tables
    python benchmarks/continuous.py groups

A job is 16 training and 16 validation drives of a world in `continuous_worlds.py` or `continuous_wheels.py`, and one
call of `discover` on the program that a user would write. Each job is one line of the results file; a job with a line
is not run again.
`planted` takes its sizes from `results/continuous-limits.json`, which `limits` makes with `discover` on clean drives.
`--only` takes the beginning of groups' names. `tables` writes `continuous.md` beside the results; with a file of
planted sets of one's own (`--planted`) a table of these is written beside it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from continuous_effects import Planted
from continuous_groups import GROUPS, WIND_DRAG, Group, chosen_groups
from continuous_searches import ENGINE, LIMITS, judged, limits_of, sized
from continuous_tables import tables
from resumable import Record, run, stored

RESULTS = Path(__file__).parent / "results"
ALARMS, PLANTED = RESULTS / "continuous-alarms.jsonl", RESULTS / "continuous-planted.jsonl"
TABLES = "continuous.md"
MULTIPLES = (2.0, 3.0)


def alarm_jobs(groups: Sequence[Group], sets: int) -> dict[str, tuple[Any, ...]]:
    """Return arguments of `judged` by name for clean sets."""
    names = [(f"{group.name} {index}", group.name, index) for group in groups for index in range(1, sets + 1)]
    return {name: (name, group, index) for name, group, index in names}


def planted_jobs(
    groups: Sequence[Group],
    sets: int,
    limits: Mapping[str, Mapping[str, Any]],
    given: Mapping[str, Any],
    multiples: Sequence[float] = MULTIPLES,
) -> dict[str, tuple[Any, ...]]:
    """Return arguments of `judged` by name for sets with an effect.

    Args:
        groups: whose effects are planted.
        sets: for each effect and size.
        limits: by group and effect.
        given: effects to plant, all when empty; each with its size, or None for multiples of its limit.
        multiples: of the limit, that are planted.
    """
    jobs: dict[str, tuple[Any, ...]] = {}
    for group in groups:
        for effect in (one for one in group.effects if not given or one in given):
            known = limits.get(group.name, {}).get(effect)
            for index in range(1, sets + 1):
                for written, planted in _sizes(group, effect, index, known, given.get(effect), multiples):
                    jobs[written] = (written, group.name, index, planted)
    return jobs


def _sizes(
    group: Group,
    effect: str,
    index: int,
    limit: Mapping[str, Any] | None,
    value: tuple[float, ...] | None,
    multiples: Sequence[float],
) -> list[tuple[str, Planted]]:
    """Return the names and effects of one index's jobs."""
    if value is not None:
        options = {"drag": WIND_DRAG} if effect == "wind" else {}
        name = f"{group.name} {effect} ={','.join(f'{one:g}' for one in value)} {index}"
        return [(name, Planted(effect, value, options))]
    if limit is None:
        return []
    names = {f"{group.name} {effect} x{multiple:g} {index}": multiple for multiple in multiples}
    return [(name, sized(effect, limit, multiple, name)) for name, multiple in names.items()]


def measure_limits(groups: Sequence[Group], workers: int) -> None:
    """Write the detection limits of these groups, beside those that the file has."""
    jobs = [(group.name, effect) for group in groups if group.effects for effect in _runs(group)]
    found = json.loads(LIMITS.read_text()) if LIMITS.exists() else {}
    with ProcessPoolExecutor(workers) as pool:
        for (name, _), limits in zip(jobs, pool.map(limits_of, *zip(*jobs, strict=True)), strict=True):
            found.setdefault(name, {}).update(limits)
            LIMITS.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
            print(f"{name}: {', '.join(limits)}")
    for group in groups:
        missing = [effect for effect in group.effects if effect not in found.get(group.name, {})]
        if missing:
            print(f"{group.name}: no limit of {', '.join(missing)}")


def _runs(group: Group) -> list[str]:
    return ["", "wind"] if "wind" in group.effects else [""]


def _given(texts: Sequence[str] | None) -> dict[str, tuple[float, ...] | None]:
    """Return effects of the command line with their sizes, None where none is given."""
    parts = [text.partition("=") for text in texts or ()]
    return {name: tuple(float(one) for one in value.split(",")) if value else None for name, _, value in parts}


def _line(record: Record) -> str:
    return f"{record['verdict']} {record['effect'] or ''} p={record['p_value']:.3g} {record['seconds']:.0f} s"


def _write_tables(alarms: Path, planted: Path) -> None:
    own = planted != PLANTED and alarms == ALARMS  # planted sets that were run apart
    text = tables([] if own else [*stored(alarms).values()], [*stored(planted).values()])
    file = planted.with_suffix(".md") if own else alarms.with_name(TABLES)
    file.write_text(text, encoding="utf-8")
    print(text)


def main() -> None:
    """Run what is left of the jobs, or print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", choices=("alarms", "planted", "limits", "tables", "groups"))
    parser.add_argument("--sets", type=int, help="a group; of planted ones for each effect and size (25, 2)")
    parser.add_argument("--only", nargs="+", metavar="GROUP", help="beginnings of groups' names")
    parser.add_argument("--effect", nargs="+", metavar="NAME[=NUMBER]", help="plant only these, at these sizes")
    parser.add_argument("--times", nargs="+", type=float, default=MULTIPLES, help="plant at these multiples of limits")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--alarms", type=Path, default=ALARMS, help="results file of clean sets")
    parser.add_argument("--planted", type=Path, default=PLANTED, help="results file of sets with an effect")
    options = parser.parse_args()
    groups = chosen_groups(options.only)
    if options.work == "groups":
        print("\n".join(GROUPS))
    elif options.work == "limits":
        measure_limits(groups, options.workers)
    elif options.work == "alarms":
        jobs = alarm_jobs(groups, options.sets or 25)
        run(judged, jobs, options.alarms, version=ENGINE, workers=options.workers, said=_line)
    elif options.work == "planted":
        limits = json.loads(LIMITS.read_text()) if LIMITS.exists() else {}
        jobs = planted_jobs(groups, options.sets or 2, limits, _given(options.effect), options.times)
        if not jobs:
            raise SystemExit("nothing to plant: run `limits` first, or name an effect with its size (--effect)")
        run(judged, jobs, options.planted, version=ENGINE, workers=options.workers, said=_line)
    if options.work in ("alarms", "planted", "tables"):
        _write_tables(options.alarms, options.planted)


if __name__ == "__main__":
    main()
