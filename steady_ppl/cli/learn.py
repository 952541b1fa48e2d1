"""`steady fit`, `discover`, `add`, `effects`, `study` and `plot-study`: models and what they learn."""

import ast
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Annotated, Any, Literal

import typer

import steady_ppl as st
from steady_ppl.cli import options
from steady_ppl.cli.inputs import fit_or_program, program_from, read_drives
from steady_ppl.cli.output import present, write_json
from steady_ppl.errors import RunError, UsageError, require
from steady_ppl.utils.context import QUIET
from steady_ppl.utils.files import require_picture, require_place, write_picture
from steady_ppl.utils.text import say, shown, tell

MAX_MINUTES = 1e5  # after which a command ends: ten weeks
LITERALS = {"true": True, "false": False, "none": None}
SAID_IN_NOTES = ("degrees",)  # kinds of findings, which a fit says itself
SAID_BY_DISCOVER = (*SAID_IN_NOTES, "constant")
RECIPES = ("steady", "likelihood", "steady-minus", "svi", "hand", "fit-hand", "fit-tv", "fit-truth")
GuideName = Literal["lookahead", "gaussian", "bootstrap", "network", "mean-field", "smoother"]


def fit(
    context: typer.Context,
    model: options.Model,
    table: Annotated[Path, typer.Argument(help="Training trajectories, .csv or .parquet.")],
    out: Annotated[Path, typer.Option("--out", help="Run folder to write.")],
    valid: Annotated[Path | None, typer.Option(help="Held-out trajectories: the stopping rule.")] = None,
    recipe: Annotated[
        str | None,
        typer.Option(
            help=f"{', '.join(RECIPES)}, or a recipe of your own: PATH.py. By default the one that suits MODEL: "
            "likelihood for some dozens of parameters and a model that can be linearised, else steady.",
            autocompletion=lambda incomplete: [name for name in RECIPES if name.startswith(incomplete)],
        ),
    ] = None,
    guide: Annotated[
        GuideName | None, typer.Option(help="The E step: the first three steady's, the others svi's.")
    ] = None,
    hand: Annotated[str | None, typer.Option(help="The model written by hand, for fit-hand.")] = None,
    known_start: Annotated[bool, typer.Option(help="Give the first row's x. columns as the exact start.")] = False,
    substeps: options.Substeps = None,
    particles: Annotated[int | None, options.count("Particles for each trajectory.")] = None,
    draws: Annotated[int | None, options.count("Paths for each trajectory in the M step.")] = None,
    steps: Annotated[int | None, options.count("Steps of the recipe, see its settings.")] = None,
    setting: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Another setting of the recipe, for example ramp=0.7."),
    ] = None,
    seed: options.Seed = 0,
    device: Annotated[Literal["cpu", "cuda"], typer.Option(help="Where to compute.")] = "cpu",
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted run.")] = False,
    force: options.Overwrite = False,
) -> None:
    """Learn a model's parameters from measurements."""
    from steady_ppl.runs.recipes import run_recipe

    given = {"particles": particles, "draws": draws, "steps": steps, "hand": hand, "guide": guide}
    program = program_from(model, seed, substeps)
    result = run_recipe(
        recipe,
        program,
        read_drives(table, program, SAID_IN_NOTES),
        st.read_table(valid) if valid else None,
        out,
        options=_settings(setting or [], {name: value for name, value in given.items() if value is not None}),
        known_start=known_start,
        seed=seed,
        device=device,
        resume=resume,
        force=force,
        progress=not QUIET.get(),
    )
    say(*result.notes)
    tell(f"{out}: {result.program}")
    if result.trained is not None:
        if result.trained.rise:
            first, kept = result.trained.rise
            rise = f"{first:.2f} → {kept:.2f} at step {result.trained.kept}"
            tell(f"held-out log p(y) of a trajectory {rise}, whose parameters were kept")
        if result.trained.interrupted:
            say(f"interrupted; the run so far is usable, `--resume` continues {out}")
            raise typer.Exit(1)


