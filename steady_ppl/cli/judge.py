"""`steady doctor`, `check`, `prove`, `evaluate`, `states` and `report`: what runs say of trajectories."""

import os
import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

import steady_ppl as st
from steady_ppl.cli import options
from steady_ppl.cli.inputs import load_runs, program_from, read_drives, run_labels, runs_and_table, used_before
from steady_ppl.cli.output import present
from steady_ppl.errors import UsageError
from steady_ppl.utils.files import require_picture, require_place, write_picture
from steady_ppl.utils.text import counted, say, tell

SAID_BY_CHECK = ("degrees", "frozen", "outlier")  # kinds of findings
MIN_SHARE_OF_POOR_ROWS = 0.1  # share of the measured rows after which hardly a particle is left
SIMULATIONS = 100  # sets for the bands of a report


def doctor(
    table: Annotated[Path, typer.Argument(help="Table, .csv or .parquet.")],
    model: Annotated[str | None, typer.Argument(help="Model: its units and step are used.")] = None,
    json_file: options.Json = None,
) -> None:
    """List suspicious cells of a table, each with the line that mends it."""
    require_place(json_file)
    found = st.doctor(table, None if model is None else program_from(model, 0))
    present(str(found), found.figures, json_file)


def check(
    run: options.Run,
    table: Annotated[Path, typer.Argument(help="Trajectories, preferably not those of the fit.")],
    json_file: options.Json = None,
    picture: Annotated[Path | None, typer.Option(help="Picture to write, for example .png.")] = None,
    mask: Annotated[
        Path | None,
        typer.Option(help="Table to write without outliers and interpolated stretches."),
    ] = None,
    simulations: Annotated[int, options.count("Simulated sets for the bands.", least=20)] = 100,
    horizon: options.Horizons = None,
    program: options.Moved = None,
    seed: options.Seed = 0,
) -> None:
    """Compare a run with measurements: where, when and in which regime it fails, and which part is wrong."""
    from steady_ppl.data.frozen_sensors import without_stretches
    from steady_ppl.data.table import require_table_file

    require_picture(picture)
    require_place(json_file)
    if mask is not None:
        require_table_file(mask)
        require_place(mask)
        if os.path.realpath(mask) in (os.path.realpath(table), json_file and os.path.realpath(json_file)):
            raise UsageError(f"--mask {mask} is the table itself, or the file of --json: name another file")
    fit = st.Fit.load(run, program)
    drives = read_drives(table, fit.program, SAID_BY_CHECK)
    found = st.check(fit, drives, simulations=simulations, horizons=horizon or (), seed=seed)
    if picture is not None:
        from steady_ppl.plotting.check import check_picture

        write_picture(check_picture(found), picture)
    present(str(found), {"run": str(run), **found.figures}, json_file)
    if mask is not None:
        st.write_table(found.outliers.without(without_stretches(drives, found.stuck)), mask)
        count, cells = len(found.stuck), found.outliers.cells
        stretches = f"{count} unmeasured stretch{'' if count == 1 else 'es'}"
        say(f"{mask}: {table.name} without {stretches} and {counted(cells, 'wrong reading')}")


def prove(
    arguments: options.RunsAndTable,
    truth: Annotated[str | None, typer.Option(help="Model that simulated the trajectories, if there is one.")] = None,
    oracle: Annotated[Path | None, typer.Option(help="Run of the true structure, fitted like the others.")] = None,
    json_file: options.Json = None,
    picture: Annotated[Path | None, typer.Option(help="Picture of the errors to write, for example .png.")] = None,
    horizon: options.Horizons = None,
    program: Annotated[list[str] | None, options.moved("once for each RUN and the oracle, in order")] = None,
    seed: options.Seed = 0,
) -> None:
    """Compare runs with the first: log p(y), open-loop errors and noise, with paired intervals.

    `steady evaluate RUN... TABLE` gives each run's errors alone, against true states where the table has them.
    """
    from steady_ppl.runs.recipes import fingerprint

    runs, table = runs_and_table("prove", arguments)
    require_picture(picture)
    require_place(json_file)
    labels = run_labels(runs, taken={"oracle", "truth"}) | ({"oracle": oracle} if oracle else {})
    rows: dict[str, st.Fit | st.Program] = {**load_runs(labels, program)}
    if truth is not None:
        rows["truth"] = program_from(truth, seed)
    drives = st.read_table(table)
    true = "truth" if truth is not None else None
    found = st.prove(rows, drives, truth=true, horizons=horizon or (), seed=seed)
    found.notes[:0] = used_before(labels, fingerprint(drives))
    if picture is not None:
        from steady_ppl.plotting.comparison import proof_picture

        write_picture(proof_picture(found), picture)
    present(str(found), {"runs": {label: str(run) for label, run in labels.items()}, **found.figures}, json_file)


