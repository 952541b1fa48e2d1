"""What `discover` names first where the sensors' standard deviation is declared 2.5 times too wide, or too narrow.

    python benchmarks/declared_noise.py [--results FILE] [--workers 2]

Ten sets of drives from `continuous_worlds.py`, each with an effect of three times its detection limit, are searched
with both programs. Asked for: the planted effect first in each, the sensors' noise as a line of its own. Writes
`results/declared-noise.md` and exits with 1 when a must is missed.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
import zlib
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import pyro
import pyro.distributions as dist
import torch
from continuous_groups import GROUPS
from continuous_programs import CartProgram, PendulumProgram
from continuous_searches import ENGINE, LIMITS, discovered, said, sized
from resumable import Record, plain, run

from steady_ppl import Program, WrappedNormal, load_program

RESULT = Path(__file__).parent / "results" / "declared-noise.jsonl"
MODELS = Path(__file__).parents[1] / "models"
FACTORS = {"2.5 × too wide": 2.5, "2.5 × too narrow": 0.4}
MULTIPLE = 3.0  # of the detection limit
HOVERCRAFT = "hovercraft paper x1 known"
SETS = (
    *((HOVERCRAFT, name) for name in ("quadratic_drag", "yaw_linear_drag", "side_slip", "bearing_bias")),
    *(("boat", name) for name in ("yaw_linear_drag", "quadratic_drag")),
    *(("cart", name) for name in ("quadratic_drag", "coulomb_friction")),
    *(("pendulum", name) for name in ("cubic_stiffness", "acceleration_bias")),
)


def _hovercraft(factor: float) -> Program:
    program = load_program(MODELS / "hovercraft.py")
    program.bearing_sd *= factor
    return program


def _boat(factor: float) -> Program:
    class Misdeclared(type(load_program(MODELS / "gps_boat.py:GpsBoat"))):  # type: ignore[misc]
        def observe(self, state: torch.Tensor) -> None:
            pyro.sample("gps", dist.Normal(state[..., :2], factor * 0.5).to_event(1))
            pyro.sample("compass", WrappedNormal(state[..., 2:3], factor * 0.05).to_event(1))

    return Misdeclared()


def _cart(factor: float) -> Program:
    class Misdeclared(CartProgram):
        def observe(self, state: torch.Tensor) -> None:
            pyro.sample("position", dist.Normal(state[..., :1], factor * 0.05).to_event(1))

    return Misdeclared()


def _pendulum(factor: float) -> Program:
    class Misdeclared(PendulumProgram):
        def observe(self, state: torch.Tensor) -> None:
            pyro.sample("angle", WrappedNormal(state[..., :1], factor * math.radians(3)).to_event(1))

    return Misdeclared()


PROGRAMS = {"hovercraft": _hovercraft, "boat": _boat, "cart": _cart, "pendulum": _pendulum}


def judged(name: str, group: str, effect: str, factor: float) -> Record:
    """Return what `discover` says of a set, by the program whose sensors' noise is declared with a factor."""
    torch.set_num_threads(1)
    chosen = GROUPS[group]
    limits = json.loads(LIMITS.read_text())
    planted = sized(effect, limits[group][effect], MULTIPLE, name)
    began = time.perf_counter()
    misdeclared = replace(chosen, program=lambda: PROGRAMS[group.partition(" ")[0]](factor))
    found = discovered(misdeclared, zlib.crc32(name.encode()), 0, planted)
    record = {"planted": effect, "factor": factor, "seconds": round(time.perf_counter() - began, 1)}
    return plain(record | said(found))


def table(records: list[Record]) -> tuple[list[str], bool]:
    """Return the table of these records in Markdown, and whether every set has its effect first."""
    lines = ["| set | declared | first | its size | class | noise, a line of its own | s |", f"|{'---|' * 7}"]
    good = True
    for one in records:
        effects = [found for found in one["found"] if not found.get("correction")]
        noise = [
            f"{found['effect']} {found['coefficient'][0]:.2f}" for found in one["found"] if found.get("correction")
        ]
        first = effects[0] if effects else {"effect": "nothing", "coefficient": [], "class": []}
        good = good and first["effect"] == one["planted"]
        size = ", ".join(f"{number:.3g}" for number in first["coefficient"])
        where, _, declared = one["set"].rpartition(", ")
        cells = (where, declared, f"`{first['effect']}`", size, ", ".join(first["class"]))
        lines.append(f"| {' | '.join(cells)} | {', '.join(noise) or '–'} | {one['seconds']:.0f} |")
    return lines, good


def main() -> int:
    """Search what is left, write the table and judge it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=RESULT)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    jobs = {
        f"{group} {effect}, {declared}": (f"{group} {effect}", group, effect, factor)
        for group, effect in SETS
        for declared, factor in FACTORS.items()
    }
    records = run(judged, jobs, arguments.results, version=ENGINE, workers=arguments.workers)
    lines, good = table(sorted(records, key=lambda one: list(jobs).index(one["set"])))
    text = ["# Sensors whose standard deviation is declared 2.5 times too wide, or too narrow", "", *lines]
    arguments.results.with_suffix(".md").write_text("\n".join(text) + "\n", encoding="utf-8")
    print("\n".join(text))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
