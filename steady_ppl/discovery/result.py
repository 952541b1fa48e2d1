"""What `discover` found as a plain dict and as text."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from steady_ppl.comparison.result import Proof
from steady_ppl.discovery.candidates import Candidate
from steady_ppl.discovery.finding import Finding, Shape, gain_interval
from steady_ppl.discovery.next_run import NextRun
from steady_ppl.discovery.refits import Refit
from steady_ppl.discovery.screening import ALPHA, Tested
from steady_ppl.discovery.search import Search
from steady_ppl.runs.fit import Fit
from steady_ppl.utils.late import Displayed
from steady_ppl.utils.text import aligned


@dataclass(frozen=True, repr=False)
class Discovery(Displayed):
    """What `discover` found.

    Attributes:
        search: everything that was tested and fitted.
        findings: the effects that are missing, the one that brings most first; empty where none or a curve is.
        shape: the curve where no effect of the catalogue explains the drives.
        next_run: controls that would separate the first class of several members; None where there is none, or where
            no way of driving that was tried does.
        proof: the program before and after on the validation drives, by the fits to the training drives.
        before, after: the programs, fitted to all drives; equal where no effect was found by name.
        doubts: why no ranking is to be trusted, empty as a rule.
        notes: what was left out or is not as it seems.
    """

    search: Search
    findings: list[Finding]
    shape: Shape | None
    next_run: NextRun | None
    proof: Proof
    before: Fit
    after: Fit
    doubts: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def verdict(self) -> str:
        """none, dynamics, actuator, sensor, noise or other."""
        if self.findings:
            return self.findings[0].kind
        return "none" if self.search.rounds[0].quiet else "other"

    @property
    def p_value(self) -> float:
        """Family-wise: how often drives of the fitted program would look as wrong somewhere."""
        return self.search.rounds[0].screening.tests.p_value

    @property
    def figures(self) -> dict[str, Any]:
        """Everything as a plain dict, ready for JSON."""
        return figures(self)

    def __str__(self) -> str:
        return as_text(self)

    def __repr__(self) -> str:
        return f"Discovery({sentence(self)!r})"


WIDTH, SHOWN = 100, 12
IN_WORDS = {
    "none": "No effect is missing as far as these drives can tell",
    "dynamics": "The dynamics lack",
    "actuator": "The actuators lack",
    "sensor": "The sensor has",
    "noise": "The noise is not as declared:",
    "other": "Something is missing that is in no catalogue",
}


def figures(found: Discovery) -> dict[str, Any]:
    """Everything as a plain dict; every figure is finite, None where there is none."""
    first = found.findings[0] if found.findings else None
    rows = {row["row"]: row for row in found.proof.figures["rows"]}
    return {
        "verdict": found.verdict,
        "sentence": sentence(found),
        "p_value": found.p_value,
        "level": ALPHA,
        "effect": first.variant.name if first else None,
        "class": first.alike if first else [],
        "confidence": first.confidence if first else None,
        "complete": found.search.is_complete,
        "effects": [_finding(finding) for finding in found.findings],
        "candidates": [_candidate(found, tested) for tested in ranked(found)],
        "shape": vars(found.shape) if found.shape else None,
        "next_run": vars(found.next_run) if found.next_run else None,
        "before": _side(rows["before"]),
        "after": _side(rows["after"]),
        "rounds": [
            {
                "p_value": one.screening.tests.p_value,
                "added": one.chosen.variant.name if one.chosen else None,
            }
            for one in found.search.rounds
        ],
        "known_start": found.before.known_start,
        "step": found.search.step.figures,
        "step_with_found": found.search.with_found.figures if found.search.with_found else None,
        "doubts": found.doubts,
        "notes": found.notes,
    }


def ranked(found: Discovery) -> list[Tested]:
    """The first round's tests: what was found, then those that were fitted by what they gained, then the others."""
    tests = found.search.rounds[0].screening.tests.tested
    total = {c.variant.name: c.total for c in found.search.rounds[0].candidates}
    chosen = [finding.variant.name for finding in found.findings]

    def place(index: int) -> tuple[int, float, int]:
        name = tests[index].variant.name
        return chosen.index(name) if name in chosen else len(chosen), -total.get(name, -math.inf), index

    order = sorted(range(len(tests)), key=place)
    return [tests[i] for i in order]


def _candidate(found: Discovery, tested: Tested) -> dict[str, Any]:
    fitted = _fitted(found, tested)
    interval = gain_interval(fitted, found.before.seed) if fitted else None
    variant = tested.variant
    return {
        "effect": "curve" if tested.is_curve else variant.name,
        "kind": "other" if tested.is_curve else variant.effect.verdict,
        "statistic": tested.statistic,
        "p_value": tested.p_value,
        **_one_step(tested),
        "absent": _finite(variant.effect.null),
        "unit": variant.unit,
        "options": {name: _plain(value) for name, value in variant.profiled.items()},
        "detection_limit": _numbers(limit_of(found, tested)),
        "heldout_gain": _finite(fitted.total) if fitted else None,
        "heldout_gain_ci": list(interval) if interval else None,
        "note": _note(tested, fitted),
    }


