"""The whole loop on trajectories with hidden effects: compare, learn what is missing, add it, fit again, prove.

Every step is a command as one could type it. That command is what runs, and the sentence below it is what it found.
"""

import io
import json
import shlex
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir, nullcontext, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer

import steady_ppl as st
from steady_ppl.errors import ComputationError, RunError
from steady_ppl.runs.workbench import TRUE_PROGRAM, cleared_on_failure, workbench
from steady_ppl.utils.files import read_json
from steady_ppl.utils.text import TEXT_WIDTH, aligned, figure, tell


@dataclass
class Demo:
    """Runs commands, tells of them, and remembers what they said."""

    command: Any  # `steady`, as typer makes it
    say: Callable[[str], None]
    force: bool = False  # the commands overwrite what is there
    steps: list[dict[str, Any]] = field(default_factory=list)  # title, commands, result and seconds of each

    def step(self, title: str) -> None:
        self.steps.append({"title": title, "commands": [], "began": time.perf_counter()})
        self.say(f"\n{len(self.steps)}. {title}")

    def steady(self, command: str, *, keep: str = "") -> str:
        """Run `steady COMMAND`; what it prints is returned, and written to the file `keep`. Its bars are shown on a
        terminal only. Raises what the command does, and KeyboardInterrupt where it was interrupted."""
        overwrites = self.force and command.split()[0] in ("fit", "discover", "add")
        line = f"steady {command}{' --force' * overwrites}"
        self.steps[-1]["commands"].append(line)
        self.say(f"   $ {line}")
        said = io.StringIO()
        quiet = nullcontext() if sys.stderr.isatty() else redirect_stderr(io.StringIO())
        with redirect_stdout(said), quiet:
            code = self.command.main(shlex.split(line)[1:], prog_name="steady", standalone_mode=False)
        if code:
            raise KeyboardInterrupt
        if keep:
            Path(keep).write_text(said.getvalue(), encoding="utf-8")
        return said.getvalue()

    def result(self, text: str) -> None:
        """End a step with what came out."""
        step = self.steps[-1]
        step["seconds"], step["result"] = round(time.perf_counter() - step.pop("began"), 1), text
        said = f"{text} ({step['seconds']:.0f} s)"
        self.say(textwrap.fill(said, TEXT_WIDTH, initial_indent="   → ", subsequent_indent="     "))


DEMO_RECORD = "demo.json"  # of a demonstration; a folder without one is not a demonstration's
OWNER_PROGRAM = "models/hovercraft.py"
INTRODUCTION = (
    "A hovercraft has drag, and its model has none. The data are noisy bearings to four landmarks, the controls, and "
    "the first state of each trajectory (--known-start, as in the paper)."
)


@dataclass(frozen=True)
class Size:
    """How many trajectories are simulated to fit, to choose by, and to be locked away until the proof; and how many
    sets calibrate the tests of `check` and `discover`, their own numbers when None."""

    train: int = 16
    valid: int = 16
    test: int = 32
    simulations: int | None = None

    @property
    def calibration(self) -> str:
        """As an option of the commands."""
        return f" --simulations {self.simulations}" if self.simulations else ""


def demonstrate(
    out: Path, command: Any, *, size: Size = Size(), force: bool = False, say: Callable[[str], None] = print
) -> None:
    """Go through the loop and keep everything in a folder: tables of trajectories, models, runs, figures, pictures.

    An earlier demonstration there is overwritten, and what is none where `force` says so.

    Raises:
        RunError: the folder exists and is no demonstration's.
        ComputationError: the search ended with nothing that can be added.
    """
    began = time.perf_counter()
    demo = Demo(command, say, force=out.exists())
    _open(out, force)
    say(textwrap.fill(INTRODUCTION, TEXT_WIDTH))
    say(f"\n   $ cd {shlex.quote(str(out))}")
    with chdir(out):
        record_drives(demo, size)
        demo.step("Fit the model without drag")
        demo.result(_fit(demo, OWNER_PROGRAM, "before"))
        demo.step("Check: does it fit the trajectories of its own fit?")
        sets = size.calibration
        demo.steady(f"check runs/before train.csv{sets} --json check.json --picture check.png", keep="check.txt")
        demo.result(read_json(Path("check.json"), RunError)["verdict"])
        grown = add(demo, discover(demo, size))
        demo.step("Fit again, in the same way, on the same trajectories; and the true structure, as the reference")
        said = _fit(demo, grown, "after")
        _fit(demo, TRUE_PROGRAM, "oracle")
        demo.result(said)
        prove(demo)
        demo.step("Check the finished model, on the same trajectories: what is left?")
        demo.steady(f"check runs/after test.csv{sets} --json after.json", keep="after.txt")
        demo.result(read_json(Path("after.json"), RunError)["verdict"])
        demo.step("See it: everything on one page")
        demo.steady(f"report runs/before runs/after test.csv --discovery runs/found{sets} --out report.html")
        demo.result("report.html: open it in a browser, it needs no network.")
        hidden = f"What had been hidden: {st.load_program(TRUE_PROGRAM)}."
        say(textwrap.fill(hidden, TEXT_WIDTH, initial_indent="\n   ", subsequent_indent="   "))
    _write_record(out, {"status": "finished", "seconds": round(time.perf_counter() - began, 1), "steps": demo.steps})
    say(f"\n{out}: report.html; check, discovery and proof as .png, .txt and .json; trajectories; runs; {grown}")
    say(f"{time.perf_counter() - began:.0f} s in all")


