"""What is in bags: topics, rates and fields, and a mapping to start from.

All but the step is a comment of TOML, so that the whole is a file to edit.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from steady_ppl.bag_fields import has_stamp, numeric_fields
from steady_ppl.bag_files import Bag

_WIDTH = 116


def listing(bags: Sequence[Bag]) -> str:
    """Of each bag its topics with type, number of messages, median rate and numeric fields; then a mapping to start
    from, whose sections are comments."""
    lines: list[str] = []
    sections: dict[tuple[str, str], list[str]] = {}
    for bag in bags:
        said, found = _of_bag(bag)
        lines += said
        sections |= found
    return "\n".join(lines + _skeleton(sections))


def _of_bag(bag: Bag) -> tuple[list[str], dict[tuple[str, str], list[str]]]:
    """Its lines, and sections by topic and field."""
    arrivals: dict[str, list[int]] = {topic: [] for topic in bag.topics}
    first: dict[str, Any] = {}
    for connection, received, raw in bag.raw_messages(bag.topics):
        arrivals[connection.topic].append(received)
        if connection.topic not in first and not bag.undefined(connection.msgtype):
            first[connection.topic] = bag.content(connection, raw)
    lines: list[str] = [f"# {bag.name}"]
    sections: dict[tuple[str, str], list[str]] = {}
    for topic in bag.topics:
        types, count = bag.types(topic), len(arrivals[topic])
        rate = _median_rate(arrivals[topic])
        lines += ["#", f"# {topic}  {' and '.join(types)}  {count} message{'' if count == 1 else 's'}{rate}"]
        missing = [missing for type_name in types for missing in bag.undefined(type_name)]
        if missing:
            lines.append(f'#     nobody defines {missing[0]}: messages = ["PACKAGE/msg/NAME.msg"] in the mapping does')
        elif len(types) == 1:
            fields = list(numeric_fields(bag.store, types[0], first.get(topic)))
            lines += _wrapped(fields)
            sections |= _section(topic, fields, has_stamp(bag.store, types[0]))
    return lines, sections


def _median_rate(arrivals: list[int]) -> str:
    gaps = np.diff(np.sort(np.array(arrivals, dtype=np.int64)))
    middle = float(np.median(gaps)) if len(gaps) else 0.0
    return f"  {1e9 / middle:.4g} Hz" if middle > 0 else ""


def _wrapped(fields: list[str]) -> Iterator[str]:
    text = ", ".join(field.replace(" ", "\0") for field in fields) or "no number"
    for line in textwrap.wrap(text, _WIDTH - 6, break_long_words=False, break_on_hyphens=False):
        yield f"#     {line}".replace("\0", " ")


def _section(topic: str, fields: list[str], stamped: bool) -> dict[tuple[str, str], list[str]]:
    """What is said of a topic's first field that is not its time stamp, by topic and field; nothing without one."""
    said = [field for field in fields if "stamp." not in field and "[]" not in field and not field.startswith("header")]
    if not said:
        return {}
    field, _, reading = said[0].partition(" ")
    field = field.partition("…")[0].rstrip(".") + ("]" if "…" in field else "")
    lines = [f'# topic = "{topic}"', f'# field = "{field}"']
    if reading:
        lines.append('# as = "yaw"')
    if stamped:
        lines.append('# clock = "aligned"  # its header says when it was made; leave out for the time of arrival')
    return {(topic, field): lines}


def _skeleton(sections: dict[tuple[str, str], list[str]]) -> list[str]:
    lines = [
        "",
        "# A mapping to start from: take the sections that you need out of the comments and name their columns u.NAME",
        "# (a control), y.NAME (a measurement) or x.NAME (a state that is known).",
        "step = 0.1  # s between two rows",
    ]
    taken: list[str] = []
    for (topic, field), said in sections.items():
        name = re.sub(r"\W+", "_", f"{topic}_{field}").strip("_")
        again = taken.count(name)  # /a/b with c, and /a with b.c
        taken.append(name)
        lines += ["#", f'# [columns."y.{name}{f"_{again + 1}" if again else ""}"]', *said]
    return lines