def _fitted(found: Discovery, tested: Tested) -> Candidate | None:
    """Its fit: of what was found as it was last looked at, else of the first round."""
    if tested.is_curve:
        return next((c for c in found.search.curves if c.variant.at == tested.variant.at), None)
    every = [one.candidate for one in found.search.found] + found.search.rounds[0].candidates
    return next((c for c in every if c.variant.name == tested.variant.name), None)


def _one_step(tested: Tested) -> dict[str, Any]:
    """The coefficient by one scoring step and its standard deviation; of what has no scale where it is absent, the
    probe that told most."""
    null = tested.variant.effect.null
    if not math.isfinite(null):
        return {"coefficient": tested.column.probe, "sd": None}
    return {"coefficient": _numbers(tested.coefficient + null), "sd": _numbers(tested.sd)}


def limit_of(found: Discovery, tested: Tested) -> np.ndarray:
    """What could have been seen: by the last tests, of the program with what was found, where they have the effect."""
    name = tested.variant.name
    last = found.search.rounds[-1].screening.tests.tested
    return next(
        (t.detection_limit for t in last if t.variant.name == name and not t.untestable), tested.detection_limit
    )


def _note(tested: Tested, fitted: Candidate | None) -> str | None:
    if tested.untestable:
        return tested.untestable
    if tested.departure:
        return "the fitted noise against the declared"
    if fitted and isinstance(fitted.refit, str):
        return fitted.refit
    if fitted and fitted.against_its_sign:
        return "its sign is one that physics rules out: a symptom"
    if fitted and not fitted.is_judged:
        return "given up after half of the drives: its gain is extrapolated"
    if fitted and isinstance(fitted.refit, Refit) and not fitted.refit.converged:
        return "its fit has not converged"
    return None


def _finding(finding: Finding) -> dict[str, Any]:
    return {
        "effect": finding.variant.name,
        "kind": finding.kind,
        "class": finding.alike,
        "confidence": finding.confidence,
        "coefficient": finding.coefficient,
        "sd": finding.sd,
        "interval_90": [list(pair) for pair in finding.interval],
        "unit": finding.variant.unit,
        "options": {name: _plain(value) for name, value in finding.variant.profiled.items()},
        "equation": finding.variant.effect.equation,
        "text": finding.variant.effect.text,
        "heldout_gain": finding.gain,
    }


def _side(row: dict[str, Any]) -> dict[str, Any]:
    return {key: row[key] for key in ("log_likelihood", "measurement", "coverage_90", "scales")}


def sentence(found: Discovery) -> str:
    """The verdict in one sentence, after a first one on the time step where that is too coarse."""
    said = [found.search.step.sentence] if found.search.step.sentence else []
    if found.search.with_found is not None and found.search.with_found.sentence:
        said.append(f"with what was found below, {found.search.with_found.sentence}")
    if not said:
        return _verdict(found)
    first = "; ".join(said)
    return f"{first[0].upper()}{first[1:]}. All that follows is at that step. {_verdict(found)}"


def _verdict(found: Discovery) -> str:
    verdict, start = found.verdict, IN_WORDS[found.verdict]
    if verdict == "none":
        return f"{start} (p = {found.p_value:.2g}); the limits below say what could not have been seen."
    if found.shape is not None:
        shape = found.shape
        return f"{start} (p = {found.p_value:.2g}): {shape.channel} lacks a curve of {shape.variable}{_times(found)}."
    if not found.findings:
        return (
            f"{start} (p = {found.p_value:.2g}), and neither an effect nor a curve brings anything on held-out drives."
        )
    clauses: list[str] = []
    for kind in dict.fromkeys(finding.kind for finding in found.findings):
        said = [_said(finding, found.search.is_complete) for finding in found.findings if finding.kind == kind]
        words = IN_WORDS[kind] if not clauses else IN_WORDS[kind][0].lower() + IN_WORDS[kind][1:]
        clauses.append(f"{words} {' and '.join(said)}")
    if not found.search.is_complete:
        clauses.append("they do not explain all, so that an effect nobody has named may stand behind these names")
    return f"{'; '.join(clauses)} (p = {found.p_value:.2g})."


def _times(found: Discovery) -> str:
    return f" times {found.shape.times}" if found.shape and found.shape.times else ""


