"""The `steady` command. Each command reads its input, calls one function of the library, and writes whole files.

Exit codes: 0 done, 1 the computation failed or was interrupted, 2 bad usage or bad input.
"""

from __future__ import annotations

import ast
import sys
import traceback
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from steady_ppl import (
    command_check,
    command_demo,
    command_discover,
    command_effects,
    command_import_bag,
    command_init,
    command_prove,
    command_report,
)
from steady_ppl.command_parts import load_runs, program_from, require_folder, run_labels, say, used_before, write_json
from steady_ppl.errors import SteadyError, UsageError

WORDS = {"true": True, "false": False, "none": None}
INTERRUPTED = 130  # what typer returns for Ctrl-C

app = typer.Typer(
    help="Learn how a vehicle moves from noisy, indirect measurements.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
data_app = typer.Typer(help="Published logs to tables.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(data_app, name="data")
app.command()(command_check.check)
app.command()(command_demo.demo)
app.command()(command_discover.discover)
app.command()(command_effects.add)
app.command()(command_effects.effects)
app.command("import-bag")(command_import_bag.import_bag)
app.command()(command_init.init)
app.command()(command_prove.prove)
app.command()(command_report.report)


class Device(StrEnum):
    """Where tensors live."""

    cpu = "cpu"
    cuda = "cuda"


class GuideName(StrEnum):
    """The E step of STEADY, and the guides of SVI."""

    lookahead = "lookahead"
    gaussian = "gaussian"
    bootstrap = "bootstrap"
    network = "network"
    mean_field = "mean-field"
    smoother = "smoother"


RECIPES = "steady, steady-minus, svi, hand, fit-hand, fit-tv, fit-truth, or a recipe of your own: PATH.py."
Seed = Annotated[int, typer.Option(help="Random seed.", min=0)]
Out = Annotated[Path, typer.Option("--out", help="Table to write, .csv or .parquet.")]


@app.callback()
def options(debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False) -> None:
    """Learn how a vehicle moves from noisy, indirect measurements, with its model written as a Pyro program."""


@app.command()
def simulate(
    model: Annotated[str, typer.Argument(help="Program: models/hovercraft.py, or mine.py:Boat.")],
    out: Out,
    trajectories: Annotated[int | None, typer.Option(help="How many drives, 16 when not given.", min=1)] = None,
    seed: Seed = 0,
    controls: Annotated[Path | None, typer.Option(help="Take time, controls and gaps from this table.")] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME[=VALUE]", help="Add a physical effect, see `steady effects`; as often as needed."),
    ] = None,
) -> None:
    """Simulate drives of a program, with measurements and true states."""
    from steady_ppl.simulation import simulate as run
    from steady_ppl.table import read_table, write_table

    if controls and trajectories:
        raise UsageError("--controls has as many drives as its table: leave --trajectories out")
    program = command_effects.with_effects(program_from(model, seed), effect or [], say)
    like = read_table(controls) if controls else None
    write_table(run(program, trajectories or 16, seed=seed, like=like), out)


@data_app.command("alpha-truck")
def alpha_truck(
    folder: Annotated[Path, typer.Argument(help="One split: holds vrpn-pose.csv and vesc_drive.csv.")],
    out: Out,
    sigma_deg: Annotated[float, typer.Option(help="Standard deviation of the simulated bearings, degrees.")] = 5.0,
    seed: Seed = 0,
) -> None:
    """One split of the AlphaTruck logs to a table, resampled as the authors do.

    The logs are published in datasets/alpha_truck of the repository MrVPlusOne/STEADY on GitHub. They are real motion
    capture and commands; the bearings are simulated from the true poses. True states are kept in the x. columns.
    """
    from steady_ppl.alpha_truck import read_alpha_truck
    from steady_ppl.table import write_table

    write_table(read_alpha_truck(folder, sigma_degrees=sigma_deg, seed=seed), out)


@app.command()
def fit(
    context: typer.Context,
    model: Annotated[str, typer.Argument(help="Program: models/hovercraft.py, or mine.py:Boat.")],
    table: Annotated[Path, typer.Argument(help="Training drives, .csv or .parquet.")],
    out: Annotated[Path, typer.Option("--out", help="Run folder to write.")],
    valid: Annotated[Path | None, typer.Option(help="Held-out drives that decide when to stop.")] = None,
    recipe: Annotated[str, typer.Option(help=RECIPES)] = "steady",
    guide: Annotated[
        GuideName | None, typer.Option(help="The E step: the first three steady's, the others svi's.")
    ] = None,
    hand: Annotated[str | None, typer.Option(help="The program written by hand, for fit-hand.")] = None,
    known_start: Annotated[bool, typer.Option(help="Give the first row's x. columns as the exact start.")] = False,
    particles: Annotated[int | None, typer.Option(help="Particles for each drive.", min=1)] = None,
    draws: Annotated[int | None, typer.Option(help="Paths for each drive in the M step.", min=1)] = None,
    steps: Annotated[int | None, typer.Option(help="E steps.", min=1)] = None,
    setting: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Any other setting of the recipe, for example ramp=0.7."),
    ] = None,
    seed: Seed = 0,
    device: Annotated[Device, typer.Option(help="Where to compute.")] = Device.cpu,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted run.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing run.")] = False,
) -> None:
    """Learn a program's parameters from measurements."""
    from steady_ppl.run_recipe import run_recipe
    from steady_ppl.table import read_table

    given: dict[str, Any] = {"particles": particles, "draws": draws, "steps": steps, "hand": hand}
    given["guide"] = guide and guide.value
    result = run_recipe(
        recipe,
        program_from(model, seed),
        read_table(table),
        read_table(valid) if valid else None,
        out,
        options=_settings(setting or [], {name: value for name, value in given.items() if value is not None}),
        known_start=known_start,
        seed=seed,
        device=device.value,
        resume=resume,
        force=force,
        progress=True,
    )
    for note in result.notes:
        say(note)
    print(f"{out}: {result.program}")
    if result.trained is not None:
        judged = {e["step"]: e["log_likelihood"] for e in result.trained.history if "log_likelihood" in e}
        if judged:
            first, kept = next(iter(judged.values())), judged[result.trained.kept]
            print(
                f"held-out log p(y) {first:.2f} → {kept:.2f} at step {result.trained.kept}, whose parameters were kept"
            )
        if result.trained.interrupted:
            say(f"interrupted; the run so far is usable, `--resume` goes on with {out}")
            raise typer.Exit(1)