def evaluate(
    arguments: Annotated[list[Path], typer.Argument(metavar="RUN... TABLE", help="Run folders, then the table.")],
    json_file: options.Json = None,
    particles: Annotated[int | None, options.count("Particles of the filters.", least=2)] = None,
    rollouts: Annotated[int, options.count("Noisy roll-outs from each true state.")] = 1000,
    seed: options.Seed = 0,
    surveyed: Annotated[
        str | None,
        typer.Option("--map", help="Model of the same vehicle with the true landmarks, for runs that learn theirs."),
    ] = None,
    program: Annotated[list[str] | None, options.moved("with several RUNs once for each, in their order")] = None,
) -> None:
    """The paper's errors where true states exist; errors in measurement space always."""
    from steady_ppl.comparison.evaluate import evaluate_all, incomparable, table_of
    from steady_ppl.runs.diagnostics import diagnose_units
    from steady_ppl.runs.recipes import fingerprint
    from steady_ppl.smc.genealogy import MIN_EFFECTIVE_SIZE

    runs, table = runs_and_table("evaluate", arguments)
    require_place(json_file)
    labels = run_labels(runs)
    fits = list(load_runs(labels, program).values())
    drives = st.read_table(table)
    true_map = st.load_program(surveyed) if surveyed else None
    folders = [str(run) for run in runs]
    results = evaluate_all(fits, folders, drives, particles=particles, rollouts=rollouts, seed=seed, surveyed=true_map)
    lines = [table_of(results, [f"{label} ({found['recipe']})" for label, found in zip(labels, results, strict=True)])]
    if true_map is not None:
        for label, result in zip(labels, results, strict=True):
            error, how = result["map"], "" if result["map"]["learned"] else " (declared, not learned)"
            lines.append(f"{label}: landmarks off by {error['rms']:.3g} m rms, {error['most']:.3g} m at most{how}")
    rows = [{"run": folder, **result} for folder, result in zip(folders, results, strict=True)]
    present("\n".join(lines), {"runs": rows}, json_file)
    doubts = {doubt: None for fit in fits for doubt in diagnose_units(fit.program, st.for_program(fit.program, drives))}
    say(*incomparable(results, folders), *used_before(labels, fingerprint(drives)), *drives.uneven_steps, *doubts)
    for run, result in zip(runs, results, strict=True):
        if result["filter"] != "lookahead":
            say(f"{run}: judged by the filter {result['filter']}")
        share, count, drive = (result["scarce"][key] for key in ("share", "particles", "trajectory"))
        if share > MIN_SHARE_OF_POOR_ROWS:
            say(
                f"{run}: after {share:.0%} of trajectory {drive}'s measured rows fewer than {MIN_EFFECTIVE_SIZE} of "
                f"the filter's {count} particles were in effect: its log p(y) scatters and is mostly too low, "
                "raise --particles"
            )


