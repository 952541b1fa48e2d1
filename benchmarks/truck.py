"""The real truck: what its hand-written program lacks, found from bearings alone.

    python benchmarks/truck.py --data FOLDER [--only path table planted] [--draws 5] [--out FOLDER]

Three parts. The path: `discover` on the hand-written program with the train and valid drives, what it finds is added
and the program fitted again, until nothing with a name is left; after every step errors on the test drives, which
decide nothing. The table: six programs on the test drives. Planted: faults put into the recorded commands and
bearings, to be found by the discovered truck as it was calibrated before. Each over several draws of the bearings, one
record each in OUT/truck.jsonl; resumable. Exits with 1 when a figure misses its must.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from experiments import LOGS, ROOT
from resumable import Record, digest, run
from truck_path import path
from truck_planted import FAULTS, is_right, planted
from truck_programs import PROGRAMS, judged

PARTS = ("table", "planted", "path")
SOURCE = [ROOT / room for room in ("steady_ppl", "models", "inference")]
FILES = (
    "truck.py",
    "truck_path.py",
    "truck_planted.py",
    "truck_programs.py",
    "experiments.py",
    "response_surface.py",
)
EULER = "discovered, Euler"  # the program of commit e31e1a9, judged once more: see docs/truck.md
# group, figure, must and aim, for the programs that have one
MUSTS = {
    ("discovered", "forward_mean", "location"): (0.1127, 0.105),
    ("discovered", "forward", "location"): (0.1574, 0.150),
    ("discovered", "forward", "angle"): (0.092, 0.072),
    ("hybrid", "forward", "location"): (0.205, 0.160),
    ("hybrid", "forward", "angle"): (0.075, 0.068),
    ("discovered", "state_estimation", "location"): (0.266, 0.225),
    ("hybrid", "state_estimation", "location"): (0.266, 0.225),
}
GAINS = {  # of log p(y) at 1 Hz over another program on the same draw, nats a drive
    ("discovered", "hand"): (20.0, None),
    ("hybrid", "hand"): (20.0, None),
    ("discovered", "network"): (0.5, None),
    ("hybrid", "network"): (1.0, 2.0),
    ("discovered", EULER): (0.0, 1.0),
}


def jobs(logs: Path, parts: list[str], draws: range) -> dict[str, tuple[Any, ...]]:
    """Arguments of `work` by the name of the record."""
    found: dict[str, tuple[Any, ...]] = {}
    for draw in draws:
        if "table" in parts:
            found |= {f"{name} {draw}": ("table", logs, name, draw) for name in PROGRAMS}
        if "path" in parts:
            found[f"path {draw}"] = ("path", logs, draw)
        if "planted" in parts:
            for fault in FAULTS:
                for share in (1.0, 0.5) if fault != "none" else (1.0,):
                    found[f"{fault} x {share} {draw}"] = ("planted", logs, fault, share, draw)
    return found


def work(part: str, *arguments: Any) -> Record:
    """One record."""
    return {"part": part} | {"table": judged, "planted": planted, "path": path}[part](*arguments)


def said(record: Record) -> str:
    """A record in a line."""
    if record["part"] == "table":
        return f"{_errors(record)}, {record['seconds']:.0f} s"
    if record["part"] == "planted":
        return f"{'right' if is_right(record) else 'WRONG'}: {record['sentence']} {record['seconds']:.0f} s"
    return " -> ".join(", ".join(effect["effect"] for effect in step["added"]) or "…" for step in record["steps"])


def _errors(record: Record) -> str:
    return (
        f"noisy {_pair(record, 'forward')}, mean {_pair(record, 'forward_mean')}, "
        f"states {_pair(record, 'state_estimation')}, log p(y) {record['log_likelihood']:.2f}"
    )


def _pair(record: Record, group: str) -> str:
    return " / ".join(f"{record[group][name]:.4f}" for name in ("location", "angle"))


def table_of(records: list[Record]) -> tuple[list[str], bool]:
    """A line a program, then a line a must; and whether all are met."""
    lines, good = [], True
    values: dict[str, list[Record]] = {
        name: sorted((r for r in records if r.get("program") == name and "failed" not in r), key=lambda r: r["draw"])
        for name in (*PROGRAMS, EULER)
    }
    for name, runs in values.items():
        if runs:
            cells = [f"{_mean_sd(runs, g, 'location')} / {_mean_sd(runs, g, 'angle')}" for g in GROUPS]
            lines.append(f"{name:17s} {'   '.join(cells)}   {_mean_sd(runs, 'log_likelihood')}")
            if "network" in runs[0]:
                lines.append(
                    f"{'':17s} its network {_left(runs, 'network')} of {_left(runs, 'whole')} (rms by channel)"
                )
    for (name, group, what), (must, aim) in MUSTS.items():
        if values[name]:
            got = statistics.fmean(run[group][what] for run in values[name])
            good &= got <= must
            lines.append(f"{name} {group} {what}: {got:.4f}, must {must} {_met(got <= must)}, aim {aim}")
    for (name, other), (must, aim) in GAINS.items():
        pairs = [(a, b) for a in values[name] for b in values[other] if a["draw"] == b["draw"]]
        if pairs:
            gains = [a["log_likelihood"] - b["log_likelihood"] for a, b in pairs]
            got = statistics.fmean(gains)
            good &= got >= must
            spread = f" ± {statistics.stdev(gains):.2f}" if len(gains) > 1 else ""
            lines.append(
                f"{name} log p(y) over {other}: {got:+.2f}{spread}, must {must} {_met(got >= must)}, aim {aim}"
            )
    return lines, good


GROUPS = ("forward", "forward_mean", "state_estimation")


def _mean_sd(runs: list[Record], *where: str) -> str:
    values = []
    for one in runs:
        value: Any = one
        for key in where:
            value = value[key]
        values.append(value)
    spread = f" ± {statistics.stdev(values):.4f}" if len(values) > 1 else ""
    return f"{statistics.fmean(values):.4f}{spread}"


def _left(runs: list[Record], what: str) -> str:
    """Root mean squares of accelerations by channel, the mean of the runs."""
    return " / ".join(
        f"{statistics.fmean(values):.2f}" for values in zip(*(r["network"][what] for r in runs), strict=True)
    )


def _met(good: bool) -> str:
    return "met" if good else "MISSED"


def planted_of(records: list[Record]) -> tuple[list[str], bool]:
    """A line a fault and size; whether every fault of full size was named first in every draw."""
    lines, good = [], True
    for fault in FAULTS:
        for share in (1.0, 0.5):
            runs = [r for r in records if r.get("fault") == fault and r.get("share") == share]
            if runs:
                right = sum(map(is_right, runs))
                lines.append(f"{fault} x {share}: {right} of {len(runs)} ({'; '.join(map(_found, runs))})")
                good &= share < 1 or right == len(runs)
    return lines, good


def _found(record: Record) -> str:
    """What was found, in order, with its coefficients."""
    return ", ".join(f"{e['effect']} {' '.join(f'{c:.3g}' for c in e['coefficient'])}" for e in record["found"]) or "–"


def path_of(record: Record) -> list[str]:
    """The path of one draw, a line a step."""
    lines = [f"draw {record['draw']}"]
    for step in record["steps"]:
        errors = f": {_errors(step['test'])}" if "test" in step else ""
        if step["added"] or step is record["steps"][0]:
            lines.append(f"  {'+ ' + _found({'found': step['added']}) if step['added'] else 'fitted'}{errors}")
        else:
            lines.append(f"  {step['sentence']}")
    return lines


def main() -> int:
    """Run what is left of the parts, print and judge them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=LOGS, help="the AlphaTruck logs: train/, valid/ and test/")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--first-draw", type=int, default=1)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "truck")
    arguments = parser.parse_args()
    if arguments.draws < 1:
        print("--draws: at least one", file=sys.stderr)
        return 2
    if not arguments.data.is_dir():
        print("name the folder with the AlphaTruck logs: --data, or make truck DATA=FOLDER", file=sys.stderr)
        return 2
    draws = range(arguments.first_draw, arguments.first_draw + arguments.draws)
    version = digest(*SOURCE, files=[Path(__file__).with_name(name) for name in FILES])
    wanted = jobs(arguments.data, arguments.only, draws)
    records = run(work, wanted, arguments.out / "truck.jsonl", version=version, said=said)
    lines, good = table_of([r for r in records if r.get("part") == "table"])
    more, found = planted_of([r for r in records if r.get("part") == "planted"])
    print("\n".join(lines + more))
    for record in records:
        if record.get("part") == "path" and "failed" not in record:
            print("\n".join(path_of(record)))
    return 0 if good and found and not any("failed" in record for record in records) else 1


if __name__ == "__main__":
    sys.exit(main())
