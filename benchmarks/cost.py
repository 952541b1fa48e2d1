"""What an E step costs as drives are added and as they grow longer: in proportion, beyond a fixed overhead.

    python benchmarks/cost.py            up to 256 trajectories and 6400 rows; draws docs/cost.png: ten minutes
    python benchmarks/cost.py --quick    up to 16 trajectories and 400 rows, once each; judges nothing

One core, its processor time, which other processes hardly touch. Hov's truth simulates the drives, the network as it
begins filters and smooths them; 30 paths each. The least of several runs counts, after one that finds the paths and
compiles: the sizes take turns for a minute a guide. seconds = a + b·n is fitted, with equal relative weights, to
the four largest sizes; with few drives a filter also resamples at fewer rows. Exits with 1 when (seconds − a)/n at the
largest n differs from that at a quarter of it by more than 25 %.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import matplotlib.ticker
import numpy as np
import torch
from experiments import ROOT
from matplotlib.axes import Axes

from models.hovercraft import HovercraftTruth
from models.neural_vehicle import NeuralHovercraft
from steady_ppl import GaussianGuide, LookaheadGuide, PathGuide, SMCGuide, Trajectories, for_program, seeded, simulate

GUIDES = {
    "bootstrap, 1000 particles": lambda program: SMCGuide(program, particles=1000, draws=30, known_start=True),
    "lookahead, 100 particles": lambda program: LookaheadGuide(program, particles=100, draws=30, known_start=True),
    "Gaussian": lambda program: GaussianGuide(program, draws=30, known_start=True),
}
LOOKS = dict(zip(GUIDES, (("#d55e00", "s"), ("#0072b2", "o"), ("#009e73", "^")), strict=True))
TOLERANCE = 0.25


@dataclass(frozen=True)
class Growth:
    """Seconds of one guide's E step against a number n, and the line a + b·n through the largest four."""

    sizes: Sequence[int]
    seconds: Sequence[float]

    @property
    def fitted(self) -> tuple[np.ndarray, np.ndarray]:
        """The largest n and their seconds."""
        return np.array(self.sizes[-4:]), np.array(self.seconds[-4:])

    @property
    def line(self) -> tuple[float, float]:
        """a and b."""
        many, seconds = self.fitted
        slope, overhead = np.polyfit(many, seconds, 1, w=1 / seconds)
        return float(overhead), float(slope)

    @property
    def equation(self) -> str:
        """The line in words."""
        overhead, slope = self.line
        return f"{1e3 * overhead:.3g} ms + {1e3 * slope:.3g} ms · n"

    @property
    def r_squared(self) -> float:
        """The share of the variance of the seconds that the line explains."""
        (many, seconds), (overhead, slope) = self.fitted, self.line
        return float(1 - (seconds - overhead - slope * many).var() / seconds.var())

    @property
    def power(self) -> float:
        """Slope of log seconds, overhead taken off, against log n."""
        (many, seconds), (overhead, _) = self.fitted, self.line
        return float(np.polyfit(np.log(many), np.log(seconds - overhead), 1)[0])

    @property
    def ratio(self) -> float:
        """Cost of one of the largest n, overhead taken off, over that of one of a quarter of it."""
        (many, seconds), (overhead, _) = self.fitted, self.line
        each = (seconds - overhead) / many
        return float(each[-1] / each[list(many).index(many[-1] // 4)])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, help="where the picture goes (docs/cost.png; with --quick nowhere)")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    most_drives, most_rows, patience = (16, 400, 0.0) if arguments.quick else (256, 6400, 60.0)
    drives, rows = (doubled(1, most_drives), doubled(25, most_rows))
    panels = {
        "trajectories of 101 rows": measured(drives, [simulated(n, 101) for n in drives], patience),
        "rows of 4 trajectories": measured(rows, [simulated(4, n) for n in rows], patience),
    }
    missed = 0
    for of, growths in panels.items():
        missed |= report(of, growths, judge=not arguments.quick)
    out = arguments.out or (None if arguments.quick else ROOT / "docs" / "cost.png")
    if out:
        draw(panels, out)
    return missed


def doubled(first: int, last: int) -> list[int]:
    """first, 2 first, 4 first, … last."""
    return [first] if first >= last else [first, *doubled(2 * first, last)]


def simulated(trajectories: int, rows: int) -> Trajectories:
    truth = HovercraftTruth()
    truth.duration = (rows - 1) * truth.step
    return simulate(truth, trajectories, seed=1)


def measured(sizes: list[int], tables: list[Trajectories], patience: float) -> dict[str, Growth]:
    """Every guide on every table; the sizes take turns, so that a slow minute spoils none of them alone."""
    growths = {}
    for name in GUIDES:
        guides = [ready(name, table) for table in tables]
        least, began = [math.inf for _ in sizes], time.perf_counter()
        while math.inf in least or time.perf_counter() - began < patience:
            least = [min(before, e_step(*one)) for before, one in zip(least, guides, strict=True)]
        growths[name] = Growth(sizes, least)
    return growths


def ready(name: str, table: Trajectories) -> tuple[PathGuide, Trajectories]:
    """A guide that has found its paths, and its drives."""
    with seeded("cost"):
        program = NeuralHovercraft()
        data, guide = for_program(program, table), GUIDES[name](program)
        guide.refresh(data, 1.0)
    return guide, data


def e_step(guide: PathGuide, data: Trajectories) -> float:
    """Processor seconds of one E step at full observation weight."""
    with seeded("cost"):
        began = time.process_time()
        guide.refresh(data, 1.0)
        return time.process_time() - began


def report(of: str, growths: dict[str, Growth], judge: bool) -> int:
    """Print one panel as a table; 1 if the cost of some guide is not linear."""
    sizes = next(iter(growths.values())).sizes
    print(f"\n{'processor seconds an E step, ' + of:54}" + "".join(f"{n:>8}" for n in sizes))
    for name, growth in growths.items():
        print(f"{name:54}" + "".join(f"{s:8.3f}" for s in growth.seconds))
    missed = 0
    for name, growth in growths.items():
        off = abs(growth.ratio - 1) > TOLERANCE
        verdict = (" MISSED" if off else " ok") if judge else ""
        missed |= judge and off
        print(
            f"  {name}: {growth.equation}, R² {growth.r_squared:.4f}; less the "
            f"overhead as n^{growth.power:.2f}; cost of one at {sizes[-1]} over {sizes[-1] // 4}: {growth.ratio:.2f}"
            f" (must be within {TOLERANCE:.0%} of 1){verdict}"
        )
    return int(missed)


def draw(panels: dict[str, dict[str, Growth]], file: Path) -> None:
    """Seconds against n, a panel each, with the fitted lines."""
    figure, axes = plt.subplots(1, len(panels), figsize=(11, 4.2), sharey=True)
    for one, (of, growths) in zip(axes, panels.items(), strict=True):
        panel(one, of, growths)
    axes[0].set_ylabel("processor time of one E step [s]")
    axes[0].yaxis.set_major_locator(mpl.ticker.LogLocator(subs=(1, 2, 5)))
    axes[0].yaxis.set_major_formatter(mpl.ticker.FormatStrFormatter("%g"))
    figure.tight_layout()
    figure.savefig(file, dpi=150)
    plt.close(figure)
    print(f"\npicture {file}")


def panel(axes: Axes, of: str, growths: dict[str, Growth]) -> None:
    """What was measured, the fitted lines, and each line's name and equation at its end."""
    heights = apart([growth.seconds[-1] for growth in growths.values()])
    for (name, growth), height in zip(growths.items(), heights, strict=True):
        color, marker = LOOKS[name]
        overhead, slope = growth.line
        many = np.geomspace(growth.fitted[0][0], growth.sizes[-1], 100)
        axes.plot(many, overhead + slope * many, color=color, lw=1.2)
        axes.plot(growth.sizes, growth.seconds, marker, color=color, ms=5)
        label = f"{name}\n{growth.equation}"
        axes.text(1.03, height, label, transform=axes.get_yaxis_transform(), va="center", fontsize=8, color=color)
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.set_xticks(growth.sizes, [str(n) for n in growth.sizes])
    axes.set_xlabel(f"n, number of {of}")
    axes.grid(color="0.9", lw=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def apart(heights: list[float], factor: float = 1.8) -> list[float]:
    """Heights on a logarithmic axis, moved up until neighbours are a factor apart."""
    placed: dict[int, float] = {}
    lowest = 0.0
    for index in sorted(range(len(heights)), key=heights.__getitem__):
        placed[index] = max(heights[index], lowest)
        lowest = factor * placed[index]
    return [placed[index] for index in range(len(heights))]


if __name__ == "__main__":
    sys.exit(main())
