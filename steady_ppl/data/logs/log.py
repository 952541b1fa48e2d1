"""A log as topics, their messages' fields and clocks: `Log`, whatever its format."""

import difflib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from steady_ppl.data.recordings.listing import Entry
from steady_ppl.errors import DataError

MAX_MICROSECONDS, MAX_WEEKS = 2**53, 14_000  # 285 and 268 years: a time beyond is none
WEEK = 7 * 86400  # s


@dataclass(frozen=True)
class Topic:
    """The messages of one topic, in the order of the log."""

    fields: Mapping[str, np.ndarray]  # (messages,) each, as the log has them
    clocks: Mapping[str, tuple[str, ...]]  # a field with µs, or two: the week and ms within it
    divisors: Mapping[str, float]  # of those fields that are whole numbers of a smaller unit

    def __len__(self) -> int:
        return len(next(iter(self.fields.values()), ()))

    @property
    def numeric(self) -> list[str]:
        """The fields that are numbers."""
        return [name for name, values in self.fields.items() if values.dtype.kind in "iufb"]

    def values(self, field: str) -> np.ndarray:
        """The numbers of a field, float64, in its unit."""
        return self.fields[field].astype(np.float64) / self.divisors.get(field, 1.0)

    def degrees(self, field: str) -> np.ndarray:
        """The numbers of a latitude or longitude in degrees; whole numbers count 1e-7 degrees."""
        whole = self.fields[field].dtype.kind in "iu" and field not in self.divisors
        return self.values(field) / (1e7 if whole else 1.0)

    def times(self, clock: str) -> np.ndarray | None:
        """The times of the messages on a clock, int64 ns, 0 where there is none; None without such a clock."""
        names = self.clocks.get(clock, ())
        if not names or not all(name in self.fields and self.fields[name].dtype.kind in "iu" for name in names):
            return None
        limit = MAX_WEEKS if len(names) == 2 else MAX_MICROSECONDS
        first = self.fields[names[0]].clip(0, limit + 1).astype(np.int64)
        first[first > limit] = 0
        if len(names) == 1:
            return first * 1000
        within = self.fields[names[1]].astype(np.int64) * 1_000_000
        return np.where(first > 0, first * WEEK * 1_000_000_000 + within, 0)


@dataclass(frozen=True)
class Log:
    """What a log has."""

    name: str  # of its file, for error messages
    format: str  # PX4 ULog, ArduPilot DataFlash
    topics: Mapping[str, Topic]  # `GPS`, and `GPS[1]` for a second instance
    start: int  # ns, on the log's clock
    end: int
    notes: tuple[str, ...]  # what is damaged or was never logged

    def topic(self, name: str, where: str) -> Topic:
        """A topic; DataError, which begins with `where`, where there is none of that name."""
        if name not in self.topics:
            raise DataError(f"{where}: {self.name} has no such topic; {instead(name, list(self.topics))}")
        return self.topics[name]


def instead(name: str, names: list[str]) -> str:
    """What to take in the place of a name that there is not."""
    near = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    return f"did you mean {' or '.join(near)}?" if near else f"it has {', '.join(names) or 'none'}"


def span(topics: Mapping[str, Topic]) -> tuple[int, int]:
    """The first and the last time of messages on the log's clock, ns; zeros where no message has one."""
    stamps = [times[times > 0] for topic in topics.values() if (times := topic.times("log")) is not None]
    ends = [(int(times.min()), int(times.max())) for times in stamps if len(times)]
    return (min(a for a, _ in ends), max(b for _, b in ends)) if ends else (0, 0)


def entries(log: Log) -> list[Entry]:
    """Of each topic that has messages its times and numeric fields."""
    found = []
    for name, topic in log.topics.items():
        times, stamps = topic.times("log"), {field for fields in topic.clocks.values() for field in fields}
        if times is not None and len(times):
            fields = _spelt(topic)
            found.append(Entry(name, "", times, fields, [field for field in fields if field not in stamps]))
    return found


def _spelt(topic: Topic) -> list[str]:
    """The numeric fields of a topic, arrays as `control[0…11]`."""
    lengths = Counter(name.partition("[")[0] for name in topic.numeric if name.endswith("]") and name.count("[") == 1)
    found = []
    for name in topic.numeric:
        array, _, index = name.partition("[")
        if not (index and array in lengths):
            found.append(name)
        elif index == "0]":
            found.append(f"{array}[0…{lengths[array] - 1}]" if lengths[array] > 1 else name)
    return found
