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
import math
import time
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from continuous_programs import CartProgram, PendulumProgram, TwoWheelProgram, UnicycleProgram
from continuous_wheels import Car, TwoWheels
from continuous_worlds import Boat, Cart, Hovercraft, Pendulum, Planted, Unicycle, World, simulate
from resumable import Record, digest, run, stored
from scipy import stats

import steady_ppl
from steady_ppl import Program, discover, load_program
from steady_ppl.discovery.result import Discovery
from steady_ppl.effects import chosen_variant

FOLDER = Path(__file__).parent
MODELS, RESULTS = FOLDER.parent / "models", FOLDER / "results"
ALARMS, PLANTED = RESULTS / "continuous-alarms.jsonl", RESULTS / "continuous-planted.jsonl"
LIMITS, TABLES = RESULTS / "continuous-limits.json", "continuous.md"
TRAIN, VALID = 16, 16
MULTIPLES = (2.0, 3.0)
WIND_DRAG = 0.06  # 1/m: wind acts through a drag that world and program both have
ROUGH = (0.2, 0.2, 0.1)
SOURCES = [
    FOLDER / "continuous_worlds.py",
    FOLDER / "continuous_wheels.py",
    FOLDER / "continuous_programs.py",
    MODELS / "car.py",
    MODELS / "hovercraft.py",
    MODELS / "gps_boat.py",
]
ENGINE = digest(Path(steady_ppl.__file__).parent, files=SOURCES)


@dataclass(frozen=True)
class Group:
    """Sets of one kind.

    Attributes:
        name: on the command line and in the records.
        world: without effects.
        program: makes the user's program.
        known_start: whether `discover` is given the first states.
        effects: that `planted` plants.
    """

    name: str
    world: World
    program: Callable[[], Program]
    known_start: bool = False
    effects: tuple[str, ...] = ()


def _hovercraft() -> Program:
    return load_program(MODELS / "hovercraft.py")


def _boat() -> Program:
    return load_program(MODELS / "gps_boat.py:GpsBoat")


def _car() -> Program:
    return load_program(MODELS / "car.py")


ON_HOVERCRAFT = (
    *("linear_drag", "quadratic_drag", "coulomb_friction", "yaw_linear_drag", "yaw_quadratic_drag", "yaw_bias"),
    *("side_slip", "magnus", "weathervane", "lateral_coupling", "slope", "wind"),
    *("thrust_asymmetry", "actuator_delay", "actuator_lag", "bearing_bias", "clock_offset"),
)
ON_BOAT = ("yaw_linear_drag", "quadratic_drag", "side_slip")
ON_HULL = ("cross_flow", "added_mass", "caster")
ON_CAR = ("steering_asymmetry", "backlash", "slope")
ON_TWO_WHEELS = ("wheel_radius_difference", "track_width", "gain_error:wheels")
ON_LINE = (
    *("quadratic_drag", "coulomb_friction", "stiffness", "cubic_stiffness", "acceleration_bias"),
    *("actuator_delay", "actuator_lag", "clock_offset"),
)
ON_WHEELS = (  # no crab angle: where wheels hold the speed it is a bias of the heading
    *("lever_arm", "slip_angle", "steering_offset", "understeer", "clock_offset"),
)
PAPER = Hovercraft()
SMOOTH = {thrust: Hovercraft(driven="smooth", thrust=float(thrust)) for thrust in (1, 2, 3)}


def _groups() -> dict[str, Group]:
    """Return all groups by name; those whose names begin with "rough" are run only where `--only` names them."""
    found = []
    for start in ("known", "unknown"):
        known = start == "known"
        planted = ON_HOVERCRAFT if known else ()
        found.append(Group(f"hovercraft paper x1 {start}", PAPER, _hovercraft, known, planted))
        for thrust, world in SMOOTH.items():
            effects = planted if thrust == 1 else ()
            found.append(Group(f"hovercraft smooth x{thrust} {start}", world, _hovercraft, known, effects))
    found += [
        Group("unicycle", Unicycle(), UnicycleProgram, effects=ON_WHEELS),
        Group("boat", Boat(), _boat, effects=ON_BOAT),
        Group("hull", Boat(), _boat, effects=ON_HULL),
        Group("car", Car(), _car, effects=ON_CAR),
        Group("two wheels", TwoWheels(), TwoWheelProgram, effects=ON_TWO_WHEELS),
        Group("pendulum", Pendulum(), PendulumProgram, effects=ON_LINE),
        Group("cart", Cart(), CartProgram, effects=ON_LINE),
    ]
    hovercraft = [one for one in found if isinstance(one.world, Hovercraft)]
    rough = [
        Group(f"rough {one.name}", replace(one.world, noise=ROUGH), one.program, one.known_start) for one in hovercraft
    ]
    return {one.name: one for one in [*found, *rough]}


