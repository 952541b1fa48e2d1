"""`steady init`, `simulate`, `import-bag`, `import-log` and `data`: folders and tables to work with."""

import shlex
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

import steady_ppl as st
from steady_ppl.cli import options
from steady_ppl.cli.inputs import program_from
from steady_ppl.errors import UsageError
from steady_ppl.utils.progress import stages
from steady_ppl.utils.text import say, tell

if TYPE_CHECKING:
    from steady_ppl.data.recordings.mapping import TableMapping

Mapped = TypeVar("Mapped", bound="TableMapping")

NEXT_COMMANDS = (
    "steady fit models/hovercraft.py train.csv --valid valid.csv --known-start --recipe likelihood --out runs/first",
    "steady check runs/first test.csv",
    "steady discover runs/first train.csv --valid valid.csv --out runs/found",
    "steady report runs/first runs/found test.csv --out report.html",
)


def init(folder: Annotated[Path, typer.Argument(metavar="DIR", help="The folder to make.")]) -> None:
    """Make a folder to work in: models, recipes and first tables of trajectories to try them on."""
    from steady_ppl.runs.workbench import FOLDERS, make_workbench

    tables = make_workbench(folder)
    tell(f"{folder}: {', '.join(f'{room}/' for room in FOLDERS)}, {', '.join(table.name for table in tables)}")
    tell("\n".join(["", "next:", f"  cd {shlex.quote(str(folder))}", *(f"  {line}" for line in NEXT_COMMANDS)]))


Out = Annotated[Path | None, typer.Option("--out", help="Table to write, .csv or .parquet.")]
Maps = Annotated[
    list[str] | None,
    typer.Option("--map", metavar="COLUMN=TOPIC:FIELD[,KEY=VALUE...]", help="Another column; repeat for several."),
]
Step = Annotated[float | None, typer.Option(help="Seconds between rows; overrides MAPPING.toml.")]


def import_bag(
    arguments: Annotated[
        list[Path],
        typer.Argument(metavar="BAG... [MAPPING.toml]", help="ROS 1 .bag, ROS 2 folder or .mcap; then what to take."),
    ],
    out: Out = None,
    column: Maps = None,
    step: Step = None,
) -> None:
    """Turn ROS bags into a table; without a mapping, list what is in them and print one to start from."""
    from steady_ppl.data.recordings.listing import listing
    from steady_ppl.data.rosbag.reader import entries, open_bag

    bags = [path for path in arguments if path.suffix != ".toml"]
    files = [path for path in arguments if path.suffix == ".toml"]
    if not bags or len(files) > 1:
        raise UsageError("import-bag needs at least one BAG and at most one MAPPING.toml")
    if (place := _place(files, column, out, step, "bag")) is None:
        with ExitStack() as opened:
            found = [opened.enter_context(open_bag(path)) for path in bags]
            tell(listing([(bag.name, entries(bag)) for bag in found]))
        return
    mapping = _mapping(st.BagMapping, files, column, step)
    _written(place, lambda: st.read_bags(bags, mapping))


def import_log(
    arguments: Annotated[
        list[Path],
        typer.Argument(metavar="LOG... [MAPPING]", help="PX4 .ulg or ArduPilot .bin; then a .toml or a ready mapping."),
    ],
    out: Out = None,
    column: Maps = None,
    step: Step = None,
    begin: Annotated[float | None, typer.Option("--from", help="Second of each log at which to begin.")] = None,
    end: Annotated[float | None, typer.Option("--to", help="Second of each log at which to end.")] = None,
) -> None:
    """Turn PX4 and ArduPilot logs into a table; without a mapping, list what is in them.

    Ready mappings: px4-rover, px4-boat, px4-multicopter-plane, ardupilot-rover, ardupilot-rover-commands,
    ardupilot-boat. One alone is printed, to start from.
    """
    from steady_ppl.data.logs.log import entries
    from steady_ppl.data.logs.mapping import READY, READY_FOLDER
    from steady_ppl.data.logs.read import open_log
    from steady_ppl.data.recordings.listing import listing

    files = [path for path in arguments if path.suffix == ".toml" or str(path) in READY]
    logs = [path for path in arguments if path not in files]
    alone = [*map(str, arguments)] == [*map(str, files[:1])] and str(arguments[0]) in READY
    if alone and not any((out, column, step, begin, end)):
        tell((READY_FOLDER / f"{files[0]}.toml").read_text(encoding="utf-8"), end="")
        return
    if not logs or len(files) > 1:
        raise UsageError(f"import-log needs at least one LOG and at most one mapping: a .toml, or {', '.join(READY)}")
    if (place := _place(files, column, out, step, "log")) is None:
        tell(listing([(f"{log.name}  {log.format}", entries(log)) for log in map(open_log, logs)]))
        return
    mapping = _mapping(st.LogMapping, files, column, step)
    _written(place, lambda: st.read_logs(logs, mapping, begin=begin, end=end))


