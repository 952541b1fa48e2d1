"""The pictures of docs/truck.md: roll-outs without noise over the true paths, errors along the paths of discovery.

    python benchmarks/truck_pictures.py --data FOLDER [--records benchmarks/results/truck.jsonl] [--out docs]

Draws truck.png (fits four programs to the first draw of the bearings, ten minutes) and truck-path.png.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import matplotlib.pyplot as plt
import torch
from experiments import LOGS, ROOT, truck
from matplotlib.axes import Axes
from truck_programs import learnt

from steady_ppl import Program, Trajectories, for_program, roll_out
from steady_ppl.comparison.evaluate import forward_mean
from steady_ppl.model.handlers import AtMean
from steady_ppl.model.substeps import acting_controls

SHOWN = {
    "fitted": ("#d55e00", "as written, fitted"),
    "network": ("0.5", "network"),
    "discovered": ("#0072b2", "discovered"),
    "hybrid": ("#009e73", "hybrid"),
}
DRIVES = ("3", "6", "9")
EVERY, AHEAD = 20, 19  # rows between roll-outs and of each


@torch.no_grad()
def roll_outs(program: Program, drive: Trajectories) -> torch.Tensor:
    """Without noise, from the true state of each EVERY-th row over AHEAD rows: `(rows, starts, D)`."""
    drive = for_program(program, drive)
    assert drive.states is not None
    controls = acting_controls(program, drive)
    starts = range(0, len(drive.states) - AHEAD, EVERY)

    def rows(values: torch.Tensor) -> torch.Tensor:
        return torch.stack([values[s : s + AHEAD, 0] for s in starts], 1)[:, None]

    state = torch.stack([drive.states[s, 0] for s in starts])[None, None]
    ahead = roll_out(program, state, rows(controls), rows(drive.elapsed), rows(drive.steps), handler=AtMean())
    return torch.stack([state[0, 0], *(there[0, 0] for there in ahead)])


def plane(axes: Axes, drive: Trajectories, programs: dict[str, Program]) -> None:
    """The true path and the roll-outs along it."""
    assert drive.states is not None
    axes.plot(*drive.states[:, 0, :2].T, color="black", lw=3, alpha=0.3, label="true path")
    for name, program in programs.items():
        for start in roll_outs(program, drive).unbind(1):
            axes.plot(*start[:, :2].T, color=SHOWN[name][0], lw=1.2)
            axes.plot(*start[-1, :2], "o", color=SHOWN[name][0], ms=3)
        axes.plot([], [], "o-", color=SHOWN[name][0], ms=3, lw=1.2, label=SHOWN[name][1])
    starts = drive.states[:-AHEAD:EVERY, 0, :2]
    axes.plot(*starts.T, "o", color="white", mec="black", ms=5, label="start of a roll-out")
    axes.set_aspect("equal", "datalim")
    axes.set_title(f"test drive {drive.labels[0]}")
    axes.set_xlabel("x [m]")


def horizons(axes: Axes, test: Trajectories, programs: dict[str, Program]) -> None:
    """Error of the mean roll-out against the seconds ahead."""
    rows = (1, 2, 3, 5, 7, 10, 15, 20, 30)
    seconds = [row * float(test.steps.nanmedian()) for row in rows]
    for name, program in programs.items():
        errors = [forward_mean(program, for_program(program, test), horizon=row)["location"] for row in rows]
        axes.plot(seconds, errors, "o-", color=SHOWN[name][0], ms=3, label=SHOWN[name][1])
    axes.set_xlabel("predicted ahead [s]")
    axes.set_ylabel("location, root mean square error [m]")
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False, fontsize=8)
    axes.set_title("all test drives")


def roll_out_picture(logs: Path, draw: int, file: Path) -> None:
    data = truck(logs, draw, centred=True)
    programs: dict[str, Any] = {name: learnt(name, data, draw)[0].program for name in SHOWN}
    figure, axes = plt.subplots(1, len(DRIVES) + 1, figsize=(14, 4), layout="constrained")
    labels = list(data[2].labels)
    for label, one in zip(DRIVES, axes, strict=False):
        shown = {name: programs[name] for name in ("fitted", "discovered")}
        plane(one, data[2].subset([labels.index(label)]), shown)
    axes[0].set_ylabel("y [m]")
    axes[0].legend(frameon=False, fontsize=8)
    horizons(axes[-1], data[2], programs)
    figure.savefig(file, dpi=110)


def path_picture(records: list[dict[str, Any]], file: Path) -> None:
    """A line a draw: from the hand-written program along what was added, the programs of the table beside it."""
    figures = (("noisy roll-outs, location [m]", "forward"), ("mean roll-out, location [m]", "forward_mean"), ("", ""))
    figure, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    paths = sorted((r for r in records if r.get("part") == "path"), key=lambda r: r["draw"])
    most = max(sum(bool(step["added"]) for step in record["steps"]) for record in paths) + 1
    for one, (title, group) in zip(axes, figures, strict=True):
        for record in paths:
            tests = [step["test"] for step in record["steps"] if step["added"] or step is record["steps"][0]]
            values = [test[group]["location"] if group else test["log_likelihood"] for test in tests]
            one.plot(range(len(values)), values, "o-", color="#0072b2", alpha=0.6, ms=4)
        for name, color in (("network", "0.5"), ("hybrid", "#009e73")):
            runs = [r for r in records if r.get("program") == name]
            values = [r[group]["location"] if group else r["log_likelihood"] for r in runs]
            one.axhline(
                sum(values) / len(values), color=color, lw=1, ls="--", label=f"{name}, mean of {len(runs)} draws"
            )
        one.set_title(title or "log p(y) at 1 Hz, nats a drive")
        one.set_xticks(range(most), ["as written,\nfitted", *(f"+ search {n}" for n in range(1, most))])
        if group:
            one.set_ylim(bottom=0)
    axes[0].legend(frameon=False, fontsize=8)
    figure.savefig(file, dpi=110)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=LOGS, help="the AlphaTruck logs: train/, valid/ and test/")
    parser.add_argument("--records", type=Path, default=ROOT / "benchmarks" / "results" / "truck.jsonl")
    parser.add_argument("--draw", type=int, default=1)
    parser.add_argument("--out", type=Path, default=ROOT / "docs")
    arguments = parser.parse_args()
    if not arguments.data.is_dir():
        print("name the folder with the AlphaTruck logs: --data", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    records = [json.loads(line) for line in arguments.records.read_text().splitlines()]
    path_picture(records, arguments.out / "truck-path.png")
    roll_out_picture(arguments.data, arguments.draw, arguments.out / "truck.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
