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

from steady_ppl.data.recordings.resample import Series, align
from steady_ppl.data.recordings.trajectories import Reading, read_each, series_of
from steady_ppl.data.rosbag.mapping import BagColumn, BagMapping
from steady_ppl.data.rosbag.reader import Bag, bag_name, check_field, has_stamp, open_bag, stamp_of, value_at
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError
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

    def read(file: Path) -> Reading:
        with open_bag(file, mapping.messages) as bag:
            return _series_of(bag, mapping, say), None

    hint = 'are the clocks the same? clock = "bag" and "aligned" go by that of the recorder'
    files = [Path(path) for path in paths]
    return read_each(files, mapping, read, say, kind="bag", name_of=_label, hint=hint)


def _label(file: Path) -> str:
    return bag_name(file) if file.is_dir() else file.stem


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
        say(f"{bag.name}: {topic}: {moved.on('bag')}")
    found = []
    for i, column in enumerate(columns):
        missing = sum(cells[i] is None for cells in values)
        where, among = f"{bag.name}: {column.where}", f"in {missing} of {len(arrivals)} messages"
        if missing and (missing == len(arrivals) or column.kind == "u"):
            raise DataError(f"{where}: the index is out of range {among}, the array is shorter")
        if missing:
            say(f"{where}: the array is shorter {among}, where nothing is taken for measured")
        found.append(series_of(where, column, times.get(column.clock, received), table[:, i]))
    return found
