"""What is in recordings, as text that is a mapping to start from."""

import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from steady_ppl.utils.text import counted

FIELD_LIST_COLUMNS = 110  # characters of a list of fields


@dataclass(frozen=True)
class Entry:
    """What is said of a topic."""

    topic: str
    about: str
    times: np.ndarray  # (messages,) int64 ns
    fields: Sequence[str] = ()  # `gains[0…2]`; with ` (as = "…")` behind those that are read so
    proposed: Sequence[str] = ()  # of them those that are no time stamps, of which the first has a section
    keys: Sequence[str] = ()  # further lines of that section
    remark: str = ""


def listing(recordings: Sequence[tuple[str, Sequence[Entry]]]) -> str:
    """Of each recording its topics with messages, median rate and numeric fields; then a mapping to start from, whose
    sections are comments. What several recordings have is proposed once."""
    lines, sections = list[str](), dict[tuple[str, str], list[str]]()
    for name, entries in recordings:
        lines.append(f"# {name}")
        for entry in entries:
            lines += _described(entry)
            sections |= _section(entry)
    lines += [
        "",
        "# A mapping to start from: take the sections that you need out of the comments and name their columns u.NAME",
        "# (a control), y.NAME (a measurement) or x.NAME (a state that is known).",
        "step = 0.1  # s between two rows",
    ]
    taken: list[str] = []
    for (topic, name), said in sections.items():
        column = re.sub(r"\W+", "_", f"{topic}_{name}").strip("_")
        again = taken.count(column)  # /a/b with c, and /a with b.c
        taken.append(column)
        lines += ["#", f'# [columns."y.{column}{f"_{again + 1}" if again else ""}"]', *said]
    return "\n".join(lines)


def _described(entry: Entry) -> list[str]:
    gaps = np.diff(np.sort(entry.times))
    middle = float(np.median(gaps)) if len(gaps) else 0.0
    rate = f"  {1e9 / middle:.4g} Hz" if middle > 0 else ""
    about = f"  {entry.about}" if entry.about else ""
    lines = ["#", f"# {entry.topic}{about}  {counted(len(entry.times), 'message')}{rate}"]
    if entry.remark:
        return [*lines, f"#     {entry.remark}"]
    text = ", ".join(field.replace(" ", "\0") for field in entry.fields)
    wrapped = textwrap.wrap(text, FIELD_LIST_COLUMNS, break_long_words=False, break_on_hyphens=False)
    return lines + [f"#     {line}".replace("\0", " ") for line in wrapped]


def _section(entry: Entry) -> dict[tuple[str, str], list[str]]:
    """What is said of a topic's first proposed field, by topic and field; nothing without one."""
    if not entry.proposed:
        return {}
    name, _, reading = entry.proposed[0].partition(" (")
    name = name.partition("…")[0].rstrip(".") + ("]" if "…" in name else "")
    lines = [f'topic = "{entry.topic}"', f'field = "{name}"', *([reading.rstrip(")")] if reading else []), *entry.keys]
    return {(entry.topic, name): [f"# {line}" for line in lines]}
