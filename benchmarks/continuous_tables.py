"""The tables of false alarms and of planted effects in continuous time, from their records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from continuous_groups import GROUPS
from resumable import Record
from scipy import stats


def exact_interval(count: int, total: int, level: float = 0.95) -> tuple[float, float]:
    """Return the exact interval of a share (Clopper and Pearson 1934)."""
    tail = (1 - level) / 2
    low = float(stats.beta.ppf(tail, count, total - count + 1)) if count else 0.0
    high = float(stats.beta.isf(tail, count + 1, total - count)) if count < total else 1.0
    return low, high


def share(true: Sequence[bool]) -> str:
    """Return a share with its exact 95 % interval, as text."""
    if not true:
        return "–"
    low, high = exact_interval(sum(true), len(true))
    return f"{sum(true)} of {len(true)}: {sum(true) / len(true):.1%} [{low:.1%}, {high:.1%}]"


def alarms_table(records: Sequence[Record]) -> list[str]:
    """Return the share of clean sets with a verdict other than "none", by group, in Markdown."""
    lines = ["| group | verdict not “none” | 5 % inside | named | substeps | p uniform (KS) | s a set |"]
    lines.append("|---|---|---|---|---|---|---|")
    by_group = {name: [one for one in records if one["group"] == name] for name in GROUPS}
    rows = [(name, own) for name, own in by_group.items() if own]
    whole = [one for one in records if not one["group"].startswith("rough")]
    hovercraft = [one for one in whole if one["group"].startswith("hovercraft")]
    together = [("hovercraft together", hovercraft), ("all", whole)]
    for name, own in [*rows, *(row for row in together if row[1])]:
        alarms = [one["verdict"] != "none" for one in own]
        low, high = exact_interval(sum(alarms), len(alarms))
        named = Counter(one["effect"] or one["verdict"] for one in own if one["verdict"] != "none")
        uniform = stats.kstest([one["p_value"] for one in own], "uniform").pvalue
        lines.append(
            f"| {name} | {share(alarms)} | {'yes' if low <= 0.05 <= high else 'no'} | {counted(named)} | "
            f"{counted(Counter(one['substeps'] for one in own))} | {uniform:.2g} | "
            f"{np.median([one['seconds'] for one in own]):.0f} |"
        )
    return lines


def counted(found: Counter[Any]) -> str:
    """Return what was counted as text, the most frequent first."""
    return ", ".join(f"{what} {count}" for what, count in found.most_common()) or "–"


def planted_table(records: Sequence[Record]) -> list[str]:
    """Return how often planted effects are found, by group and by effect, in Markdown."""
    lines = ["| planted | truth in the class | truth first | 90 % interval covers | alone | taken for | substeps |"]
    lines.append("|---|---|---|---|---|---|---|")
    effects = dict.fromkeys(one["planted"]["effect"] for one in records)
    rows = [("all", list(records))]
    rows += [(name, [one for one in records if one["group"] == name]) for name in GROUPS]
    rows += [(f"`{name}`", [one for one in records if one["planted"]["effect"] == name]) for name in effects]
    for name, own in rows:
        if own:
            wrong = Counter(one["effect"] or one["verdict"] for one in own if not in_class(one))
            shares = (share([true(one) for one in own]) for true in (in_class, is_first))
            lines.append(
                f"| {name} | {' | '.join(shares)} | {share([c for one in own for c in covers(one)])} | "
                f"{share([len(one['found']) == 1 for one in own if in_class(one)])} | {counted(wrong)} | "
                f"{counted(Counter(one['substeps'] for one in own))} |"
            )
    return lines


def in_class(record: Record) -> bool:
    """Return whether the planted effect is in the class of the first finding."""
    return record["planted"]["effect"] in record["class"]


def is_first(record: Record) -> bool:
    """Return whether the planted effect is what is named first."""
    return record["effect"] == record["planted"]["effect"]


def covers(record: Record) -> list[bool]:
    """Return whether the 90 % interval holds each number of the coefficient, where the effect is named."""
    values = record["planted"]["value"]
    intervals = [one["interval_90"] for one in record["found"] if one["effect"] == record["planted"]["effect"]]
    return [low <= value <= high for own in intervals for value, (low, high) in zip(values, own, strict=True)]


def tables(alarms: Sequence[Record], planted: Sequence[Record]) -> str:
    """Return both tables in Markdown."""
    lines = ["# `discover` in continuous time", ""]
    every = [*alarms, *planted]
    for title, table, records in (
        ("False alarms", alarms_table, alarms),
        ("Planted effects", planted_table, planted),
    ):
        whole = [one for one in records if "failed" not in one]
        if whole:
            lines += [f"## {title}", "", *table(whole), ""]
    versions = ", ".join(sorted({one["version"] for one in every})) or "–"
    lines += [
        "Worlds are integrated in steps of 1 ms; a set is 16 training and 16 validation drives. Intervals are exact at "
        "95 %. “Covers” counts the numbers of coefficients whose effect is named. “Alone”: of the sets with the truth "
        "in the class, those in which nothing else is named. A set's seed is the CRC-32 of its name, as recorded.",
        f"Digest of the source: {versions}.",
        *(f"Failed: {one['set']}: {one['failed']}" for one in every if "failed" in one),
    ]
    return "\n".join(lines) + "\n"
