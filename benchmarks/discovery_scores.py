"""What the records of the discovery benchmark amount to."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from discovery_limits import alike
from discovery_sets import UNMISTAKABLE, multiple_of_limit, owner
from scipy import stats

from steady_ppl.effects import find, parsed

Record = dict[str, Any]
CLEARLY = 2.0  # detection limits from which an effect has to be found


def planted(record: Record) -> list[str]:
    """Names of the effects that the drives have, as variants are called."""
    return [":".join(part for part in parsed(text)[:2] if part) for text in record["effects"]]


def kind_of(name: str) -> str:
    """Dynamics, actuator, sensor or noise."""
    return find(name.partition(":")[0], owner()).verdict


def clearly(record: Record, least: float = CLEARLY) -> bool:
    """Whether all effects of a set are at least so many detection limits large."""
    return all(multiple_of_limit(text) >= least for text in record["effects"])


def in_class(record: Record) -> bool:
    """Whether the effect (of two, either) is in the class of the first finding."""
    return any(name in record["class"] for name in planted(record))


def interval(count: int, total: int) -> str:
    """A share with its exact 95 % interval (Clopper and Pearson 1934)."""
    if not total:
        return "–"
    low = stats.beta.ppf(0.025, count, total - count + 1) if count else 0.0
    high = stats.beta.ppf(0.975, count + 1, total - count) if count < total else 1.0
    return f"{count / total:.1%} [{low:.1%}, {high:.1%}] of {total}"


def share(records: Sequence[Record], true: Callable[[Record], bool]) -> str:
    """Of records for which something holds."""
    return interval(sum(map(true, records)), len(records))


def attained(record: Record) -> float | None:
    """The share of the oracle's improvement of the 3-s open loop; None where even the oracle improves nothing."""
    errors = record["errors"]
    before, after, oracle = (errors[row]["open_loop_3s"] for row in ("before", "after", "oracle"))
    if None in (before, after, oracle) or before - oracle < 0.01 * before:
        return None
    return (before - after) / (before - oracle)


def covered(records: Iterable[Record]) -> list[bool]:
    """Whether the 90 % interval of the right effect's coefficient holds each of its numbers."""
    found = []
    for record in records:
        for text, name in zip(record["effects"], planted(record), strict=True):
            values = parsed(text)[3] or ()
            for one in record["found"]:
                if one["effect"] == name and len(values) == len(one["interval_90"]):
                    found += [low <= v <= high for v, (low, high) in zip(values, one["interval_90"], strict=True)]
    return found


def uniformity(records: Sequence[Record]) -> str:
    """How far the p-values of clean sets are from uniform (Kolmogorov–Smirnov)."""
    if not records:
        return "–"
    test = stats.kstest([record["p_value"] for record in records], "uniform")
    return f"{test.statistic:.3f}, {test.pvalue:.2f} of {len(records)}"


def answered(record: Record) -> bool:
    """Whether the class has the truth or, where that was taken out of the catalogue, a close relative of it that
    attains nearly all of the oracle's improvement."""
    if record["stratum"] != "withheld":
        return in_class(record)
    return _nearly_all(record) and any(alike(planted(record)[0], name) >= UNMISTAKABLE for name in record["class"])


def calibration_error(records: Sequence[Record], right: Callable[[Record], bool] = in_class) -> float:
    """Expected calibration error of the stated confidence over five bins of equal size (Naeini et al. 2015)."""
    said = np.array([record["confidence"] for record in records])
    true = np.array([right(record) for record in records], dtype=float)
    parts = np.array_split(np.argsort(said), 5)
    return float(sum(len(p) * abs(said[p].mean() - true[p].mean()) for p in parts if len(p)) / max(1, len(said)))


def _calibration(records: Sequence[Record], right: Callable[[Record], bool] = in_class) -> str:
    return f"{calibration_error(records, right):.3f} of {len(records)}" if records else "–"


