"""The steps of the loop that `loop.py` times, and the programs and tables that it gives them.

They run on engines of other commits too: commands and public names, but for what `refit` imports.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
EFFECT = "quadratic_drag"  # what `maximise` and `refit` add, one of the two that are missing
DRIVES = (1, 2, 3)  # seeds of the drives to fit, to choose by and to prove; of the truck's bearings the first

SIMULATED = f"""
import sys
import steady_ppl as st
truth, drives, rows = st.load_program(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
truth.duration = (rows - 1) * truth.step
for seed, name, count in zip({DRIVES}, ("train", "valid", "test"), (drives, drives, 32)):
    table = st.simulate(truth, count, seed=seed)
    st.write_table(table if name == "test" else table.without_truth(keep_start=True), name + ".csv")
"""
LOGS = f"""
import sys
from pathlib import Path
import steady_ppl as st
from steady_ppl.datasets.alpha_truck import read_alpha_truck
for name in ("train", "valid", "test"):
    table = read_alpha_truck(Path(sys.argv[1]) / name, seed={DRIVES[0]})
    st.write_table(table if name == "test" else table.without_truth(keep_start=True), name + ".csv")
"""
COPIED = """
import shutil, sys
for name in ("train", "valid", "test"):
    shutil.copyfile(f"{sys.argv[1]}/{name}.csv", name + ".csv")
"""
CALL = """
import json, sys, time
import torch
import steady_ppl as st
from steady_ppl.effects import chosen_variant
torch.set_num_threads(1)
program, effect, seed = st.load_program(sys.argv[1]), sys.argv[2], int(sys.argv[3])
train, valid = (st.for_program(program, st.read_table(f"../{name}.csv")) for name in ("train", "valid"))
def timed(call, *arguments, **options):
    wall, cpu = time.perf_counter(), time.process_time()
    found = call(*arguments, **options)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    if isinstance(found, str):
        sys.exit(found)
    print(json.dumps({"wall": wall, "cpu": cpu}))
"""
MAXIMISE = "timed(st.fit_by_likelihood, program.with_effect(effect), train, known_start=True)"
REFIT = """
from steady_ppl.discovery.refits import first_refit, refit_with
from steady_ppl.model.problem import Problem
base = first_refit(Problem(program, train, True), valid, seed=seed)
timed(refit_with, base, chosen_variant(program, effect), 0.01)
"""


@dataclass(frozen=True)
class Step:
    """What is timed: a command `steady WORDS`, or Python with WORDS as its arguments.

    Attributes:
        title: in the table.
        words: with {program}, {truth}, {start} (an option) and {seed}.
        source: Python; its last line may be the seconds of its part that counts.
        makes: the run folder that it writes.
        needs: steps that must have run.
    """

    title: str
    words: str = ""
    source: str = ""
    makes: str = ""
    needs: tuple[str, ...] = ()


FIT = "train.csv --valid ../valid.csv --recipe likelihood {start} --seed {seed} --force --out"
FIND = "../train.csv --valid ../valid.csv --seed {seed} --force --out"
CALLED = "{program} " + EFFECT + " {seed}"
STEPS = {
    "import": Step("import steady_ppl", source="import steady_ppl"),
    "import-discover": Step("import, and touch `st.discover`", source="import steady_ppl as st; st.discover"),
    "help": Step("steady --help", "--help"),
    "effects": Step("steady effects", "effects"),
    "fit": Step("fit by likelihood", "fit {program} ../" + FIT + " before", makes="before"),
    "fit-truth": Step("fit, nothing missing", "fit {truth} ../" + FIT + " oracle", makes="oracle"),
    "check": Step("check", "check before ../train.csv --seed {seed}", needs=("fit",)),
    "check-32": Step("check of 32 drives", "check before ../test.csv --seed {seed}", needs=("fit",)),
    "discover": Step("discover", "discover before " + FIND + " found", makes="found", needs=("fit",)),
    "discover-clean": Step("discover, nothing missing", f"discover oracle {FIND} same", needs=("fit-truth",)),
    "maximise": Step("maximise with one effect", CALLED, CALL + MAXIMISE),
    "refit": Step("refit of both halves, one effect", CALLED, CALL + REFIT),
    "prove": Step("prove", "prove before found ../test.csv --seed {seed}", needs=("discover",)),
    "report": Step(
        "report of three runs",
        "report before found oracle ../test.csv --discovery found --seed {seed} --out report.html",
        needs=("discover", "fit-truth"),
    ),
}
DEMO = "demo"
STEPS[DEMO] = Step("demo, whole", "demo --out demo --force")
OF_CASES = ("fit", "check", "discover", "prove")


@dataclass(frozen=True)
class Case:
    """A program and tables: Python with its arguments makes these in its folder. Data that are needed may be absent."""

    name: str
    program: str
    tables: str
    arguments: tuple[str, ...]
    truth: str = ""
    start: str = "--known-start"
    data: Path | None = None
    steps: tuple[str, ...] = OF_CASES

    @property
    def is_absent(self) -> bool:
        """Whether its data are not here."""
        return self.data is not None and not self.data.is_dir()


def sized(size: str) -> Case:
    """Drives of the hovercraft, "16x101" with 16 of them of 101 rows each."""
    drives, _, rows = size.partition("x")
    if not (drives.isdecimal() and rows.isdecimal() and int(drives) > 0 and int(rows) > 1):
        raise SystemExit(f"a size is DRIVESxROWS, not {size}")
    program = f"{ROOT / 'models' / 'hovercraft.py'}"
    truth = f"{program}:HovercraftTruth"
    steps = tuple(name for name in STEPS if name != DEMO or size == "16x101")  # it has drives of its own
    return Case(size, program, SIMULATED, (truth, drives, rows), truth, steps=steps)


def cases(shared: Path) -> list[Case]:
    """Other programs; the data of two are in a folder beside the checkout."""
    boat, truck = (f"{ROOT / 'models' / name}.py" for name in ("gps_boat", "truck"))
    logs, robot = shared / "data" / "alpha_truck", shared / "cases" / "mrclam"
    return [
        Case("boat", boat, SIMULATED, (f"{boat}:GpsBoatTruth", "8", "201"), start=""),
        Case("truck", truck, LOGS, (str(logs),), data=logs),
        Case("mrclam", f"{robot / 'robot.py'}", COPIED, (str(robot),), start="", data=robot),
    ]


def words_of(step: Step, case: Case, seed: int) -> list[str]:
    """What Python is given."""
    values = {"program": case.program, "truth": case.truth, "start": case.start, "seed": seed}
    said = [word for word in (word.format(**values) for word in step.words.split()) if word]
    return ["-c", step.source, *said] if step.source else ["-m", "steady_ppl.cli.main", *said]
