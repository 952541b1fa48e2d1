"""Recordings to trajectories, whatever their kind: `read_each`, and the series of one column."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from steady_ppl.data.recordings.mapping import Column, TableMapping
from steady_ppl.data.recordings.resample import EvenRows, Series, Spans, in_rows, long_holds
from steady_ppl.data.table import from_frame
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError, UsageError
from steady_ppl.utils.progress import stages
from steady_ppl.utils.text import Say

Reading = tuple[list[Series], Spans | None]  # the series of the columns, and the spans that rows may be in


def read_each(
    files: Sequence[Path],
    mapping: TableMapping,
    read: Callable[[Path], Reading],
    say: Say,
    *,
    kind: str,
    name_of: Callable[[Path], str],
    hint: str,
) -> Trajectories:
    """Read recordings into trajectories that are named after them; `kind` and `hint` are words of messages.

    Raises:
        DataError: no trajectory is left, or `read` raises it.
        UsageError: there is no recording, or two are of one name.
    """
    labels = [name_of(file) for file in files]
    for i, label in enumerate(labels):
        if label in labels[:i]:
            raise UsageError(f"two {kind}s are named {label}, and so would be their trajectories: rename one")
    if not files:
        raise UsageError(f"there is no {kind}: name at least one")
    kept: dict[str, EvenRows] = {}
    with stages(*((f"reading {label}", 1) for label in labels)) as begin:
        for file, label in zip(files, labels, strict=True):
            begin()
            series, spans = read(file)
            for name, piece in _pieces(series, mapping.step, label, spans, say).items():
                if name in kept:
                    raise UsageError(f"two trajectories are named {name}: rename the {kind} {file.name}")
                kept[name] = piece
    if not kept:
        why = f"no trajectory is left of {', '.join(labels)}: no two rows have known controls and a measurement"
        raise DataError(f"{why}; {hint}")
    columns = [column.name for column in sorted(mapping.columns, key=lambda column: "uyx".index(column.kind))]
    blocks = [
        pd.DataFrame(piece.cells, columns=columns).assign(trajectory=name, time=np.arange(piece.rows) * mapping.step)
        for name, piece in kept.items()
    ]
    return from_frame(pd.concat(blocks, ignore_index=True), name=", ".join(labels))


def series_of(where: str, column: Column, time: np.ndarray, values: np.ndarray) -> Series:
    """The finite values, `late` subtracted, in the order of their times; a control must have some, and no others.

    `time` is `(messages,)` int64 ns, `values` as long. DataErrors begin with `where`.
    """
    time = time - round(column.late * 1e9)
    order = np.argsort(time, kind="stable")
    time, values = time[order], values[order]
    good = np.isfinite(values)
    if column.kind == "u" and not good.all():
        i = int(good.argmin())
        got = f"got {values[i]} after {(time[i] - time[0]) / 1e9:.3f} s, expected a finite number"
        raise DataError(f"{where}: {got}: a control must be known", column=column.name)
    if column.kind == "u" and not len(time):
        raise DataError(f"{where}: there is no message, and a control must be known")
    return Series(column, time[good], values[good])


def _pieces(series: list[Series], step: float, label: str, spans: Spans | None, say: Say) -> dict[str, EvenRows]:
    """The trajectories of a recording by name, without those that say nothing; what is left out is said."""
    found = in_rows(series, step, label, spans)
    for held in long_holds(series, step):
        say(f"{label}: {held}")
    first = min((int(one.times[0]) for one in series if len(one.times)), default=0)
    kept = {}
    for i, piece in enumerate(found):
        name = label if len(found) == 1 else f"{label}-{i + 1}"
        if piece.rows >= 2:
            kept[name] = piece
            continue
        what = "has one row" if piece.rows else "has no measurement"
        say(f"{name}, from {(piece.start - first) / 1e9:.3f} s, {what} and is left out")
    measured = {one.column.name: len(one.times) for one in series if one.column.kind == "y"}
    rivals = {name: sum(piece.rivals[name] for piece in found) for name in measured}
    outside = {name: count - sum(piece.placed[name] for piece in found) for name, count in measured.items()}
    why_outside = "some control was not known then" if spans is None else "they are outside of what was to be read"
    for counts, why in ((rivals, "another was nearer to their row"), (outside, why_outside)):
        if any(counts.values()):
            each = ", ".join(f"{count} of {measured[name]} {name}" for name, count in counts.items() if count)
            say(f"{label}: measurements left out, because {why}: {each}")
    return kept