def scores_table(records: Sequence[Record]) -> str:
    """All scores as a table in Markdown."""
    failed = [record for record in records if "failed" in record]
    records = [record for record in records if "failed" not in record]
    of = {
        name: [r for r in records if r["stratum"] == name] for name in ("clean", "single", "large", "pair", "withheld")
    }
    single = [record for record in of["single"] if clearly(record)]
    weak = [record for record in of["single"] if not clearly(record)]
    one = single + of["large"]
    named = [r for r in records if r["class"] and r["confidence"] is not None]
    listed = [r for r in named if r["stratum"] != "withheld"]
    shares = [value for record in one if (value := attained(record)) is not None]
    sizes = [len(record["class"]) for record in single if record["class"]]
    pairs = [record for record in of["pair"] if clearly(record, 3)]
    alone = [r for r in of["withheld"] if r["set"].startswith("withheld-none")]
    aliased = [r for r in of["withheld"] if r["set"].startswith("withheld-alias")]
    cover = covered(of["single"] + of["large"] + of["pair"])
    seconds = [record["seconds"] for record in records]
    rows = [
        ("truth in the class, at ≥ 2 ×", share(single, in_class), "≥ 95 %"),
        ("mean size of the class", f"{np.mean(sizes):.2f}" if sizes else "–", "≤ 2.0"),
        ("truth first, at ≥ 2 ×", share(single, lambda r: r["class"][:1] == planted(r)), ""),
        ("truth among the first three, at ≥ 2 ×", share(single, _among_three), "≥ 97 %"),
        ("truth in the class, at 1–2 ×", share(weak, in_class), ""),
        ("large effects: truth in the class", share(of["large"], in_class), "≥ 95 %"),
        ("family-wise false alarms on clean data", share(of["clean"], lambda r: r["verdict"] != "none"), "5 % inside"),
        ("clean p-values: distance from uniform (Kolmogorov–Smirnov), its p", uniformity(of["clean"]), ""),
        ("kind, at ≥ 2 ×", share(single, lambda r: r["verdict"] == kind_of(planted(r)[0])), "≥ 93 %"),
        (
            "“other” where the effect, not of noise, is withheld and has no alias",
            share(alone, lambda r: r["verdict"] == "other"),
            "≥ 80 %",
        ),
        ("… with an alias: attains 90 % of the oracle's gain", share(aliased, _nearly_all), ""),
        (
            "share of the oracle's improvement, median, at ≥ 2 ×",
            f"{np.median(shares):.1%}" if shares else "–",
            "≥ 90 %",
        ),
        ("90 % interval covers the coefficient", interval(sum(cover), len(cover)), "85–95 %"),
        ("calibration error of the confidence", _calibration(named, answered), "≤ .07"),
        ("… where the truth is in the catalogue", _calibration(listed), ""),
        ("… if a withheld effect's close relative counts as wrong", _calibration(named), ""),
        ("pairs at ≥ 3 ×: both found", share(pairs, both_found), "≥ 80 %"),
        ("seconds a set, one core of two, mean ± sd", f"{np.mean(seconds):.1f} ± {np.std(seconds):.1f}", "≤ 60"),
        ("sets that took more than 60 s", f"{sum(s > 60 for s in seconds)}, at most {max(seconds):.0f} s", ""),
        ("warned that the program's own fit has not converged", _by_stratum(records, "converged"), ""),
        ("sets that failed", f"{len(failed)} of {len(records) + len(failed)}", "0"),
    ]
    lines = ["| | figure | must |", "|---|---|---|", *(f"| {a} | {b} | {c} |" for a, b, c in rows)]
    lines += [
        "",
        *by_effect(single + weak),
        "",
        f"Seeds: {seeds(records)}. Digest of the engine's source: {made_by(records)}.",
        "",
    ]
    return "\n".join([*lines, *(f"failed: {r['set']}: {r['failed']}" for r in failed), ""])


def _by_stratum(records: Sequence[Record], what: str) -> str:
    """How many records of each stratum do not have something."""
    without = [record["stratum"] for record in records if not record[what]]
    named = ", ".join(f"{stratum} {without.count(stratum)}" for stratum in dict.fromkeys(without))
    return f"{len(without)} ({named})" if without else "0"


def made_by(records: Sequence[Record]) -> str:
    """Digests of the source that made the records; there is one."""
    return ", ".join(sorted({record["version"] for record in records})) or "–"


