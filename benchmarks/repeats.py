"""Whether today's source makes filed records again, to the last bit: eleven of the calibration, four of the development
benchmark.

    python benchmarks/repeats.py [--store] [--workers 2]

`--store` files them in `results/repeats.jsonl`, after a change of an algorithm. Every figure is compared but the
seconds that it took. Exits with 1 where one differs, and names it: on another kind of processor, or with other versions
of torch or numba, that is to be expected; after a move or a change of names it is a fault.
"""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any

import calibrate
import discovery
from discovery_sets import benchmark_sets
from resumable import Record, digest, stored

FILE = Path(__file__).parent / "results" / "repeats.jsonl"
DISCOVERED = 4  # sets of the development benchmark, the first
CALIBRATION = (
    "states cart bootstrap 200 1200",
    "states hovercraft lookahead 100 1200",
    "states pendulum gaussian 1200",
    "nuts network gaussian",
    "nuts hovercraft svi smoother",
    "evidence pendulum lookahead 100 1000",
    "parameters 1",
    "discovery clean 0",
    "discovery single 1",
    "check one long drive 3",
    "check twelve drives 2",
)


def made_again(name: str) -> Record:
    """The record of a set by the present source, as a file has it."""
    if name in CALIBRATION:
        record = calibrate.work(*calibrate.jobs(calibrate.FULL)[name])
    else:
        record = discovery.judged(next(chosen for chosen in benchmark_sets() if chosen.name == name))
    return json.loads(json.dumps(record))


def difference(before: Any, after: Any, place: str = "") -> str:
    """Where two records differ first; empty where they are the same."""
    if isinstance(before, dict) and isinstance(after, dict) and before.keys() == after.keys():
        pairs = [(before[key], after[key], f"{place}.{key}") for key in before if key != "seconds"]
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        pairs = [(one, other, f"{place}[{i}]") for i, (one, other) in enumerate(zip(before, after, strict=True))]
    else:
        return "" if before == after else f"{place.lstrip('.')} is {after}, {before} is filed"
    return next((found for pair in pairs if (found := difference(*pair))), "")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", action="store_true", help="file the records in place of comparing them")
    parser.add_argument("--workers", type=int, default=2)
    told = parser.parse_args()
    names = [*CALIBRATION, *(chosen.name for chosen in islice(benchmark_sets(), DISCOVERED))]
    version, filed = digest(Path(__file__).parent.parent / "steady_ppl"), {} if told.store else stored(FILE)
    lines, differ = [], 0
    with ProcessPoolExecutor(told.workers) as pool:
        for name, after in zip(names, pool.map(made_again, names), strict=True):
            lines.append(json.dumps({"set": name, "version": version, **after}))
            before = {key: value for key, value in filed.get(name, {}).items() if key not in ("set", "version")}
            found = "filed" if told.store else difference(before, after)
            differ += bool(found) and not told.store
            print(f"{name}: {found or 'the same'}", flush=True)
    if told.store:
        FILE.write_text("\n".join(lines) + "\n")
    else:
        print(f"{len(names) - differ} of {len(names)} records are the same to the last bit")
    return int(differ > 0)


if __name__ == "__main__":
    sys.exit(main())