def states(
    run: options.Run,
    table: Annotated[Path, typer.Argument(help="Trajectories.")],
    out: Annotated[
        Path,
        typer.Option(
            "--out", help="A table (.csv, .parquet) of medians and 90 % intervals, or all draws for ArviZ (.nc)."
        ),
    ],
    draws: Annotated[int, options.count("Paths of each trajectory.")] = 100,
    particles: Annotated[int | None, options.count("Particles of the filter.")] = None,
    program: options.Moved = None,
    seed: options.Seed = 0,
) -> None:
    """Write posterior draws of the states, given all measurements of a trajectory.

    The table has for each state its median and the ends of its 90 % interval, `…_low` and `…_high`.
    """
    from steady_ppl.runs.diagnostics import diagnose_units
    from steady_ppl.runs.posterior import drawn_states, require_states_file, write_states
    from steady_ppl.smc.genealogy import degeneracy_note

    require_states_file(out)
    require_place(out)
    fit, drives = st.Fit.load(run, program), st.read_table(table)
    settings: dict[str, Any] = {"draws": draws, "particles": particles, "known_start": fit.known_start, "seed": seed}
    posterior = drawn_states(fit.program, drives, **settings)
    write_states(posterior, out)
    tell(f"{out}: {len(drives)} trajectories, {draws} draws of each")
    scarce = degeneracy_note(float(posterior["sample_stats"]["roots"].min()))
    say(*diagnose_units(fit.program, st.for_program(fit.program, drives)), *([scarce] if scarce else []))


def report(
    arguments: options.RunsAndTable,
    out: Annotated[Path, typer.Option("--out", help="The page to write.")] = Path("report.html"),
    discovery: Annotated[
        Path | None,
        typer.Option(help="Run of `steady discover`, or its --json file, if none of the RUNs has it."),
    ] = None,
    title: Annotated[str | None, typer.Option(help="Title of the page; the runs' names when not given.")] = None,
    simulations: Annotated[int, options.count("Simulated sets for the bands.", least=20)] = SIMULATIONS,
    horizon: options.Horizons = None,
    program: Annotated[list[str] | None, options.moved("once for each RUN, in order")] = None,
    seed: options.Seed = 0,
) -> None:
    """Write one page of HTML: verdict, measured against predicted, where it fails, what is missing, before and after.

    The result of `steady discover … --out RUN` is shown if RUN is one of the runs. The page needs no network.
    """
    from steady_ppl.discovery.result import read_discovery
    from steady_ppl.runs.recipes import fingerprint

    runs, table = runs_and_table("report", arguments)
    if out.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"{out}: expected a page's name that ends in .html")
    require_place(out)
    labels = run_labels(runs)
    fits = load_runs(labels, program)
    drives = st.read_table(table)
    found = [one for run in labels.values() if (one := read_discovery(run)) is not None]
    if discovery is not None and (known := read_discovery(discovery)) is None:
        raise UsageError(f"{discovery} is neither a RUN that `steady discover` made nor its --json file")
    given: list[tuple[str, Any]] = [("--discovery", discovery), ("--title", title)]
    given += [("--program", one) for one in program or []]
    given += [("--horizon", f"{seconds:g}") for seconds in horizon or []]
    given += [("--simulations", simulations if simulations != SIMULATIONS else None), ("--seed", seed or None)]
    words = ["steady", "report", *map(str, arguments)]
    words += [word for name, value in [*given, ("--out", out)] if value is not None for word in (name, str(value))]
    digest = fingerprint(drives)
    how = [*_commands_of(runs, discovery), f"# {table}: sha256 of its trajectories {digest[:16]}…", shlex.join(words)]
    st.report(
        fits,
        drives,
        discovery=known if discovery is not None else found[-1] if found else None,
        title=title or f"{', '.join(labels)} on {table.name}",
        how=["\n".join(how)],
        notes=used_before(labels, digest),
        simulations=simulations,
        horizons=horizon or (),
        seed=seed,
    ).write(out)
    tell(f"{out}: {', '.join(labels)} on {len(drives)} trajectories")


def _commands_of(runs: list[Path], discovery: Path | None) -> list[str]:
    """How each of the runs, and what was discovered, were made, by which command if one did."""
    from steady_ppl.runs.folder import RUN_RECORD, read_record

    if discovery is not None and (discovery / RUN_RECORD).is_file() and discovery not in runs:
        runs = [*runs[:1], discovery, *runs[1:]]
    made = []
    for run in runs:
        record = read_record(run)
        source = record["program"]
        start = "with" if record["known_start"] else "without"
        name = f"{os.path.relpath(run / source['file'])}:{source['class']}" if source else "a model of no file"
        made.append(f"# {run}: {name}, recipe {record['recipe']}, seed {record['seed']}, {start} a known start")
        if command := record.get("command"):
            made.append(command)
    return made
