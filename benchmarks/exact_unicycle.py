"""What is said of a unicycle that moves exactly as its program says, in continuous time.

    python benchmarks/exact_unicycle.py --case FOLDER [--seeds 3]

FOLDER holds train, valid and test drives, made in steps of 1 ms and logged at 10 Hz, and two programs: `unicycle.py` as
its user wrote it, with `-w / step` for wheels that do not slip, and `unicycle_fixed.py`, whose step is of second order.
Nothing is missing. `discover` searches once for each seed of its reference sets. Log p(y) of the test drives is looked
at afterwards and decides nothing. Writes `results/exact-unicycle.md` and exits with 1 when a must is missed.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from inference import likelihood
from steady_ppl import Program, discover, for_program, load_program, log_likelihood, read_table, seeded

RESULT = Path(__file__).parent / "results" / "exact-unicycle.md"
AS_WRITTEN, FIXED = "unicycle.py", "unicycle_fixed.py"
TOO_COARSE = "The model's own time step is too coarse"
MIN_LOG_LIKELIHOOD = 785.0  # nats a test drive, at the step that is taken
PARTICLES = 1000  # looking ahead, for log p(y) of the test drives


def on_test(program: Program, folder: Path, seed: int) -> float:
    """Log p(y) of a test drive by particles that look ahead, every row's measurements, in nats."""
    test = for_program(program, read_table(folder / "test.csv"))
    with seeded(seed, "test"):
        found = log_likelihood(program, test, particles=PARTICLES, known_start=False, every=1, look_ahead=True)
    return float(found.mean())


def row(name: str, folder: Path, seed: int) -> tuple[str, bool]:
    """One fit and search as a row of the table, and whether it meets its musts."""
    train, valid = (read_table(folder / f"{split}.csv") for split in ("train", "valid"))
    fitted = likelihood.fit(load_program(folder / name), train, valid, seed=seed)
    found = discover(fitted, train, valid, seed=seed)
    figures, before = found.figures, on_test(fitted.program, folder, seed)
    step, after = figures["step"], on_test(found.after.program, folder, seed)
    named = ", ".join(f"`{one['effect']}`" for one in figures["effects"]) or "nothing"
    first = figures["sentence"].startswith(TOO_COARSE)
    good = figures["verdict"] == "none" and after >= MIN_LOG_LIKELIHOOD and (first or name == FIXED)
    said = f"the step: +{step['gain']:.0f} nats" if first else "–"
    cells = (f"`{name}`", seed, said, step["substeps"], named, f"{figures['p_value']:.3f}")
    return f"| {' | '.join(map(str, cells))} | {before:.1f} | {after:.1f} |", good


def main() -> int:
    """Search with each seed, write the table and judge it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    lines = [
        "# A unicycle that moves exactly as its program says",
        "",
        "`python benchmarks/exact_unicycle.py --case FOLDER`. Drives are made in steps of 1 ms and logged at 10 Hz. "
        "Nothing is missing. A seed is that of the fit and of the search's reference sets. Log p(y) is of twelve test "
        f"drives, nats a drive, by {PARTICLES} particles that look ahead; at least {MIN_LOG_LIKELIHOOD:g} are asked "
        "for at the step that is taken.",
        "",
        "| program | seed | said first | substeps taken | named | p | log p(y), own step | at the step taken |",
        "|---|---|---|---|---|---|---|---|",
    ]
    missed = 0
    for name in (AS_WRITTEN, FIXED):
        for seed in range(arguments.seeds):
            text, good = row(name, arguments.case, seed)
            missed += not good
            lines.append(text)
            print(text, flush=True)
    RESULT.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