def record_drives(demo: Demo, size: Size) -> None:
    """Simulate trajectories of a hovercraft with drag, and drop its poses."""
    demo.step("Simulate trajectories of a hovercraft with drag")
    for seed, (name, count) in enumerate((("train", size.train), ("valid", size.valid), ("test", size.test)), 1):
        demo.steady(f"simulate {TRUE_PROGRAM} --trajectories {count} --seed {seed} --out {name}.csv")
    for table in ("train.csv", "valid.csv"):
        st.write_table(st.read_table(table).without_truth(keep_start=True), table)
    demo.result(
        f"{size.train} trajectories for the fit and {size.valid} for validation keep controls, bearings and the first "
        f"state. {size.test} more with true poses are held out for the proof. The hovercraft moves in steps of 5 ms, "
        "its models in those of the rows."
    )


def discover(demo: Demo, size: Size) -> list[str]:
    """Which effects are missing, as the run's record names them."""
    from steady_ppl.runs.folder import read_record

    demo.step("Discover: which physical effect is missing?")
    demo.steady(
        f"discover runs/before train.csv --valid valid.csv{size.calibration} --out runs/found "
        "--json discovery.json --picture discovery.png",
        keep="discovery.txt",
    )
    sentence = read_json(Path("discovery.json"), RunError)["sentence"]
    demo.result(sentence)
    if not (effects := read_record(Path("runs/found"))["effects"]):
        raise ComputationError(f"there is nothing to add, and the demonstration ends here: {sentence}")
    return effects


def add(demo: Demo, effects: Sequence[str]) -> str:
    """Write the model with the effects beside the owner's."""
    demo.step("Add: write the model with it")
    names = dict.fromkeys(effect.split(":")[0].split("=")[0] for effect in effects)
    grown = f"models/hovercraft_with_{'_and_'.join(names)}.py"
    equations = [line for line in demo.steady(f"add runs/found --out {grown}").splitlines()[1:] if "$" not in line]
    demo.result(f"{'; '.join(equations)}. It is a Pyro program like any other.")
    return grown


def prove(demo: Demo) -> None:
    """Before and after on the held-out trajectories."""
    demo.step("Prove: on the held-out trajectories")
    demo.steady(
        f"prove runs/before runs/after test.csv --oracle runs/oracle --truth {TRUE_PROGRAM} "
        "--json proof.json --picture proof.png",
        keep="proof.txt",
    )
    figures = read_json(Path("proof.json"), RunError)
    demo.result(figures["verdict"])
    demo.say("")
    for line in _summary(figures):
        demo.say(f"     {line}")


def _summary(figures: Mapping[str, Any]) -> list[str]:
    """A few columns of the proof's figures, as aligned lines: log p(y), errors of the measurements and of the first
    error group of the states, and the channel whose noise had to be largest for what was missing."""
    rows = figures["rows"]
    unit, group = next(iter(rows[0]["measurement"])), next(iter(rows[0]["state"]))
    ahead = [name for name in figures["horizons"] if name != "one step"]
    before, after = (row["scales"]["channels"] for row in rows[:2])
    channel = max(before, key=lambda name: before[name] / after[name])
    far = "3 s" if "3 s" in ahead else ahead[-1]
    header = ["", "log p(y)", *(f"{name} [{unit}]" for name in ahead)]
    lines = [[*header, f"{group}, {far} [{figures['units'][group]}]", f"σ {channel}"]]
    for row in rows:
        errors = [row["measurement"][unit].get(name) for name in ahead]
        values = [*errors, row["state"].get(group, {}).get(far), row["scales"]["channels"].get(channel)]
        lines.append([row["row"], figure(row["log_likelihood"], ".1f"), *(figure(value, ".3g") for value in values)])
    return aligned(lines)


def _fit(demo: Demo, program: str, run: str) -> str:
    """The fitted model, in a line."""
    said = demo.steady(f"fit {program} train.csv --valid valid.csv --known-start --out runs/{run}")
    return said.splitlines()[0].removeprefix(f"runs/{run}: ") + "."


def _open(out: Path, force: bool) -> None:
    """Make the folder, mark it as a demonstration's, and put the owner's model there."""
    if out.exists() and not force and not (out / DEMO_RECORD).is_file():
        raise RunError(f"{out} exists and is no demo's: choose another folder, or --force to write into it")
    source = workbench() / OWNER_PROGRAM
    with cleared_on_failure(out):
        (out / "models").mkdir(exist_ok=True)
        shutil.copyfile(source, out / OWNER_PROGRAM)
        _write_record(out, {"status": "running"})


def _write_record(out: Path, content: Mapping[str, Any]) -> None:
    (out / DEMO_RECORD).write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def demo(
    context: typer.Context,
    out: Annotated[Path, typer.Option("--out", help="Folder to write.")] = Path("out/demo"),
    force: Annotated[bool, typer.Option("--force", help="Write into a folder that is no demo's.")] = False,
) -> None:
    """Run the whole loop (check, discover, add, fit again, prove) on a hovercraft whose model has no drag.

    It prints the commands that it runs, with what they found, and keeps trajectories, models, runs and pictures.
    """
    demonstrate(out, context.find_root().command, force=force, say=tell)