@app.command()
def evaluate(
    arguments: Annotated[list[Path], typer.Argument(metavar="RUN... TABLE", help="Run folders, then the table.")],
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures to this file.")] = None,
    particles: Annotated[int | None, typer.Option(help="Particles of the filters.", min=2)] = None,
    rollouts: Annotated[int, typer.Option(help="Noisy roll-outs from each true state.", min=1)] = 1000,
    seed: Seed = 0,
    surveyed: Annotated[
        str | None,
        typer.Option("--map", help="The same vehicle with the true landmarks, for runs that learned theirs."),
    ] = None,
    program: Annotated[
        list[str] | None,
        typer.Option(
            help="The program, if its file moved or changed; with several RUNs once for each, in their order."
        ),
    ] = None,
) -> None:
    """The paper's errors where true states exist; errors in measurement space always."""
    from steady_ppl.evaluation import evaluate_all, incomparable, table_of
    from steady_ppl.program_file import load_program
    from steady_ppl.run_recipe import fingerprint
    from steady_ppl.table import read_table

    if len(arguments) < 2:
        raise UsageError("evaluate needs at least one RUN and then a TABLE")
    require_folder(json_file)
    *runs, table = arguments
    labels = run_labels(runs)
    fits = list(load_runs(labels, program).values())
    drives = read_table(table)
    true_map = load_program(surveyed) if surveyed else None
    settings: dict[str, Any] = {"particles": particles, "rollouts": rollouts, "seed": seed, "surveyed": true_map}
    folders = [str(run) for run in runs]
    results = evaluate_all(fits, folders, drives, **settings)
    print(table_of(results, [f"{label} ({found['recipe']})" for label, found in zip(labels, results, strict=True)]))
    for reason in incomparable(results, folders) + used_before(labels, fingerprint(drives)):
        say(reason)
    for (label, run), result in zip(labels.items(), results, strict=True):
        if true_map is not None:
            error, how = result["map"], "" if result["map"]["learned"] else " (declared, not learned)"
            print(f"{label}: landmarks off by {error['rms']:.3g} m rms, {error['most']:.3g} m at most{how}")
        if result["filter"] != "lookahead":
            say(f"{run}: judged by the filter {result['filter']}")
    if json_file is not None:
        rows = [{"run": folder, **result} for folder, result in zip(folders, results, strict=True)]
        write_json(json_file, {"runs": rows})


def _settings(pairs: list[str], options: dict[str, Any]) -> dict[str, Any]:
    """Add `NAME=VALUE` settings to the named options: Python literals, true, false, none, or else words."""
    for pair in pairs:
        name, equals, text = pair.partition("=")
        name = name.strip().replace("-", "_")
        if not (equals and name):
            raise UsageError(f"--set {pair}: expected NAME=VALUE")
        if name in options:
            raise UsageError(f"--set {pair}: {name} is given twice")
        word = text.strip()
        try:
            options[name] = ast.literal_eval(word)
        except (ValueError, SyntaxError):
            options[name] = WORDS.get(word, word)
    return options


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    command = typer.main.get_command(app)
    try:
        code = command.main(arguments, prog_name="steady", standalone_mode=False) or 0
        if code == INTERRUPTED:
            say("interrupted")
            return 1
        return code
    except SteadyError as error:
        if debug:
            traceback.print_exc()
        say(str(error))
        return error.exit_code
    except KeyboardInterrupt:
        say("interrupted")
        return 1
    except Exception as error:
        if hasattr(error, "format_message"):
            if error.format_message():
                say(f"{error.format_message()} (steady --help shows the usage)")
            return 2
        if debug:
            traceback.print_exc()
        lines = str(error).strip().splitlines() or [""]
        say(f"{type(error).__name__}: {lines[0]} (--debug shows where)")
        return 1


def run() -> None:
    """The console script."""
    sys.exit(main())


if __name__ == "__main__":
    run()