def seeds(records: Sequence[Record]) -> str:
    """Of every stratum, from the smallest to the largest: of tables s they are 10 s + 1, 2 and 3."""
    strata = dict.fromkeys(record["stratum"] for record in sorted(records, key=lambda r: r["seed"]))
    found = {name: [r["seed"] for r in records if r["stratum"] == name] for name in strata}
    return ", ".join(f"{name} {min(every)}–{max(every)} ({len(every)} sets)" for name, every in found.items())


def by_effect(records: Sequence[Record]) -> list[str]:
    """Truth in the class for each effect."""
    names = dict.fromkeys(planted(record)[0].partition(":")[0] for record in records)
    header = ["effect", "in the class at ≥ 2 ×", "at 1–2 ×", "90 % intervals that cover", "what it was taken for"]
    lines = [f"| {' | '.join(header)} |", "|---" * len(header) + "|"]
    for name in names:
        own = [record for record in records if planted(record)[0].partition(":")[0] == name]
        counts = []
        for large in (True, False):
            part = [record for record in own if clearly(record) == large]
            counts.append(f"{sum(map(in_class, part))} of {len(part)}")
        wrong = [record["class"][0] if record["class"] else record["verdict"] for record in own if not in_class(record)]
        cover = covered(own)
        lines.append(f"| {name} | {counts[0]} | {counts[1]} | {sum(cover)} of {len(cover)} | {', '.join(wrong)} |")
    return lines


def _among_three(record: Record) -> bool:
    ranked = list(dict.fromkeys([*record["class"], *record["ranking"]]))
    return planted(record)[0] in ranked[:3]


def _nearly_all(record: Record) -> bool:
    value = attained(record)
    return value is not None and value >= 0.9


def both_found(record: Record) -> bool:
    """Whether each of two effects is in the class of a finding of its own."""
    first, second = planted(record)
    classes = [set(one["class"]) for one in record["found"]]
    return any(
        first in one and second in other for i, one in enumerate(classes) for j, other in enumerate(classes) if i != j
    )


def rivals_table(records: Sequence[Record], rivals: Sequence[Record]) -> str:
    """How the rivals rank the effects of the same sets, and how often they see something on clean ones."""
    ours = {record["set"]: record for record in records if "failed" not in record}
    rivals = [record for record in rivals if "failed" not in record and record["set"] in ours]
    lines = [
        "| method | truth first, at ≥ 2 × | first three | sees something, at ≥ 2 × | alarms on clean sets | seconds |",
        "|---|---|---|---|---|---|",
    ]
    planted_sets = [r for r in rivals if r["effects"] and clearly(r)]
    clean = [r for r in rivals if not r["effects"]]
    names = sorted({name for record in rivals for name in record["rivals"]})
    own = [ours[r["set"]] for r in planted_sets]
    lines.append(
        f"| discover | {share(own, lambda r: r['class'][:1] == planted(r))} | {share(own, _among_three)} | "
        f"{share(own, lambda r: r['verdict'] != 'none')} | "
        f"{share([ours[r['set']] for r in clean], lambda r: r['verdict'] != 'none')} | "
        f"{np.mean([ours[r['set']]['seconds'] for r in rivals]) if rivals else math.nan:.1f} |"
    )
    for name in names:
        with_it = [r for r in planted_sets if name in r["rivals"]]
        empty = [r for r in clean if name in r["rivals"]]
        seconds = np.mean([r["rivals"][name]["seconds"] for r in with_it + empty])
        first = share(with_it, lambda r, name=name: r["rivals"][name]["first"][:1] == planted(r))
        three = share(with_it, lambda r, name=name: planted(r)[0] in r["rivals"][name]["first"])
        seen, alarms = (share(part, lambda r, name=name: r["rivals"][name]["detected"]) for part in (with_it, empty))
        lines.append(f"| {name} | {first} | {three} | {seen} | {alarms} | {seconds:.1f} |")
    lines += [
        "",
        "Seconds: means over the sets that a method saw. Brute force, smoothed residuals and the tests of innovations "
        "begin with the fitted program; that fit is in the time of `discover` and not in theirs.",
        f"Seeds: {seeds([ours[record['set']] for record in rivals])}. "
        f"Digest of the engine's source: {made_by(rivals)}.",
    ]
    return "\n".join([*lines, ""])
