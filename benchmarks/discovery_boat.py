"""Several large effects at once, unknown starts, GPS and compass: what `discover` names on a newcomer's boat.

    python benchmarks/discovery_boat.py [--sets 16] [--results FILE] [--workers 2]

Each set is `models/gps_boat.py` with a yaw drag, a side slip and a quadratic drag, every size drawn anew between a
third and one and a half of what `GpsBoatTruth` has. The owner's program, which has none, is fitted by the recipe
`likelihood`; eight drives of twenty seconds to fit, eight to choose by, ten to judge. The table is printed and written
beside the results (`.md`).
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from pathlib import Path
from typing import Any

import torch
from resumable import Record, digest, run

import steady_ppl as st
from steady_ppl.effects import chosen_variant
from steady_ppl.runs.recipes import find_recipe

FOLDER = Path(__file__).parent
BOAT = FOLDER.parent / "models" / "gps_boat.py"
TYPICAL = {"yaw_linear_drag": 0.6, "side_slip": 1.0, "quadratic_drag": 0.15}
SPREAD = (1 / 3, 1.5)


def one(seed: int) -> Record:
    """A set's record."""
    torch.set_num_threads(1)
    program, sizes = st.load_program(BOAT), {}
    truth = st.load_program(BOAT)
    with st.seeded(seed, "sizes"):
        low, high = (math.log(end) for end in SPREAD)
        sizes = {name: size * math.exp(low + (high - low) * float(torch.rand(()))) for name, size in TYPICAL.items()}
    for name, size in sizes.items():
        truth = truth.with_effect(chosen_variant(truth, name), size)
    train, valid, test = (
        st.simulate(truth, count, seed=3 * seed + k).without_truth() for k, count in enumerate((8, 8, 10))
    )
    began = time.perf_counter()
    before = find_recipe("likelihood")(program, train, valid, seed=seed)
    fitted = time.perf_counter() - began
    found = st.discover(before, train, valid, seed=seed)
    proof = st.prove({"before": before, "after": found.after, "truth": truth}, test, with_constant_velocity=False)
    rows = {row["row"]: row for row in proof.figures["rows"]}
    return {
        "sizes": sizes,
        "seconds": {"fit": fitted, "discover": time.perf_counter() - began - fitted},
        "verdict": found.figures["sentence"],
        "found": {
            finding.variant.name: {"coefficient": finding.coefficient, "sd": finding.sd, "interval": finding.interval}
            for finding in found.findings
        },
        "complete": found.search.is_complete,
        "converged": not found.doubts,
        "log_likelihood": {name: row["log_likelihood"] for name, row in rows.items()},
    }


def table(records: list[Record]) -> str:
    """What was named, how large, and what it brings."""
    broken = [record for record in records if "failed" in record]
    records = [record for record in records if "failed" not in record]
    lines = [
        f"{len(records)} sets, {len(broken)} failed; log p(y) of test drives, nats above the owner's program.",
        "",
        "| set | planted: yaw drag, side slip, quadratic drag | named | all | false | gain | of the truth's | s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    gains, shares = [], []
    for record in sorted(records, key=lambda record: int(record["set"].split()[1])):
        levels, named = record["log_likelihood"], record["found"]
        gain, possible = levels["after"] - levels["before"], levels["truth"] - levels["before"]
        gains.append(gain)
        shares.append(gain / possible)
        said = ", ".join(f"{name} {one['coefficient'][0]:.2g} ± {one['sd'][0]:.1g}" for name, one in named.items())
        planted = ", ".join(f"{size:.2g}" for size in record["sizes"].values())
        right = sum(name in named for name in record["sizes"])
        false = len(named.keys() - record["sizes"].keys())
        seconds = record["seconds"]["discover"]
        counted = f"{right} of 3 | {false} | {gain:.1f} | {shares[-1]:.1%} | {seconds:.0f}"
        lines.append(f"| {record['set']} | {planted} | {said} | {counted} |")
    lines += [
        "",
        f"Gain {statistics.mean(gains):.1f} ± {statistics.stdev(gains):.1f} nats a drive, "
        f"{statistics.mean(shares):.1%} ± {statistics.stdev(shares):.1%} of what the true program gains.",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=16)
    parser.add_argument("--results", type=Path, default=FOLDER / "results" / "discovery_boat.jsonl")
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    jobs: dict[str, Any] = {f"boat {seed}": (seed,) for seed in range(1, chosen.sets + 1)}
    version = digest(Path(st.__file__).parent, files=[BOAT])
    records = run(one, jobs, chosen.results, version=version, workers=chosen.workers)
    text = table(records)
    chosen.results.with_suffix(".md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
