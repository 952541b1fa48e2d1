"""Logs to trajectories: `read_logs`.

Rows, holds, pauses and names are those of `read_bags`. Beyond that:

- A log is read up to where it is cut short; what is damaged in it is left out, and both are said.
- `as = "… from north"` turns angles that count from north clockwise into angles from east anticlockwise; `"east"` and
  `"north"` are metres in the plane that touches the ellipsoid at the origin (`LocalFrame`).
- `clock = "gps"` moves the receiver's time onto the log's as `clock = "aligned"` moves headers onto a bag's.
- `when` leaves out messages for which a condition does not hold.
- `armed` makes each span in which a vehicle is armed a trajectory; `begin` and `end` cut off what is before and after.
- A control that is NaN is not known: PX4 writes it where a motor is not driven. Trajectories end there.
- Messages are put in the order of their times, and how many went back is said.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from steady_ppl.data.logs.dataflash import HEAD, read_dataflash
from steady_ppl.data.logs.geodesy import LocalFrame
from steady_ppl.data.logs.log import Log, Topic, instead
from steady_ppl.data.logs.mapping import Condition, LogColumn, LogMapping
from steady_ppl.data.logs.ulog import read_ulog
from steady_ppl.data.recordings.resample import Series, Spans, align
from steady_ppl.data.recordings.trajectories import Reading, read_each, series_of
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError, UsageError
from steady_ppl.utils.files import require_file
from steady_ppl.utils.text import Say, counted, say as say_aside

ULOG_HEAD = b"ULog\x01\x12\x35"


def read_logs(
    paths: Sequence[str | Path],
    mapping: LogMapping,
    say: Say = say_aside,
    *,
    begin: float | None = None,
    end: float | None = None,
) -> Trajectories:
    """Read PX4 ULog and ArduPilot DataFlash logs into trajectories, float64, the columns in the order of the mapping.

    Args:
        paths: .ulg and .bin files.
        mapping: which field becomes which column.
        say: is told what is damaged, what was left out and which clocks were moved; by default on stderr.
        begin, end: s from the start of each log; rows are only between them.

    Raises:
        DataError: naming the log and, where they apply, the column, the topic and the field.
        UsageError: two logs of one name; pyulog is missing; `end` is not after `begin`.
    """
    if begin is not None and end is not None and not begin < end:
        raise UsageError(f"there is nothing between {begin:g} s and {end:g} s: expected an end after the beginning")
    frame = LocalFrame(*mapping.origin) if mapping.origin else None

    def read(file: Path) -> Reading:
        nonlocal frame
        log = open_log(file)
        for note in log.notes:
            say(f"{log.name}: {note}")
        series, spans, said = [], _spans(log, mapping, begin, end, say), set[str]()
        for column in mapping.columns:
            if frame is None and column.reading in ("east", "north"):
                frame = _first_position(log, column)
                say(f"{log.name}: x = y = 0 is its first position, {frame.latitude:.7f}, {frame.longitude:.7f} degrees")
            one, known = _series(log, column, frame, said, say)
            series.append(one)
            spans = known if spans is None else spans if known is None else _both(spans, known)
        return series, spans

    hint = "does the mapping suit the log? `steady import-log LOG` lists what is in it"
    files = [Path(path) for path in paths]
    return read_each(files, mapping, read, say, kind="log", name_of=lambda file: file.stem, hint=hint)


def open_log(path: Path) -> Log:
    """Read a log of either format, told by its first bytes; DataError for anything else."""
    require_file(path, DataError)
    try:
        with path.open("rb") as file:
            head = file.read(len(ULOG_HEAD))
    except (OSError, ValueError) as error:
        raise DataError(f"{path.name}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if head == ULOG_HEAD:
        return read_ulog(path)
    if head.startswith(HEAD):
        return read_dataflash(path)
    got = f"it begins with {head.hex(' ')}" if head else "it is empty"
    raise DataError(f"{path.name}: is no PX4 ULog (.ulg) and no binary ArduPilot DataFlash log (.bin): {got}")


def _series(
    log: Log, column: LogColumn, frame: LocalFrame | None, said: set[str], say: Say
) -> tuple[Series, Spans | None]:
    """What becomes of a column, and where it is known, if it is a control that is not known everywhere."""
    where = f"{log.name}: {column.where}"
    topic = log.topic(column.topic, where)
    values = _values(topic, column, where, frame)
    logged = topic.times("log")
    if logged is None:
        raise DataError(f"{where}: its messages have no time")
    times = topic.times(column.clock)
    if times is None:
        clocks = " or ".join(f'"{clock}"' for clock in topic.clocks if topic.times(clock) is not None)
        raise DataError(f'{where}: it has no clock "{column.clock}"; expected {clocks}')
    known = (times > 0) & (logged > 0)
    if len(times) and not known.any():
        raise DataError(
            f'{where}: the times on clock "{column.clock}" are all zero, nobody set them; use another clock'
        )
    notes = (
        [f"{_of(~known, len(known))} without a time on clock {column.clock!r} are left out"] if not known.all() else []
    )
    if column.when is not None:
        known &= _holds(topic, Condition.parse(column.when), where)
    times, logged, values = times[known], logged[known], values[known]
    if column.clock == "gps" and len(times):
        moved = align(times, logged)
        times = moved.times
        notes.append(moved.on("log"))
    if back := int((np.diff(times) < 0).sum()):
        notes.append(f"the time goes back {counted(back, 'time')}; messages are put in the order of their times")
    for note in (f"{log.name}: {column.topic}: {note}" for note in notes):
        if note not in said:
            said.add(note)
            say(note)
    finite, runs = np.isfinite(values), None
    if column.kind == "u" and not finite.all():
        runs = _runs(times, finite, log.end)
        say(f"{where}: it is not known (NaN) in {_of(~finite, len(finite))}, where trajectories end")
        times, values = times[finite], values[finite]
    return series_of(where, column, times, values), runs


def _of(which: np.ndarray, count: int) -> str:
    return f"{int(which.sum())} of {count} messages"


def _values(topic: Topic, column: LogColumn, where: str, frame: LocalFrame | None) -> np.ndarray:
    """What the messages of a topic say in the fields of a column, before `scale` and `offset`."""
    fields = _fields(topic, column, where)
    reading, _, from_north = (column.reading or "").partition(" ")
    if reading in ("east", "north"):
        latitude, longitude = _positions(topic, fields)
        return (
            np.full(len(topic), np.nan) if frame is None else frame.east_north(latitude, longitude)[reading == "north"]
        )
    if reading == "yaw":
        w, x, y, z = (topic.values(field) for field in fields)
        values = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
        values[(w == 0) & (x == 0) & (y == 0) & (z == 0)] = np.nan
    else:
        values = topic.values(fields[0])
    if reading == "degrees":
        values = np.radians(values)
    if from_north:
        values = np.pi / 2 - values
    return np.remainder(values + np.pi, 2 * np.pi) - np.pi if reading in ("degrees", "yaw") or from_north else values


def _fields(topic: Topic, column: LogColumn, where: str) -> list[str]:
    """The fields of a column that the topic has; DataError where it has none of them, or they are no numbers."""
    elements = column.reading in ("yaw", "yaw from north")
    choices = [
        [f"{names[0]}[{i}]" for i in range(4)] if elements and len(names) == 1 else names for names in column.choices
    ]
    found = next((names for names in choices if all(name in topic.fields for name in names)), None)
    if found is None:
        missing = next(name for name in choices[0] if name not in topic.fields)
        is_array = f"{missing}[0]" in topic.fields
        hint = f"name an element, such as {missing}[0]" if is_array else instead(missing, topic.numeric)
        raise DataError(f"{where}: {column.topic} has no field {missing}; {hint}")
    if text := [name for name in found if name not in topic.numeric]:
        raise DataError(f"{where}: expected a number, {text[0]} is text")
    return found


def _positions(topic: Topic, fields: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Latitudes and longitudes, degrees; NaN where they are none."""
    latitude, longitude = (topic.degrees(field) for field in fields)
    good = (np.abs(latitude) <= 90) & (np.abs(longitude) <= 180)
    return np.where(good, latitude, np.nan), np.where(good, longitude, np.nan)


