"""The `steady` command. Each command reads its input, calls one function of the library, and writes whole files.

Exit codes: 0 done, 1 the computation failed or was interrupted, 2 bad usage or bad input.
"""

import os
import shlex
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version as installed_version
from typing import Annotated, Any

import typer

from steady_ppl.cli import demo, judge, learn, make, new
from steady_ppl.cli.output import as_refusal
from steady_ppl.cli.progress import progress_line
from steady_ppl.errors import SteadyError, TableWarning
from steady_ppl.utils.context import COMMAND, QUIET, UNITS_ROW, bound
from steady_ppl.utils.cores import ONE_THREAD
from steady_ppl.utils.progress import listening
from steady_ppl.utils.text import one_line, say, tell

INTERRUPTED_CODE = 130  # what typer returns for Ctrl-C
# left out of the help, which then fits one screen; as --debug, which the line of an unexpected error names
COMPLETION_OPTIONS = ("install_completion", "show_completion")
# before or after the command
GLOBAL_OPTIONS = {"--debug": "debug", "--quiet": "quiet", "-q": "quiet", "--units-row": "units row"}


app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def add_command(function: Callable[..., None], about: str, *examples: str, hidden: bool = False) -> None:
    """Add a command, what `steady --help` says of it, examples for its own help, and whether another one's help names
    it: one screen is full."""
    epilog = "\n".join(["\b", "Example:" if len(examples) == 1 else "Examples:", *(f"  {line}" for line in examples)])
    app.command(function.__name__.replace("_", "-"), short_help=about, epilog=epilog, hidden=hidden)(function)


add_command(demo.demo, "Run the whole loop on trajectories with a hidden effect.", "steady demo --out demo")
add_command(make.init, "Make a folder to work in, with first trajectories.", "steady init lab")
add_command(
    new.new,
    "Write a model from parts: vehicle, controls, sensors.",
    "steady new robot.py drives.csv --landmark 0,0 --landmark 5,0",
    "steady new car.py log.csv --control delta=steering --sensor position=gps:0.3 --table-out drives.csv",
    "steady new boat.py --vehicle car --sensor heading=compass:0.05,from_north=true",
)
add_command(
    make.import_bag,
    "Turn ROS 1 or 2 bags and MCAP files into a table.",
    "steady import-bag drive.bag > mapping.toml",
    "steady import-bag monday/*.mcap mapping.toml --out drives.csv",
    "steady import-bag drive.bag --map u.speed=/cmd_vel:linear.x \\",
    "                            --map y.range=/range:range --step 0.1 --out drive.csv",
)
add_command(
    make.import_log,
    "Turn PX4 and ArduPilot logs into a table.",
    "steady import-log drive.ulg px4-rover --out drive.csv",
    "steady import-log *.bin mapping.toml --from 30 --to 600 --out drives.csv",
    "steady import-log ardupilot-boat > mapping.toml",
)
add_command(
    make.simulate,
    "Simulate trajectories of a model.",
    "steady simulate models/hovercraft.py --trajectories 16 --out train.csv",
    "steady simulate models/hovercraft.py --effect wind=1,0.5 --out windy.csv",
    "steady simulate mine.py:Boat --controls drives.csv --out again.csv",
)
add_command(
    judge.doctor,
    "List suspicious cells of a table.",
    "steady doctor drives.csv",
    "steady doctor drives.csv mine.py --json findings.json",
)
add_command(
    learn.fit,
    "Learn a model's parameters from measurements.",
    "steady fit mine.py train.csv --valid valid.csv --recipe likelihood --out runs/first",
    "steady fit models/neural_vehicle.py:NeuralHovercraft train.csv --known-start --out runs/net",
    "steady fit mine.py train.csv --recipe svi --set learning_rate=1e-3 --out runs/svi",
)
add_command(
    judge.check,
    "Compare a run with data: where does it fail, and why?",
    "steady check runs/first test.csv --picture check.png",
    "steady check runs/first test.csv --quiet --json - | jq .who",
)
add_command(
    learn.discover,
    "Identify missing physical effects, or none.",
    "steady discover runs/first train.csv --valid valid.csv --out runs/found",
    "steady discover mine.py drives.csv --json found.json",
)
add_command(
    learn.add,
    "Write a model with physical effects.",
    "steady add runs/found --out models/with_drag.py",
    "steady add models/hovercraft.py yaw_linear_drag=0.05 wind --out models/windy.py",
)
add_command(
    judge.prove,
    "Compare runs on held-out trajectories.",
    "steady prove runs/before runs/after test.csv --picture proof.png",
)
add_command(
    judge.evaluate,
    "Errors of runs, against true states where they exist.",
    "steady evaluate runs/first runs/svi test.csv --json errors.json",
    hidden=True,
)
add_command(
    judge.report,
    "Write one page of HTML with all results.",
    "steady report runs/before runs/after test.csv --discovery runs/found --out report.html",
)
add_command(
    judge.states,
    "Write posterior draws of the states.",
    "steady states runs/after test.csv --out states.csv",
    "steady states runs/after test.csv --draws 200 --out states.nc",
)
add_command(
    learn.study,
    "Compute a grid of fits or searches, here or on a cluster.",
    "steady study studies/observation-noise.toml --data logs --out noise",
    "steady study mine.toml --cluster tcp://scheduler:8786 --out mine",
)
add_command(learn.plot_study, "Draw the results of a study.", "steady plot-study noise --out noise.png", hidden=True)
add_command(
    learn.effects,
    "List the physical effects of the catalogue.",
    "steady effects",
    "steady effects models/hovercraft.py",
    hidden=True,
)
app.add_typer(make.app, name="data", hidden=True, short_help="Published logs to tables; long trajectories in pieces.")