GROUPS = _groups()


def chosen_groups(only: Sequence[str] | None) -> list[Group]:
    """Return the groups whose names begin with one of `only`; all but the rough ones when None.

    Raises:
        SystemExit: a name fits no group.
    """
    if not only:
        return [one for name, one in GROUPS.items() if not name.startswith("rough")]
    strange = [text for text in only if not any(name.startswith(text) for name in GROUPS)]
    if strange:
        raise SystemExit(f"no group begins with {', '.join(strange)}; there are {', '.join(GROUPS)}")
    return [one for name, one in GROUPS.items() if name.startswith(tuple(only))]


# --- a job ------------------------------------------------------------------------------------------------------------


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
    effects = () if planted is None else (planted, *_known(planted.name))
    drives = simulate(replace(group.world, effects=effects), TRAIN + VALID, seed=seed)
    train, valid = drives.subset(range(TRAIN)), drives.subset(range(TRAIN, TRAIN + VALID))
    program = user_program(group, "" if planted is None else planted.name)
    return discover(program, train, valid, known_start=group.known_start, seed=index)


def user_program(group: Group, effect: str = "") -> Program:
    """Return the program that a user would write; with the drag that the world has where wind is planted."""
    program = group.program()
    for known in _known(effect):
        program = program.with_effect(chosen_variant(program, known.name), known.size)
    return program


def _known(effect: str) -> tuple[Planted, ...]:
    """Return what world and program both have beside a planted effect."""
    return (Planted("quadratic_drag", (WIND_DRAG,)),) if effect == "wind" else ()


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


def plain(value: Any) -> Any:
    """Return a value ready for JSON: figures to five digits, None where there is none."""
    if isinstance(value, Mapping):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if isinstance(value, float):
        return float(f"{value:.5g}") if math.isfinite(value) else None
    return value


# --- detection limits and sizes ---------------------------------------------------------------------------------------


def limits_of(group: str, effect: str = "") -> Record:
    """Return the detection limits of a group's effects by `discover` on clean drives.

    Args:
        group: the group's name.
        effect: "wind" for that alone, whose program and world have a drag.
    """
    torch.set_num_threads(1)
    chosen, name = GROUPS[group], f"limits {group} {effect}"
    known = replace(chosen, world=replace(chosen.world, effects=_known(effect)))
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


# --- jobs -------------------------------------------------------------------------------------------------------------


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


# --- tables -----------------------------------------------------------------------------------------------------------


def exact_interval(count: int, total: int, level: float = 0.95) -> tuple[float, float]:
    """Return the exact interval of a share (Clopper and Pearson 1934)."""
    tail = (1 - level) / 2
    low = float(stats.beta.ppf(tail, count, total - count + 1)) if count else 0.0
    high = float(stats.beta.isf(tail, count + 1, total - count)) if count < total else 1.0
    return low, high


def share(true: Sequence[bool]) -> str:
    """Return a share with its exact 95 % interval, as text."""
    if not true:
        return "–"
    low, high = exact_interval(sum(true), len(true))
    return f"{sum(true)} of {len(true)}: {sum(true) / len(true):.1%} [{low:.1%}, {high:.1%}]"