def _place(files: list[Path], maps: list[str] | None, out: Path | None, step: float | None, kind: str) -> Path | None:
    """Where a recording is imported to, None where it is listed; UsageError where it is not said what of it, or where
    to."""
    if not files and not maps:
        if out is not None or step is not None:
            what = "MAPPING.toml or --map" if kind == "bag" else "a mapping or --map"
            raise UsageError(f"name what to take from the {kind}, by {what}; without --out it is listed")
        return None
    if out is None:
        raise UsageError("name the table to write: --out TABLE")
    return out


def _written(out: Path, read: "Callable[[], st.Trajectories]") -> None:
    """Write the table that is read, and say what is in it."""
    from steady_ppl.data.table import require_table_file

    require_table_file(out)
    data = read()
    st.write_table(data, out)
    rows, many, counts = int(data.lengths.sum()), len(data), data.observed.sum((0, 1)).tolist()
    seen = ", ".join(f"y.{name} in {count}" for name, count in zip(data.measurement_names, counts, strict=True))
    tell(f"{out}: {many} trajector{'y' if many == 1 else 'ies'}, {rows} rows, {seen}")


def _mapping(kind: "type[Mapped]", files: list[Path], maps: list[str] | None, step: float | None) -> "Mapped":
    """What a file, `--map` and `--step` say together."""
    from steady_ppl.data.recordings.mapping import parse_map

    content: dict[str, Any] = kind.content(files[0]) if files else {}
    if step is not None:
        content["step"] = step
    columns = content.setdefault("columns", {})
    for text in maps or []:
        name, said = parse_map(text)
        if isinstance(columns, dict):  # else the mapping is refused
            if name in columns:
                raise UsageError(f"--map {text}: column {name} is given twice")
            columns[name] = said
    return kind.parse(content, files[0].name if files else "--map")


app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


@app.command("alpha-truck", epilog="Example:  steady data alpha-truck alpha_truck/train --out train.csv")
def alpha_truck(
    folder: Annotated[Path, typer.Argument(help="One split: holds vrpn-pose.csv and vesc_drive.csv.")],
    out: options.Table,
    sigma_deg: Annotated[float, typer.Option(help="Standard deviation of the simulated bearings, degrees.")] = 5.0,
    centred: Annotated[
        bool, typer.Option("--centred", help="Velocities at each row, not half a row later as the authors have them.")
    ] = False,
    seed: options.Seed = 0,
) -> None:
    """One split of the AlphaTruck logs to a table, resampled as the authors do.

    The logs are published in datasets/alpha_truck of the repository MrVPlusOne/STEADY on GitHub. They are real motion
    capture and commands; the bearings are simulated from the true poses. True states are kept in the x. columns.
    """
    from steady_ppl.datasets.alpha_truck import read_alpha_truck

    st.write_table(read_alpha_truck(folder, sigma_degrees=sigma_deg, seed=seed, centred=centred), out)


@app.command("cut", epilog="Example:  steady data cut log.csv --seconds 60 --out drives.csv")
def cut(
    table: Annotated[Path, typer.Argument(help="Trajectories.")],
    seconds: Annotated[float, typer.Option(help="Length of a piece, s.")],
    out: options.Table,
) -> None:
    """Long trajectories in pieces, `…-1`, `…-2`, … of the trajectory's name.

    Each begins at its first row that has a measurement; pieces of one row or without a measurement are left out.
    """
    from steady_ppl.data.table import require_table_file

    require_table_file(out)
    drives = st.read_table(table)
    pieces = st.cut(drives, seconds)
    st.write_table(pieces, out)
    tell(f"{out}: {len(pieces)} trajectories")
    if left_out := int(drives.lengths.sum() - pieces.lengths.sum()):
        say(f"{left_out} rows left out: before a piece's first measurement, or in pieces that have none or one row")


@app.callback()
def data() -> None:
    """Published logs to tables; long trajectories in pieces."""


def simulate(
    model: options.Model,
    out: options.Table,
    trajectories: Annotated[int | None, options.count("How many trajectories, 16 when not given.")] = None,
    seed: options.Seed = 0,
    controls: Annotated[Path | None, typer.Option(help="Table whose times, controls and gaps are used.")] = None,
    substeps: Annotated[
        int | None,
        typer.Option(help="Steps of the model in each row; enough for 5 ms or less when not given."),
    ] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME[=VALUE]", help="Add a physical effect, see `steady effects`; repeat for several."),
    ] = None,
) -> None:
    """Simulate trajectories of a model, with measurements and true states."""
    from steady_ppl.effects import with_effects
    from steady_ppl.model.validate import probe
    from steady_ppl.smc.simulate import simulated_in

    if controls and trajectories:
        raise UsageError("--controls has as many trajectories as its table: leave --trajectories out")
    program, values = with_effects(program_from(model, seed), effect or [])
    say(*values)
    if substeps is not None:
        probe(st.with_substeps(program, substeps))
    like = st.read_table(controls) if controls else None
    with stages(("simulating", 1)) as begin:
        begin()
        drives = st.simulate(program, trajectories or 16, seed=seed, like=like, substeps=substeps)
    st.write_table(drives, out)
    say(simulated_in(program, drives, substeps))
