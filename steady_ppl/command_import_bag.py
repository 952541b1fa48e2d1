"""`steady import-bag`: ROS bags to a table."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer

from steady_ppl.errors import UsageError
from steady_ppl.utils.text import tell


def import_bag(
    arguments: Annotated[
        list[Path],
        typer.Argument(metavar="BAG... [MAPPING.toml]", help="ROS 1 .bag, ROS 2 folder or .mcap; then what to take."),
    ],
    out: Annotated[Path | None, typer.Option("--out", help="Table to write, .csv or .parquet.")] = None,
    column: Annotated[
        list[str] | None,
        typer.Option("--map", metavar="COLUMN=TOPIC:FIELD[,KEY=VALUE...]", help="One more column; as often as needed."),
    ] = None,
    step: Annotated[float | None, typer.Option(help="Seconds between rows; before that of MAPPING.toml.")] = None,
) -> None:
    """Turn ROS bags into a table; without a mapping, list what is in them and print one to start from."""
    from steady_ppl.data.rosbag.read import open_bag, read_bags
    from steady_ppl.data.rosbag.reader import listing
    from steady_ppl.data.table import require_table_file, write_table

    bags = [path for path in arguments if path.suffix != ".toml"]
    files = [path for path in arguments if path.suffix == ".toml"]
    if not bags or len(files) > 1:
        raise UsageError("import-bag needs at least one BAG and at most one MAPPING.toml")
    if not files and not column:
        if out is not None or step is not None:
            raise UsageError("name what to take from the bag, by MAPPING.toml or --map; without --out it is listed")
        with ExitStack() as opened:
            tell(listing([opened.enter_context(open_bag(path)) for path in bags]))
        return
    if out is None:
        raise UsageError("name the table to write: --out TABLE")
    mapping = _mapping(files[0] if files else None, column or [], step)
    require_table_file(out)
    data = read_bags(bags, mapping)
    write_table(data, out)
    rows, many = int(data.lengths.sum()), len(data)
    tell(f"{out}: {many} trajector{'y' if many == 1 else 'ies'}, {rows} rows, {_share(data)}")


def _mapping(file: Path | None, maps: list[str], step: float | None) -> Any:
    """What a file, `--map` and `--step` say together."""
    from steady_ppl.data.rosbag.mapping import BagMapping, parse_map, read_toml

    content: dict[str, Any] = read_toml(file) if file else {}
    if step is not None:
        content["step"] = step
    columns = content.get("columns", {})
    added: dict[str, Any] = {}
    for text in maps:
        name, said = parse_map(text)
        if name in added or (isinstance(columns, dict) and name in columns):
            raise UsageError(f"--map {text}: column {name} is given twice")
        added[name] = said
    if added and isinstance(columns, dict):
        content["columns"] = columns | added
    return BagMapping.parse(content, file.name if file else "--map")


def _share(data: Any) -> str:
    """How much of each measurement there is."""
    counts = data.observed.sum((0, 1)).tolist()
    return ", ".join(f"y.{name} in {count}" for name, count in zip(data.measurement_names, counts, strict=True))
