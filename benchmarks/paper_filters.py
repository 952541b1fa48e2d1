"""Whether the filter that looks ahead, by which `paper.py` judges, says the same as a bootstrap of 20,000 particles."""

from __future__ import annotations

from collections.abc import Iterator

from paper_records import EXPERIMENTS, GROUPS, METHODS, Record, Records, done

NATS, PART = 0.5, 0.05
MARK = "ᵇ"
TEXT = (
    "All runs are judged by the filter that looks ahead, and by a bootstrap of 20,000 particles too. Equal is within "
    f"{NATS:g} nats of log p(y) and {100 * PART:g} % of both state-estimation errors. Where one run of a method is not "
    f"equal, all its figures of state estimation and log p(y) are the bootstrap's, marked {MARK}."
)


def equal(record: Record) -> bool:
    """Within the tolerance; a NaN is not."""
    ours, theirs = record["state_estimation"], record["bootstrap"]["state_estimation"]
    near = abs(record["log_likelihood"] - record["bootstrap"]["log_likelihood"]) <= NATS
    return near and all(abs(ours[group] - theirs[group]) <= PART * theirs[group] for group in GROUPS)


def differing(records: Records) -> set[tuple[str, str]]:
    """Experiment and method of which a run was judged otherwise by the bootstrap."""
    return {_cell(record) for record in done(records) if "bootstrap" in record and not equal(record)}


def judged(records: Records) -> list[Record]:
    """The records that did not fail, with the bootstrap's figures where the filters are not equal."""
    apart = differing(records)
    return [
        {**record, **record["bootstrap"]} if _cell(record) in apart and "bootstrap" in record else record
        for record in done(records)
    ]


def filters(records: Records) -> Iterator[str]:
    """How many are equal, every one that is not, and every method that was not held against the bootstrap."""
    held = [record for record in done(records) if "bootstrap" in record]
    apart = sorted((record for record in held if not equal(record)), key=_run)
    yield f"{len(held) - len(apart)} of {len(held)} equal"
    for record in apart:
        yield f"NOT EQUAL {_run(record)}: {_said(record)}, by the bootstrap {_said(record['bootstrap'])}"
    for name in sorted(_run(record) for record in done(records) if "bootstrap" not in record):
        yield f"not held against the bootstrap: {name}"


def _cell(record: Record) -> tuple[str, str]:
    return record["experiment"], record["method"]


def _run(record: Record) -> str:
    return f"{EXPERIMENTS[record['experiment']]}, {METHODS[record['method']]}, run {record['seed']}"


def _said(record: Record) -> str:
    if "why_not" in record:
        return f"nothing ({record['why_not']})"
    errors = record["state_estimation"]
    return f"{record['log_likelihood']:.2f} nats, {errors['location']:.4f} m, {errors['angle']:.4f} rad"
