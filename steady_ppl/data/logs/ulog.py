"""PX4's ULog, read by pyulog."""

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from steady_ppl.data.logs.log import Log, Topic, span
from steady_ppl.errors import DataError, UsageError
from steady_ppl.utils.text import counted, one_line

HEADER_LENGTH = 3  # bytes before each message
CLOCKS = {"log": ("timestamp",), "sample": ("timestamp_sample",), "gps": ("time_utc_usec",)}


class _Watched(io.BufferedReader):
    """A file that knows how many bytes at its end make no whole message."""

    left = 0
    _before = 0

    def read(self, size: int | None = -1, /) -> bytes:
        size = -1 if size is None else size
        data = super().read(size)
        self.left = len(data) + (HEADER_LENGTH if self._before == HEADER_LENGTH else 0) if len(data) < size else 0
        self._before = size
        return data


def read_ulog(path: Path) -> Log:
    """Read a log as far as it is whole; DataError where nothing of it can be read, UsageError without pyulog."""
    try:
        from pyulog import ULog
    except ImportError as error:
        raise UsageError("ULog is read by pyulog, which is missing: pip install 'steady-ppl[logs]'") from error
    file = _Watched(io.FileIO(path))
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # pyulog prints what it thinks of damage
            found = ULog(file)
    except Exception as error:  # whatever a damaged log brings about in pyulog
        said = " ".join(one_line(error).split())[:200]
        raise DataError(f"{path.name}: cannot be read, is it damaged or cut short? ({said})") from error
    finally:
        file.close()
    topics: dict[str, Topic] = {}
    for data in found.data_list:
        name = f"{data.name}[{data.multi_id}]" if data.multi_id else data.name
        topics[name] = _joined(topics[name], data.data) if name in topics else Topic(data.data, CLOCKS, {})
    if not topics:
        raise DataError(f"{path.name}: cannot be read, it has no message; is it damaged or cut short?")
    start, end = span(topics)
    if 0 < found.start_timestamp * 1000 < end:
        start = found.start_timestamp * 1000  # the first messages of topics may be far older than the log
    return Log(path.name, "PX4 ULog", topics, start, end, tuple(_notes(found, file.left, (end - start) / 1e9)))


def _joined(topic: Topic, more: dict[str, np.ndarray]) -> Topic:
    """A topic that the log began anew: the fields that both have."""
    fields = {name: np.concatenate([values, more[name]]) for name, values in topic.fields.items() if name in more}
    return Topic(fields, CLOCKS, {})


def _notes(found: Any, left: int, seconds: float) -> list[str]:
    notes = []
    if found.file_corruption:
        notes.append("it is damaged: what pyulog could make no message of is not read")
    if left:
        notes.append(f"it is cut short after {seconds:.3f} s: the last {counted(left, 'byte')} are not read")
    if found.dropouts:
        lost = sum(dropout.duration for dropout in found.dropouts) / 1e3
        notes.append(f"in {counted(len(found.dropouts), 'place')}, {lost:.3f} s in all, it was not logged (dropouts)")
    return notes
