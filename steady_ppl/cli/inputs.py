"""What commands read: models, runs and their labels, trajectories."""

import shlex
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import steady_ppl as st
from steady_ppl.errors import DataError, SteadyError, UsageError
from steady_ppl.utils.text import say


def fit_or_program(
    source: str, program: str | None, seed: int = 0, substeps: int | None = None
) -> "st.Fit | st.Program":
    """The fit in a run folder, or else the model of a file; UsageError: `program` is given for what is no run."""
    from steady_ppl.model.validate import probe

    if not Path(source).is_dir():
        if program:
            raise UsageError("--program names the model of a RUN: leave it out")
        return program_from(source, seed, substeps)
    fit = st.Fit.load(source, program)
    if substeps is not None:
        fit.program = st.with_substeps(fit.program, substeps)
        probe(fit.program)
    return fit


def program_from(model: str, seed: int, substeps: int | None = None) -> "st.Program":
    """Load a model, its random initial weights keyed by the seed, and try it once on a probe; with as many substeps a
    row as its class says when None."""
    from steady_ppl.model.validate import probe

    with st.seeded(seed, "program"):
        program = st.load_program(model)
    if substeps is not None:
        program = st.with_substeps(program, substeps)
    probe(program)
    return program


def read_drives(table: Path, program: "st.Program", known: Collection[str] = ()) -> "st.Trajectories":
    """The trajectories of a table; what is suspicious in it is said, but for kinds `known` to be said later."""
    doctor_says = f"`steady doctor {shlex.quote(str(table))}` says how to mend it"
    try:
        drives = st.read_table(table)
    except DataError as error:
        with suppress(SteadyError):  # it cannot be examined either
            if any(one.kind not in ("refused", "units row") for one in st.doctor(table, program).findings):
                column, label, row = error.column, error.trajectory, error.row
                error = DataError(f"{error} ({doctor_says})", column=column, trajectory=label, row=row)
        raise error from None
    if found := [one for one in st.doctor(drives, program).findings if one.kind not in known]:
        others = f"{len(found) - 1} more; " if len(found) > 1 else ""
        say(f"{table.name}: {found[0]} ({others}{doctor_says})")
    return drives


def runs_and_table(command: str, arguments: Sequence[Path]) -> tuple[list[Path], Path]:
    """What a command takes: run folders, and then a table."""
    *runs, table = arguments
    if not runs:
        raise UsageError(f"{command} needs at least one RUN and then a TABLE")
    return runs, table


def run_labels(runs: Sequence[Path], taken: Collection[str] = ()) -> dict[str, Path]:
    """Names of the rows of runs: the folders', or the whole paths where these are alike or `taken` by another row."""
    for labels in ({run.name: run for run in runs}, {str(run): run for run in runs}):
        if len(labels) == len(runs) and labels.keys().isdisjoint(taken):
            return labels
    raise UsageError(f"the runs {', '.join(map(str, runs))} cannot be told apart by name, or are called as another row")


def load_runs(labels: Mapping[str, Path], programs: Sequence[str] | None) -> "dict[str, st.Fit]":
    """The fits of runs by label, with the models that `--program` names, one for each, or their own."""
    sources: Sequence[str | None] = programs or [None] * len(labels)
    if len(sources) != len(labels):
        raise UsageError(f"--program is given {len(sources)} times for {len(labels)} runs: name one for each, in order")
    return {label: st.Fit.load(run, source) for (label, run), source in zip(labels.items(), sources, strict=True)}


def used_before(runs: Mapping[str, Path], table: str) -> list[str]:
    """Which runs, by label, have already learned from the table of this fingerprint."""
    from steady_ppl.runs.folder import read_record

    notes = []
    for label, run in runs.items():
        record = read_record(run)
        if record["recipe"] == "hand":
            continue  # was given it, and learned nothing
        for key, how in (("table_sha256", "fitted to"), ("valid_sha256", "chosen by")):
            if record.get(key) == table:
                notes.append(f"{label} was {how} this very table: the comparison needs trajectories that were not used")
    return notes
