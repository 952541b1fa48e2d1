"""Whether today's source makes filed records again, to the last bit: some of the calibration and of the development
benchmark, the two whose files are by one source.

    python benchmarks/repeats.py [--workers 2]

Every figure of a record is compared but the seconds that it took. Exits with 1 where one differs, and names it: on
another kind of processor, with other versions of torch or numba, and after a change of an algorithm that is to be
expected; after a move or a change of names it is a fault.
"""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import calibrate
import discovery
from discovery_sets import benchmark_sets
from resumable import Record, stored

RESULTS = Path(__file__).parent / "results"
DISCOVERED = 4  # sets of the development benchmark, the first that are filed
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


def made_again(of: str, name: str) -> Record:
    """The record of a set by the present source, as a file has it."""
    if of == "calibration":
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
    parser.add_argument("--workers", type=int, default=2)
    workers = parser.parse_args().workers
    filed = {name: stored(RESULTS / f"{name}.jsonl") for name in ("calibration", "discovery-continuous")}
    chosen = [("calibration", name) for name in CALIBRATION]
    chosen += [("discovery-continuous", name) for name in list(filed["discovery-continuous"])[:DISCOVERED]]
    differ = 0
    with ProcessPoolExecutor(workers) as pool:
        for (of, name), after in zip(chosen, pool.map(made_again, *zip(*chosen, strict=True)), strict=True):
            before = {key: value for key, value in filed[of][name].items() if key not in ("set", "version")}
            found = difference(before, after)
            differ += bool(found)
            print(f"{of}: {name}: {found or 'the same'}", flush=True)
    print(f"{len(chosen) - differ} of {len(chosen)} records are the same to the last bit")
    return bool(differ)


if __name__ == "__main__":
    sys.exit(main())
