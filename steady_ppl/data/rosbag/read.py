"""Bags to trajectories: `read_bags`.

A bag has messages at any time; a table has one row every `step` seconds.

- Rows lie on a grid, in time from zero, from the first moment at which every control is known to the last measurement.
- A control is held, or with `between = "interpolate"` on the line between two commands, angles the shorter way round;
  after the last command that one goes on.
- A measurement is in the row that is nearest to it. It is never interpolated or held, which would make up data. Of
  several the nearest to the row's time is kept (of two as near, the earlier); how many were left out is said.
- A state is on the line between its neighbours where these are at most two steps apart, else unknown. Headings come
  back continuous, the first of a trajectory between −π and π.
- NaN and infinity, and an array too short in some messages, are missing measurements or states, and in a control an
  error.
- Where a control pauses for more than its `longest`, the trajectory ends with the last command before, and a new one
  begins with the first after. It is left out, and this is said, if it has fewer than two rows or no measurement.
- `clock` says whose time counts; `late` is subtracted last. Messages of one time stay in their order.
- Every bag is a trajectory named after its file, or several, `name-1`, `name-2`, … where it pauses.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from steady_ppl.data.rosbag.mapping import BagColumn, BagMapping
from steady_ppl.data.rosbag.reader import Bag, bag_name, check_field, has_stamp, open_bag, stamp_of, value_at
from steady_ppl.data.rosbag.resample import EvenRows, Series, align, in_rows, long_holds
from steady_ppl.data.table import from_frame
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError, UsageError
from steady_ppl.utils.progress import stages
from steady_ppl.utils.text import Say, say as say_aside


def read_bags(paths: Sequence[str | Path], mapping: BagMapping, say: Say = say_aside) -> Trajectories:
    """Read ROS bags into trajectories, in the order of the bags, float64, the columns in the order of the mapping.

    Args:
        paths: ROS 1 .bag files, ROS 2 folders, or single .mcap or .db3 files.
        mapping: which field becomes which column.
        say: is told what was left out and which clocks were moved; by default on stderr.

    Raises:
        DataError: naming the bag and, where they apply, the column, the topic and the field.
        UsageError: two bags of one name.
    """
    files = [Path(path) for path in paths]
    labels = [bag_name(file) if file.is_dir() else file.stem for file in files]
    for i, label in enumerate(labels):
        if label in labels[:i]:
            raise UsageError(f"two bags are named {label}, and so would be their trajectories: rename one")
    if not files:
        raise UsageError("there is no bag: name at least one")
    kept: dict[str, EvenRows] = {}
    with stages(*((f"reading {label}", 1) for label in labels)) as begin:
        for file, label in zip(files, labels, strict=True):
            begin()
            with open_bag(file, mapping.messages) as bag:
                series = _series_of(bag, mapping, say)
            for name, piece in _pieces(series, mapping, label, say).items():
                if name in kept:
                    raise UsageError(f"two trajectories are named {name}: rename the bag {file.name}")
                kept[name] = piece
    if not kept:
        why = f"no trajectory is left of {', '.join(labels)}: no two rows have known controls and a measurement"
        how = 'are the clocks the same? clock = "bag" and "aligned" go by that of the recorder'
        raise DataError(f"{why}; {how}")
    columns = [column.name for column in sorted(mapping.columns, key=lambda column: "uyx".index(column.kind))]
    blocks = [
        pd.DataFrame(piece.cells, columns=columns).assign(trajectory=name, time=np.arange(piece.rows) * mapping.step)
        for name, piece in kept.items()
    ]
    return from_frame(pd.concat(blocks, ignore_index=True), name=", ".join(labels))


def _series_of(bag: Bag, mapping: BagMapping, say: Say) -> list[Series]:
    """What the messages of a bag say in the fields of a mapping, in the order of its columns."""
    topics: dict[str, list[BagColumn]] = {}
    for column in mapping.columns:
        where = f"{bag.name}: {column.where}"
        type_name = bag.type_of(column.topic, where)
        check_field(bag.store, type_name, column.steps, where, quaternion=column.reading == "yaw")
        if column.clock != "bag" and not has_stamp(bag.store, type_name):
            raise DataError(f'{where}: a {type_name} has no header.stamp; expected clock = "bag"')
        topics.setdefault(column.topic, []).append(column)
    if lacking := sorted({bag.type_of(topic, bag.name) for topic in topics} - bag.defined):
        say(f"{bag.name} does not define {', '.join(lacking)}: taken from `messages`, else from ROS 2 Humble")
    found: dict[str, Series] = {}
    with stages(*((topic, 1) for topic in topics)) as begin:
        for topic, columns in topics.items():
            begin()
            found |= {one.column.name: one for one in _of_topic(bag, topic, columns, say)}
    return [found[column.name] for column in mapping.columns]


def _of_topic(bag: Bag, topic: str, columns: list[BagColumn], say: Say) -> list[Series]:
    stamped = any(column.clock != "bag" for column in columns)
    fields = [(column.steps, column.reading == "yaw") for column in columns]
    arrivals, headers, values = list[int](), list[int](), list[list[float | None]]()
    for connection, arrival, raw in bag.messages([topic]):
        message = bag.content(connection, raw)
        arrivals.append(arrival)
        if stamped:
            headers.append(stamp_of(message))
        values.append([value_at(message, steps, yaw=yaw) for steps, yaw in fields])
    received, stamps = np.array(arrivals, dtype=np.int64), np.array(headers, dtype=np.int64)
    table = np.array(values, dtype=np.float64).reshape(len(arrivals), len(columns))  # None becomes NaN
    if unset := int((stamps == 0).sum()):
        what = f"the header.stamp of {unset} of {len(stamps)} messages is zero, nobody set it"
        raise DataError(f'{bag.name}: topic {topic}: {what}; use clock = "bag"')
    times = {"bag": received, "header": stamps}
    if any(column.clock == "aligned" for column in columns) and len(stamps):
        moved = align(stamps, received)
        times["aligned"] = moved.times
        off = f"{abs(moved.offset) * 1e3:.3f} ms {'behind' if moved.offset >= 0 else 'ahead of'} the bag's halfway"
        drift = f"{'lost' if moved.drift >= 0 else 'gained'} {abs(moved.drift) * 1e6:.2f} ppm"
        say(f"{bag.name}: {topic}: its clock was {off}, the smallest delay included, and {drift}")
    found = []
    for i, column in enumerate(columns):
        missing = sum(cells[i] is None for cells in values)
        where, among = f"{bag.name}: {column.where}", f"in {missing} of {len(arrivals)} messages"
        if missing and (missing == len(arrivals) or column.kind == "u"):
            raise DataError(f"{where}: the index is out of range {among}, the array is shorter")
        if missing:
            say(f"{where}: the array is shorter {among}, where nothing is taken for measured")
        time = times.get(column.clock, received) - round(column.late * 1e9)
        found.append(_series(where, column, time, table[:, i]))
    return found


def _series(where: str, column: BagColumn, time: np.ndarray, values: np.ndarray) -> Series:
    """The finite values in the order of their times; a control must have some, and no others."""
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


def _pieces(series: list[Series], mapping: BagMapping, label: str, say: Say) -> dict[str, EvenRows]:
    """The trajectories of a bag by name, without those that say nothing; what is left out is said."""
    found = in_rows(series, mapping.step, label)
    for held in long_holds(series, mapping.step):
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
    for counts, why in ((rivals, "another was nearer to their row"), (outside, "some control was not known then")):
        if any(counts.values()):
            each = ", ".join(f"{count} of {measured[name]} {name}" for name, count in counts.items() if count)
            say(f"{label}: measurements left out, because {why}: {each}")
    return kept