def alarms_table(records: Sequence[Record]) -> list[str]:
    """Return the share of clean sets with a verdict other than "none", by group, in Markdown."""
    lines = ["| group | verdict not “none” | 5 % inside | named | substeps | p uniform (KS) | s a set |"]
    lines.append("|---|---|---|---|---|---|---|")
    by_group = {name: [one for one in records if one["group"] == name] for name in GROUPS}
    rows = [(name, own) for name, own in by_group.items() if own]
    whole = [one for one in records if not one["group"].startswith("rough")]
    hovercraft = [one for one in whole if one["group"].startswith("hovercraft")]
    together = [("hovercraft together", hovercraft), ("all", whole)]
    for name, own in [*rows, *(row for row in together if row[1])]:
        alarms = [one["verdict"] != "none" for one in own]
        low, high = exact_interval(sum(alarms), len(alarms))
        named = Counter(one["effect"] or one["verdict"] for one in own if one["verdict"] != "none")
        uniform = stats.kstest([one["p_value"] for one in own], "uniform").pvalue
        lines.append(
            f"| {name} | {share(alarms)} | {'yes' if low <= 0.05 <= high else 'no'} | {counted(named)} | "
            f"{counted(Counter(one['substeps'] for one in own))} | {uniform:.2g} | "
            f"{np.median([one['seconds'] for one in own]):.0f} |"
        )
    return lines


def counted(found: Counter[Any]) -> str:
    """Return what was counted as text, the most frequent first."""
    return ", ".join(f"{what} {count}" for what, count in found.most_common()) or "–"


def planted_table(records: Sequence[Record]) -> list[str]:
    """Return how often planted effects are found, by group and by effect, in Markdown."""
    lines = ["| planted | truth in the class | truth first | 90 % interval covers | alone | taken for | substeps |"]
    lines.append("|---|---|---|---|---|---|---|")
    effects = dict.fromkeys(one["planted"]["effect"] for one in records)
    rows = [("all", list(records))]
    rows += [(name, [one for one in records if one["group"] == name]) for name in GROUPS]
    rows += [(f"`{name}`", [one for one in records if one["planted"]["effect"] == name]) for name in effects]
    for name, own in rows:
        if own:
            wrong = Counter(one["effect"] or one["verdict"] for one in own if not in_class(one))
            shares = (share([true(one) for one in own]) for true in (in_class, is_first))
            lines.append(
                f"| {name} | {' | '.join(shares)} | {share([c for one in own for c in covers(one)])} | "
                f"{share([len(one['found']) == 1 for one in own if in_class(one)])} | {counted(wrong)} | "
                f"{counted(Counter(one['substeps'] for one in own))} |"
            )
    return lines


def in_class(record: Record) -> bool:
    """Return whether the planted effect is in the class of the first finding."""
    return record["planted"]["effect"] in record["class"]


def is_first(record: Record) -> bool:
    """Return whether the planted effect is what is named first."""
    return record["effect"] == record["planted"]["effect"]


def covers(record: Record) -> list[bool]:
    """Return whether the 90 % interval holds each number of the coefficient, where the effect is named."""
    values = record["planted"]["value"]
    intervals = [one["interval_90"] for one in record["found"] if one["effect"] == record["planted"]["effect"]]
    return [low <= value <= high for own in intervals for value, (low, high) in zip(values, own, strict=True)]


def tables(alarms: Sequence[Record], planted: Sequence[Record]) -> str:
    """Return both tables in Markdown."""
    lines = ["# `discover` in continuous time", ""]
    every = [*alarms, *planted]
    for title, table, records in (
        ("False alarms", alarms_table, alarms),
        ("Planted effects", planted_table, planted),
    ):
        whole = [one for one in records if "failed" not in one]
        if whole:
            lines += [f"## {title}", "", *table(whole), ""]
    versions = ", ".join(sorted({one["version"] for one in every})) or "–"
    lines += [
        "Worlds are integrated in steps of 1 ms; a set is 16 training and 16 validation drives. Intervals are exact at "
        "95 %. “Covers” counts the numbers of coefficients whose effect is named. “Alone”: of the sets with the truth "
        "in the class, those in which nothing else is named. A set's seed is the CRC-32 of its name, as recorded.",
        f"Digest of the source: {versions}.",
        *(f"Failed: {one['set']}: {one['failed']}" for one in every if "failed" in one),
    ]
    return "\n".join(lines) + "\n"


# --- command line -----------------------------------------------------------------------------------------------------


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