def _settings(pairs: list[str], found: dict[str, Any]) -> dict[str, Any]:
    """Add `NAME=VALUE` settings to the named options: Python literals, true, false, none, or else words."""
    for pair in pairs:
        name, equals, text = pair.partition("=")
        name = name.strip().replace("-", "_")
        if not (equals and name):
            raise UsageError(f"--set {pair}: expected NAME=VALUE")
        if name in found:
            raise UsageError(f"--set {pair}: {name} is given twice")
        word = text.strip()
        try:
            found[name] = ast.literal_eval(word)
        except (ValueError, SyntaxError):
            found[name] = LITERALS.get(word, word)
        if isinstance(found[name], int) and abs(found[name]) > options.MAX_COUNT:
            raise UsageError(f"--set {shown(pair, 60)}: expected a whole number up to {options.MAX_COUNT}")
    return found


def discover(
    source: Annotated[str, typer.Argument(metavar="RUN|MODEL", help="A run folder, or a model to fit first.")],
    table: Annotated[Path, typer.Argument(help="Trajectories to test and fit.")],
    valid: Annotated[
        Path | None, typer.Option(help="Validation trajectories; every second trajectory of TABLE when not given.")
    ] = None,
    known_start: Annotated[
        bool | None,
        typer.Option(help="Give the first row's x. columns as the exact start; a RUN's own setting when not given."),
    ] = None,
    substeps: options.Substeps = None,
    mix: Annotated[
        bool, typer.Option("--mix", help="Join both tables and validate on every second trajectory.")
    ] = False,
    out: Annotated[Path | None, typer.Option("--out", help="Run folder for the improved fit.")] = None,
    json_file: options.Json = None,
    picture: Annotated[Path | None, typer.Option(help="Picture to write, for example .png.")] = None,
    simulations: Annotated[int, options.count("Simulated sets for the calibration.", least=50)] = 200,
    withhold: Annotated[
        list[str] | None, typer.Option(metavar="EFFECT", help="Leave an effect out of the search; repeat for several.")
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND", help="Search this kind only: dynamics, actuator, sensor or noise; repeat for several."
        ),
    ] = None,
    minutes: Annotated[
        float | None, typer.Option(help="Minutes after which the search ends with its result so far.", min=0.01)
    ] = None,
    program: options.MovedOfRun = None,
    seed: options.Seed = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a search that was stopped.")] = False,
    force: options.Overwrite = False,
) -> None:
    """Identify missing effects: none, one or several of the catalogue, or a curve without a name."""
    from steady_ppl.discovery.discover import kept_search
    from steady_ppl.runs.folder import DISCOVERY, JOURNAL
    from steady_ppl.runs.recipes import fingerprint

    if out is None and resume:
        raise UsageError("--resume continues the search of a run folder: name it (--out)")
    if out is not None and out.exists() and not (force or resume):
        raise RunError(f"{out} exists: choose another folder, or --force to overwrite, or --resume to go on")
    require_picture(picture)
    require_place(json_file)
    given = fit_or_program(source, program, seed, substeps)
    drives = read_drives(table, given.program if isinstance(given, st.Fit) else given, SAID_BY_DISCOVER)
    judges = st.read_table(valid) if valid else None
    settings: dict[str, Any] = {"known_start": known_start, "mix": mix, "simulations": simulations, "seed": seed}
    settings |= {"withheld": withhold or [], "only": only or []}
    try:
        with kept_search(out, given, drives, judges, settings, force=force, resume=resume) as begun:
            with stopped_after(minutes) as over:
                found = st.discover(given, drives, judges, **settings)
            figures = {"source": source, **found.figures}
            present(str(found), figures, json_file)
            if out is not None:
                used = {"table_sha256": fingerprint(drives), "valid_sha256": fingerprint(judges) if judges else None}
                found.after.save_into(out, begun=begun if found.search.interrupted else used)
                write_json(out / DISCOVERY, figures)
    except KeyboardInterrupt as stop:  # before there was anything to show, or once more
        remarks = ["interrupted", *map(str, stop.args)]
        if out is not None and (out / JOURNAL).is_dir():
            remarks.append(f"`--resume` continues {out}")
        say("; ".join(remarks), always=True)
        raise typer.Exit(1) from stop
    if out is not None:
        say(*found.after.notes, f"{out}: {found.after.program}")
    if picture is not None:
        from steady_ppl.plotting.discovery import discovery_picture

        write_picture(discovery_picture(found), picture)
    if found.search.interrupted:
        usable = "" if out is None else f"; the run so far is usable, `--resume` continues {out}"
        stopped = f"stopped after {minutes:g} min" if over.is_set() else "interrupted"
        say(f"{stopped} while {found.search.interrupted}{usable}", always=True)
        if not over.is_set():
            raise typer.Exit(1)