def _first_position(log: Log, column: LogColumn) -> LocalFrame:
    where = f"{log.name}: {column.where}"
    topic = log.topic(column.topic, where)
    latitude, longitude = _positions(topic, _fields(topic, column, where))
    good = np.isfinite(latitude) & np.isfinite(longitude)
    if column.when is not None:
        good &= _holds(topic, Condition.parse(column.when), where)
    if not good.any():
        raise DataError(f"{where}: there is no position{f' where {column.when}' if column.when else ''}")
    first = int(good.argmax())
    return LocalFrame(float(latitude[first]), float(longitude[first]))


def _holds(topic: Topic, condition: Condition, where: str) -> np.ndarray:
    if condition.field not in topic.numeric:
        raise DataError(f"{where}: there is no number {condition.field}; {instead(condition.field, topic.numeric)}")
    return condition.holds(topic.values(condition.field))


def _spans(log: Log, mapping: LogMapping, begin: float | None, end: float | None, say: Say) -> Spans | None:
    """Where rows may be, ns; None for everywhere."""
    first = log.start + round((begin or 0.0) * 1e9)
    last = log.end if end is None else log.start + round(end * 1e9)
    if first > log.end or last < log.start:
        asked = f"from {begin or 0:g} s{'' if end is None else f' to {end:g} s'}"
        raise DataError(f"{log.name}: it has {(log.end - log.start) / 1e9:.3f} s, nothing of it is {asked}")
    whole = None if begin is None and end is None else [(first, last)]
    if mapping.arming is None:
        return whole
    name, condition = mapping.arming
    if name not in log.topics or not len(log.topics[name]):
        say(f"{log.name}: it has no {name}, by which it would be cut where it is armed: it is read whole")
        return whole
    topic = log.topics[name]
    armed, times = _holds(topic, condition, f"{log.name}: armed, topic {name}"), topic.times("log")
    if times is None or not armed.any():
        raise DataError(
            f"{log.name}: it is never armed: {mapping.armed} holds in none of {counted(len(topic), 'message')}"
        )
    return _both([(first, last)], _runs(times, armed, log.end))


def _runs(times: np.ndarray, holds: np.ndarray, end: int) -> Spans:
    """From where to where something holds that messages say, each for the time until the next or until `end`."""
    order = np.argsort(times, kind="stable")
    edges = np.diff(np.concatenate([[0], holds[order].astype(int)]))
    ups, downs = times[order][edges == 1].tolist(), times[order][edges == -1].tolist()
    return list(zip(ups, [*downs, end][: len(ups)], strict=True))


def _both(spans: Spans, others: Spans) -> Spans:
    """What is in both."""
    return [(max(a, c), min(b, d)) for a, b in spans for c, d in others if max(a, c) <= min(b, d)]