def say_version(asked: bool) -> None:
    """Print the version of the installed package, for a report of a fault."""
    if asked:
        tell(f"steady-ppl {installed_version('steady-ppl')}")
        raise typer.Exit


@app.callback()
def options(
    debug: Annotated[bool, typer.Option("--debug", hidden=True, help="Show the traceback of an error.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no notes, only results.")] = False,
    units_row: Annotated[
        bool, typer.Option("--units-row", hidden=True, help="Tables have a row of units below their header.")
    ] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=say_version, is_eager=True, hidden=True, help="Show the version.")
    ] = False,
) -> None:
    """Learn vehicle dynamics from noisy measurements. To see it: steady demo"""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    asked = {GLOBAL_OPTIONS[argument] for argument in arguments if argument in GLOBAL_OPTIONS}
    arguments = [argument for argument in arguments if argument not in GLOBAL_OPTIONS]
    command = typer.main.get_command(app)
    for option in command.params:
        if isinstance(option, typer.core.TyperOption) and option.name in COMPLETION_OPTIONS:
            option.hidden = True
    read = ["--units-row"] if "units row" in asked else []
    typed = shlex.join(["steady", *(word for word in arguments if word not in ("--resume", "--force")), *read])
    with (
        bound(QUIET, "quiet" in asked),
        bound(UNITS_ROW, "units row" in asked),
        _warnings_said(),
        bound(COMMAND, typed),
        progress_line() as line,
        listening(line),
        _terminated_as_interrupted(),
    ):
        try:
            code = command.main(arguments, prog_name="steady", standalone_mode=False) or 0
            if code == INTERRUPTED_CODE:
                raise KeyboardInterrupt
            return code
        except KeyboardInterrupt:
            say("interrupted", always=True)
            return 1
        except Exception as error:
            if type(error).__name__ == "NoArgsIsHelpError":  # of click, which typer may bring along itself
                tell(error)
                return 2
            if hasattr(error, "format_message"):
                if error.format_message():
                    say(f"{error.format_message()} (steady --help shows the usage)", always=True)
                return 2
            if "debug" in asked:
                tell(traceback.format_exc(), aside=True)
            refusal = error if isinstance(error, SteadyError) else as_refusal(error)
            if refusal is not None:
                say(str(refusal), always=True)
                return refusal.exit_code
            say(f"{one_line(error)} (--debug shows where)", always=True)
            return 1


@contextmanager
def _warnings_said() -> Iterator[None]:
    """Say how tables were read that other programs wrote, once each."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", TableWarning)
        show, told = warnings.showwarning, set[str]()

        def said(message: Warning | str, category: type[Warning], *place: Any, **given: Any) -> None:
            if not issubclass(category, TableWarning):
                show(message, category, *place, **given)
            elif str(message) not in told:
                told.add(str(message))
                say(str(message))

        warnings.showwarning = said
        yield


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Let SIGTERM interrupt the block as Ctrl-C does, unless this process ignores it."""
    before = signal.getsignal(signal.SIGTERM)
    if before != signal.SIG_DFL or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def run() -> None:
    """The console script. Its process has one thread, whatever the environment says; see `utils.cores`."""
    os.environ.update(ONE_THREAD)  # before torch and numpy load
    sys.exit(main())


if __name__ == "__main__":
    run()
