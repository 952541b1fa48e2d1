"""Whether the filter that looks ahead, by which `paper.py` judges, says the same as a bootstrap of 20,000 particles."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from paper_records import EXPERIMENTS, METHODS, Records, done

NATS, PART = 0.5, 0.05
GROUPS = ("location", "angle")
TEXT = (
    "All runs are judged by the filter that looks ahead, the first of each method by a bootstrap of 20,000 particles "
    f"too. Equal is within {NATS:g} nats of log p(y) and {100 * PART:g} % of both state-estimation errors. No standard "
    "error is stored; over three repeats the bootstrap has an sd of .43 nats and 2.2 % with Hand on Truck, and of .004 "
    "nats and .2 % with the true program on Hov. Where they are not equal, a must has to hold by the bootstrap's "
    "figures as well."
)


def equal(record: Mapping[str, Any]) -> bool:
    """Within the tolerance; a NaN is not."""
    ours, theirs = record["state_estimation"], record["bootstrap"]["state_estimation"]
    near = abs(record["log_likelihood"] - record["bootstrap"]["log_likelihood"]) <= NATS
    return near and all(abs(ours[group] - theirs[group]) <= PART * theirs[group] for group in GROUPS)


def by_bootstrap(records: Records) -> list[Mapping[str, Any]]:
    """The records with the bootstrap's figures where the filters are not equal."""
    kept = done(records)
    return [
        record if "bootstrap" not in record or equal(record) else {**record, **record["bootstrap"]} for record in kept
    ]


def filters(records: Records) -> Iterator[str]:
    """How many are equal, every one that is not, and every method that was not held against the bootstrap."""
    held = [record for record in done(records) if "bootstrap" in record]
    apart = [record for record in held if not equal(record)]
    yield f"{len(held) - len(apart)} of {len(held)} equal"
    for record in apart:
        yield f"NOT EQUAL {_name(record)}: {_said(record)}, by the bootstrap {_said(record['bootstrap'])}"
    for name in sorted({_name(record) for record in done(records)} - {_name(record) for record in held}):
        yield f"not held against the bootstrap: {name}"


def _name(record: Mapping[str, Any]) -> str:
    return f"{EXPERIMENTS[record['experiment']]}, {METHODS[record['method']]}"


def _said(record: Mapping[str, Any]) -> str:
    errors = record["state_estimation"]
    return f"{record['log_likelihood']:.2f} nats, {errors['location']:.4f} m, {errors['angle']:.4f} rad"
