"""What the commands share: options, programs, runs and their labels, JSON, refusals of the system."""

import errno
import shlex
import signal
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event
from typing import Annotated, Any

import typer

import steady_ppl as st
from steady_ppl.errors import ComputationError, DataError, SteadyError, UsageError, require
from steady_ppl.utils.files import finite_json, whole_file
from steady_ppl.utils.text import say, shown, tell

NO_SPACE = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
NO_MEMORY = ("can't allocate memory", "not enough memory", "out of memory", "Storage size calculation overflowed")
MAX_COUNT = 10**9  # of whatever an option counts
MAX_MINUTES = 1e5  # after which a command ends: ten weeks


def count(help: str, least: int = 1) -> Any:
    """An option that says how many, `least` or more."""
    return typer.Option(help=help, min=least, max=MAX_COUNT)


def moved(which: str) -> Any:
    """An option that names the programs of several runs."""
    return typer.Option(help=f"The program, if its file moved or changed; {which}.")


Run = Annotated[Path, typer.Argument(help="Run folder.")]
RunsAndTable = Annotated[
    list[Path],
    typer.Argument(metavar="RUN... TABLE", help="Run folders, the reference first; then drives that no run has used."),
]
Model = Annotated[str, typer.Argument(help="Program: models/hovercraft.py, or mine.py:Boat.")]
Moved = Annotated[str | None, typer.Option(help="The program, if its file moved or changed.")]
MovedOfRun = Annotated[str | None, typer.Option(help="The run's program, if its file moved or changed.")]
Substeps = Annotated[
    int | None, typer.Option(help="Steps of the program in each row; those of its class when not given.")
]
Seed = Annotated[int, typer.Option(help="Random seed.", min=0, max=2**63 - 1)]  # a run's record holds 63 bits
Overwrite = Annotated[bool, typer.Option("--force", help="Overwrite an existing run.")]
Table = Annotated[Path, typer.Option("--out", help="Table to write, .csv or .parquet.")]
Horizons = Annotated[
    list[float] | None,
    typer.Option(
        "--horizon", metavar="SECONDS", help="Seconds ahead, repeat for several; chosen from the drives when not given."
    ),
]
Json = Annotated[Path | None, typer.Option("--json", help="JSON file to write; - prints it instead of the text.")]


def fit_or_program(
    source: str, program: str | None, seed: int = 0, substeps: int | None = None
) -> "st.Fit | st.Program":
    """The fit in a run folder, or else the program of a file; UsageError: `program` is given for what is no run."""
    from steady_ppl.model.validate import probe

    if not Path(source).is_dir():
        if program:
            raise UsageError("--program names the program of a RUN: leave it out")
        return program_from(source, seed, substeps)
    fit = st.Fit.load(source, program)
    if substeps is not None:
        fit.program = st.with_substeps(fit.program, substeps)
        probe(fit.program)
    return fit


def program_from(model: str, seed: int, substeps: int | None = None) -> "st.Program":
    """Load a program, its random initial weights keyed by the seed, and try it once on a probe; with as many substeps a
    row as its class says when None."""
    from steady_ppl.model.validate import probe

    with st.seeded(seed, "program"):
        program = st.load_program(model)
    if substeps is not None:
        program = st.with_substeps(program, substeps)
    probe(program)
    return program


def read_drives(table: Path, program: "st.Program", known: Collection[str] = ()) -> "st.Trajectories":
    """The drives of a table; what is suspicious in it is said, but for the kinds that are `known` to be said later."""
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


def write_json(path: Path, content: Any) -> None:
    """Write a file whole or not at all; a figure that is not finite is an error, JSON has no word for it."""
    text = finite_json(content, str(path), indent=1) + "\n"
    with whole_file(path) as beside:
        beside.write_text(text)


def present(text: str, content: Any, json_file: Path | None) -> None:
    """Print the text and write the figures beside it, or print the figures alone if the file is `-`."""
    if json_file is not None and str(json_file) == "-":
        tell(finite_json(content, "the output", indent=1))
        return
    tell(text)
    if json_file is not None:
        write_json(json_file, content)


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
    """The fits of runs by label, with the programs that `--program` names, one for each, or their own."""
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
                notes.append(f"{label} was {how} this very table: the comparison needs drives that were not used")
    return notes


def as_refusal(error: Exception) -> SteadyError | None:
    """A file that the system refuses, or more memory than there is; None for anything else, a defect perhaps.

    Example:
        >>> as_refusal(FileNotFoundError(2, "No such file or directory", "drives.csv"))
        UsageError('drives.csv: No such file or directory')
    """
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return UsageError(f"{shown(str(error.filename), 100)}: {error.strerror}")
    if isinstance(error, OSError) and error.errno in NO_SPACE:  # numba says no name of its cache
        return UsageError(f"a file cannot be written: {error.strerror}")
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and any(w in str(error) for w in NO_MEMORY)):
        return ComputationError("this needs more memory than there is: take fewer or shorter drives, or less of each")
    return None