def _said(finding: Finding, is_complete: bool) -> str:
    """A finding with how sure it is, or what it brings where the probabilities leave out what else there may be."""
    said = f"{finding.variant.label} = {with_interval(finding)}"
    if len(finding.alike) > 1:
        said += f", which these drives cannot tell from {' or '.join(finding.alike[1:])}"
    if finding.confidence is None:
        return said
    if not is_complete:
        return f"{said} ({finding.gain:+.0f} nats held out)"
    sure = ">99 %" if finding.confidence > 0.99 else f"{100 * finding.confidence:.0f} %"
    return f"{said} (confidence {sure})"


def with_interval(finding: Finding) -> str:
    """A coefficient with its 90 % interval and unit."""
    unit = "" if finding.variant.unit in ("", "1") else f" {finding.variant.unit}"
    said = [
        f"{value:.3g} [{low:.3g}, {high:.3g}]"
        for value, (low, high) in zip(finding.coefficient, finding.interval, strict=True)
    ]
    return ", ".join(said) + unit


def as_text(found: Discovery) -> str:
    """The verdict, the equation, the candidates, and before and after."""
    doubts = [line for doubt in found.doubts for line in textwrap.wrap(f"warning: {doubt}", WIDTH)]
    lines = [*doubts, *textwrap.wrap(sentence(found), WIDTH)]
    for finding in found.findings:
        lines += ["", f"{finding.variant.name}: {finding.variant.effect.text}", f"  {finding.variant.effect.feels}"]
    if found.shape:
        lines += [
            "",
            f"{found.shape.variable} [{found.shape.variable_unit}]  {found.shape.channel} [{found.shape.unit}]",
        ]
        rows = zip(found.shape.points, found.shape.curve, found.shape.band, strict=True)
        lines += [f"{point:10.3g}  {height:10.3g} ± {band:.2g}" for point, height, band in rows]
    lines += ["", *_table(found)]
    if found.next_run:
        lines += ["", *textwrap.wrap(_next(found), WIDTH)]
    if found.verdict != "none":
        lines += ["", "On the validation drives:", str(found.proof)]
    said = set(found.proof.notes) if found.verdict != "none" else set()
    notes = [line for note in found.notes if note not in said for line in textwrap.wrap(f"note: {note}", WIDTH)]
    return "\n".join([*lines, *notes])


def _next(found: Discovery) -> str:
    run = found.next_run
    assert run is not None
    return (
        f"To tell {' from '.join(run.between[:2])}, drive {run.way}: {run.separation:.1f} nats a drive, "
        f"against {run.usual:.1f} of drives such as these."
    )


def _table(found: Discovery) -> list[str]:
    header = ["candidate", "kind", "test", "p", "held-out gain", "one step", "± sd", "limit", "unit"]
    rows = [header, *(_line(found, tested) for tested in ranked(found)[:SHOWN])]
    rest = ranked(found)[SHOWN:]
    more = _limits(found, rest) if found.verdict == "none" else [f"and {len(rest)} more"] * bool(rest)
    return aligned(rows, left=(0, 1, len(header) - 1)) + more


def _limits(found: Discovery, tested: Sequence[Tested]) -> list[str]:
    """What could not have been seen of those that are not in the table, and what could not be tested at all."""
    below, never = list[str](), list[str]()
    for one in tested:
        limit = _short(_numbers(limit_of(found, one)))
        if one.untestable:
            never.append(f"{one.variant.name} ({one.untestable})")
        elif not one.is_curve:
            unit = "" if one.variant.unit == "1" or limit == "–" else " " + one.variant.unit
            below.append(f"{one.variant.name} {'of no limit' if limit == '–' else limit}{unit}")
    said = [("and below their limits", below), ("not testable", never)]
    return [line for text, names in said if names for line in textwrap.wrap(f"{text}: {'; '.join(names)}", WIDTH)]


def _line(found: Discovery, tested: Tested) -> list[str]:
    one = _candidate(found, tested)
    name = f"curve {tested.variant.at}" if tested.is_curve else tested.variant.name
    gain = "" if one["heldout_gain"] is None else f"{one['heldout_gain']:+.1f}"
    statistic, p_value = ("–", "–") if tested.untestable else (f"{one['statistic']:.1f}", f"{one['p_value']:.1g}")
    if tested.is_curve:
        return [name, one["kind"], statistic, p_value, gain, "", "", "", ""]
    numbers = [_short(one[key]) for key in ("coefficient", "sd", "detection_limit")]
    return [name, one["kind"], statistic, p_value, gain, *numbers, one["unit"]]


def _short(value: Any) -> str:
    if value is None:
        return "–"
    return ", ".join(f"{v:.2g}" for v in value) if isinstance(value, list) else f"{value:.3g}"


def _numbers(values: np.ndarray) -> float | list[float] | None:
    if not np.isfinite(values).all():
        return None
    found = [float(value) for value in values]
    return found[0] if len(found) == 1 else found


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