@contextmanager
def stopped_after(minutes: float | None) -> Iterator[Event]:
    """Interrupt the block when its time is over, as Ctrl-C does; the event says so."""
    over = Event()
    if minutes is None:
        yield over
        return
    require(0 < minutes <= MAX_MINUTES, "--minutes", minutes, f"a time up to {MAX_MINUTES:g}")
    if not hasattr(signal, "setitimer"):
        raise UsageError("--minutes: this system has no timers that interrupt; Ctrl-C does the same")

    def stop(*_: object) -> None:
        over.set()
        raise KeyboardInterrupt(f"its {minutes:g} min are over")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, 60 * minutes)
    try:
        yield over
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def add(
    source: Annotated[str, typer.Argument(metavar="RUN|MODEL", help="A run folder, or a model's file.")],
    out: Annotated[Path, typer.Option("--out", metavar="MODEL.py", help="Model to write, beside the old one.")],
    effects: Annotated[
        list[str] | None,
        typer.Argument(metavar="EFFECT...", help="NAME[:AT][:OPTION=NUMBER][=NUMBER[,NUMBER]], see `steady effects`."),
    ] = None,
    program: options.MovedOfRun = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")] = False,
) -> None:
    """Write a model with physical effects; `fit` it like any other.

    Its parameters start at the run's values, a coefficient at the value that is given, else at the run's, else at the
    effect's typical one.
    """
    from steady_ppl.effects import attached, with_effects, write_program

    given = fit_or_program(source, program)
    grown, values = with_effects(given.program if isinstance(given, st.Fit) else given, effects or [])
    say(*values)
    if not attached(grown):
        raise UsageError(f"{source} has no effect that its file does not have: name one, `steady effects` lists them")
    notes = write_program(grown, out, force=force)
    if isinstance(given, st.Fit):
        say(*notes)
    tell(f"{out}: {grown}")
    for variant in attached(grown):
        tell(f"{variant.label}: {variant.effect.text}")
        tell(f"{variant.label}: ${variant.effect.equation}$")


def effects(
    model: Annotated[str | None, typer.Argument(help="List only the effects that apply to this model.")] = None,
) -> None:
    """List the physical effects that a model may lack."""
    from steady_ppl.effects.registry import page

    tell(page(program_from(model, 0) if model else None), end="")


def study(
    plan: Annotated[Path, typer.Argument(metavar="STUDY.toml", help="File of the study.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the results; an existing one is resumed.")],
    workers: Annotated[int | None, options.count("Processes of this machine; its cores when not given.")] = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler, tcp://HOST:PORT, in place of processes.")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="Folder of the logs or tables, if elsewhere.")] = None,
    again: Annotated[bool, typer.Option("--again", help="Repeat failed jobs.")] = False,
) -> None:
    """Compute a grid of models, data, recipes, settings and seeds, each job by itself.

    Results come into DIR/results.parquet, a row a job. The same command resumes, and computes only what is
    missing or has changed. `steady plot-study DIR` draws it.
    """
    import joblib

    from steady_ppl.studies.executors import Cluster, Local
    from steady_ppl.studies.plan import read_plan
    from steady_ppl.studies.runner import require_runnable, run_study

    if workers is not None and cluster is not None:
        raise UsageError("--workers are processes of this machine: take it or --cluster")
    read = read_plan(plan, data)
    require_runnable(read)
    place = Cluster(cluster) if cluster is not None else Local(workers or joblib.cpu_count(only_physical_cores=True))
    failed = run_study(read, out, place, again=again, say=say)
    tell(f"{out / 'results.parquet'}: {len(read.jobs) - failed} of {len(read.jobs)} jobs done")
    if failed:
        jobs = "job" if failed == 1 else "jobs"
        say(f"{failed} {jobs} failed: column reason says why, --again tries them once more", always=True)
        raise typer.Exit(1)


def plot_study(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of `steady study`.")],
    out: Annotated[Path | None, typer.Option("--out", help="Picture to write; DIR/study.png when not given.")] = None,
) -> None:
    """Draw what a study has found so far, as its [picture] says, beside what is published."""
    from steady_ppl.studies.pictures import study_picture
    from steady_ppl.studies.plan import recorded_plan
    from steady_ppl.studies.table import read_results

    plan, place = recorded_plan(folder), out or folder / "study.png"
    require_picture(place)
    write_picture(study_picture(plan, read_results(folder)), place)
    tell(place)
