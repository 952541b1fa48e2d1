"""What `discover` found as a plain dict, in its file and as text."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from steady_ppl.comparison.result import Proof
from steady_ppl.discovery.candidates import Candidate
from steady_ppl.discovery.finding import Finding, NextRun, Shape, gain_interval
from steady_ppl.discovery.screening import FAMILY_LEVEL, Tested
from steady_ppl.discovery.search_state import Search
from steady_ppl.errors import RunError
from steady_ppl.runs.fit import Fit
from steady_ppl.runs.folder import DISCOVERY
from steady_ppl.utils.context import Displayed
from steady_ppl.utils.files import read_json
from steady_ppl.utils.schema import BOOL, LINES, NUMBER, TEXT, Paired, count, mismatch
from steady_ppl.utils.text import TEXT_WIDTH, aligned, figure

CANDIDATES_SHOWN = 12  # candidates in the table
VERDICT_PHRASES = {
    "none": "No effect is missing as far as these trajectories can tell",
    "dynamics": "The dynamics lack",
    "actuator": "The actuators lack",
    "sensor": "The sensor has",
    "noise": "The noise is not as declared:",
    "other": "Something is missing that is in no catalogue",
    "undecided": "Something is missing",
}
WRONG_NOISE = "These trajectories contradict the declared noise:"
PAIR_FORM, NUMBERS_FORM = [NUMBER, NUMBER], (NUMBER, [(NUMBER, None)], None)
CANDIDATE_FORM = {
    **dict.fromkeys(("effect", "kind", "unit"), TEXT),
    **dict.fromkeys(("p_value", "absent", "heldout_gain"), (NUMBER, None)),
    **dict.fromkeys(("coefficient", "sd", "detection_limit"), NUMBERS_FORM),
    "heldout_gain_ci": (PAIR_FORM, None),
    "note": (TEXT, None),
}
EFFECT_FORM = {
    **dict.fromkeys(("effect", "text", "unit"), TEXT),
    **dict.fromkeys(("confidence", "heldout_gain"), (NUMBER, None)),
    "class": LINES,
    "coefficient": [NUMBER],
    "interval_90": [PAIR_FORM],
    "correction?": BOOL,
}
SHAPE_FORM = {"channel": TEXT, "variable": TEXT, "points": [NUMBER], "curve": [NUMBER], "band": [NUMBER]}
DISCOVERY_FORM = {
    "source?": TEXT,
    "sentence": TEXT,
    **dict.fromkeys(("complete?", "interrupted?"), BOOL),
    "candidates": [Paired(CANDIDATE_FORM, ("coefficient", "sd"))],
    "effects": [Paired(EFFECT_FORM, ("coefficient", "interval_90"))],
    "shape": (Paired(SHAPE_FORM, ("points", "curve", "band")), None),
    "doubts": LINES,
    "notes": LINES,
    "next_run": ({"between": LINES, "way": TEXT, "separation": NUMBER, "usual": NUMBER}, None),
}


@dataclass(frozen=True, repr=False)
class Discovery(Displayed):
    """What `discover` found.

    Attributes:
        search: everything that was tested and fitted.
        findings: the effects that are missing, the one that brings most first, and then what the noise is where
            that was declared otherwise; of effects none where none or a curve is missing.
        shape: the curve where no effect of the catalogue explains the trajectories.
        next_run: controls that would separate the first class of several members; None where there is none, or where
            no way of driving that was tried does.
        proof: the program before and after on the validation trajectories, by the fits to the training trajectories;
            None where the search was interrupted, or where a note says why there is none.
        before, after: the programs, fitted to all trajectories; they differ by what was found and by corrected noise.
        doubts: why no ranking is to be trusted, empty as a rule.
        notes: what was left out or is not as it seems.
    """

    search: Search
    findings: list[Finding]
    shape: Shape | None
    next_run: NextRun | None
    proof: Proof | None
    before: Fit
    after: Fit
    doubts: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def verdict(self) -> str:
        """none, dynamics, actuator, sensor, noise or other: of what is missing, if only noise is wrong noise; undecided
        where an interrupt came before a choice."""
        search = self.search
        if self.shape or (not search.rounds[0].nothing_found and not search.found and not search.departed):
            return "undecided" if search.cut_short and self.shape is None else "other"
        return self.findings[0].kind if self.findings else "none"

    @property
    def p_value(self) -> float:
        """Family-wise: how often trajectories of the fitted program would look as wrong somewhere."""
        return self.search.rounds[0].screening.tests.p_value

    @property
    def figures(self) -> dict[str, Any]:
        """Everything as a plain dict, ready for JSON; every figure is finite, None where there is none."""
        first = self.findings[0] if self.findings and self.verdict != "other" else None
        kept = ("log_likelihood", "measurement", "coverage_90", "scales")
        rows = self.proof.figures["rows"] if self.proof else []
        sides = {row["row"]: {key: row[key] for key in kept} for row in rows}
        return {
            "verdict": self.verdict,
            "sentence": " ".join(sentences(self)),
            "p_value": self.p_value,
            "level": FAMILY_LEVEL,
            "effect": first.variant.name if first else None,
            "class": first.aliases if first else [],
            "confidence": first.confidence if first else None,
            "complete": self.search.is_complete,
            "interrupted": bool(self.search.interrupted),
            "effects": [_finding(finding) for finding in self.findings],
            "candidates": [_candidate(self, tested) for tested in ranked(self)],
            "shape": vars(self.shape) if self.shape else None,
            "next_run": vars(self.next_run) if self.next_run else None,
            "before": sides.get("before"),
            "after": sides.get("after"),
            "rounds": [
                {"p_value": one.screening.tests.p_value, "added": one.chosen.variant.name if one.chosen else None}
                for one in self.search.rounds
            ],
            "outliers": [
                {"drives": name, **one}
                for name, found in zip(("training", "validation"), self.search.outliers, strict=False)
                for one in found.figures
            ],
            "known_start": self.before.known_start,
            "step": self.search.step.figures,
            "step_with_found": self.search.with_found.figures if self.search.with_found else None,
            "doubts": self.doubts,
            "notes": self.notes,
        }

    def __str__(self) -> str:
        said = [*(f"warning: {doubt}" for doubt in self.doubts), *sentences(self)]
        lines = [line for paragraph in said for line in textwrap.wrap(paragraph, TEXT_WIDTH)]
        for finding in self.findings:
            lines += ["", f"{finding.variant.name}: {finding.variant.effect.text}", f"  {finding.variant.effect.feels}"]
        if shape := self.shape:
            lines += ["", f"{shape.variable} [{shape.variable_unit}]  {shape.channel} [{shape.unit}]"]
            rows = zip(shape.points, shape.curve, shape.band, strict=True)
            lines += [f"{point:10.3g}  {height:10.3g} ± {band:.2g}" for point, height, band in rows]
        wrong = zip(("training", "validation"), self.search.outliers, strict=False)
        lines += [line for name, found in wrong if found.found for line in ("", *found.lines(name))]
        lines += ["", *_table(self)]
        if run := self.next_run:
            asked = f"To tell {' from '.join(run.between[:2])}, drive {run.way}: {run.separation:.1f} nats a trajectory"
            lines += ["", *textwrap.wrap(f"{asked}, against {run.usual:.1f} of ones such as these.", TEXT_WIDTH)]
        notes = self.notes
        if self.proof is not None and self.verdict != "none":
            lines += ["", "On the validation trajectories:", str(self.proof)]
            known = self.proof.notes
            notes = [note for note in notes if note not in known]
        return "\n".join(lines + [line for note in notes for line in textwrap.wrap(f"note: {note}", TEXT_WIDTH)])

    def __repr__(self) -> str:
        return f"Discovery({' '.join(sentences(self))!r})"


def read_discovery(source: Path) -> dict[str, Any] | None:
    """What `discover` said when it made this run, or in this file; None where there is nothing. RunError: the file is
    damaged."""
    file = source / DISCOVERY if source.is_dir() else source
    if not file.is_file():
        return None
    found = read_json(file, RunError)
    if problem := mismatch(found, DISCOVERY_FORM) or _inconsistency(found):
        raise RunError(f"{file} is not what `steady discover` writes: {problem}")
    return found


def _inconsistency(found: Mapping[str, Any]) -> str | None:
    """A candidate that was chosen and has another number of coefficients alone than together with the others."""
    chosen = {one["effect"]: len(one["coefficient"]) for one in found["effects"]}
    for i, one in enumerate(found["candidates"]):
        known = chosen.get(one["effect"])
        if known is not None and one["sd"] is not None and count(one["coefficient"]) != known:
            return f"candidates[{i}].coefficient has length {count(one['coefficient'])}, expected {known} as in effects"
    return None


def ranked(found: Discovery) -> list[Tested]:
    """The first round's tests: what was found, then those that were fitted by what they gained, then the others."""
    total = {c.variant.name: c.total for c in found.search.rounds[0].candidates}
    chosen = [finding.variant.name for finding in found.findings]

    def place(tested: Tested) -> tuple[int, float]:
        name = tested.variant.name
        return chosen.index(name) if name in chosen else len(chosen), -total.get(name, -math.inf)

    return sorted(found.search.rounds[0].screening.tests.tested, key=place)


def _candidate(found: Discovery, tested: Tested) -> dict[str, Any]:
    fitted, variant, null = _fitted(found, tested), tested.variant, tested.variant.effect.null
    interval = gain_interval(fitted, found.before.seed) if fitted else None
    scaled = math.isfinite(null)  # what has no scale where it is absent has the probe that told most
    return {
        "effect": "curve" if tested.is_curve else variant.name,
        "kind": "other" if tested.is_curve else variant.effect.verdict,
        "statistic": tested.statistic,
        "p_value": tested.p_value,
        "coefficient": _numbers(tested.coefficient + null) if scaled else tested.column.probe,
        "sd": _numbers(tested.sd) if scaled else None,
        "absent": null if scaled else None,
        "unit": variant.unit,
        "options": variant.profiled,
        "detection_limit": _numbers(limit_of(found, tested)),
        "heldout_gain": fitted.total if fitted and math.isfinite(fitted.total) else None,
        "heldout_gain_ci": list(interval) if interval else None,
        "note": _note(tested, fitted),
    }


def _fitted(found: Discovery, tested: Tested) -> Candidate | None:
    """Its fit: of what was found as it was last looked at, else of the first round."""
    if tested.is_curve:
        return next((c for c in found.search.curves if c.variant.at == tested.variant.at), None)
    every = [one.candidate for one in found.search.found] + found.search.rounds[0].candidates
    return next((c for c in every if c.variant.name == tested.variant.name), None)


def limit_of(found: Discovery, tested: Tested) -> np.ndarray:
    """What could have been seen: by the last tests, of the program with what was found, where they have the effect."""
    name, last = tested.variant.name, found.search.rounds[-1].screening.tests.tested
    limits = [one.detection_limit for one in last if one.variant.name == name and not one.untestable]
    return limits[0] if limits else tested.detection_limit


def _note(tested: Tested, fitted: Candidate | None) -> str | None:
    if tested.untestable:
        return tested.untestable
    if tested.departure:
        return "the fitted noise against the declared"
    if fitted is None:
        return None
    if isinstance(fitted.refit, str):
        return fitted.refit
    if fitted.against_its_sign:
        return "its sign is one that physics rules out: a symptom"
    if not fitted.is_judged:
        return "given up after half of the trajectories: its gain is extrapolated"
    return None if fitted.refit.converged else "its fit has not converged"


def _finding(finding: Finding) -> dict[str, Any]:
    return {
        "effect": finding.variant.name,
        "kind": finding.kind,
        "class": finding.aliases,
        "confidence": finding.confidence,
        "coefficient": finding.coefficient,
        "sd": finding.sd,
        "interval_90": [list(pair) for pair in finding.interval],
        "unit": finding.variant.unit,
        "options": finding.variant.profiled,
        "equation": finding.variant.effect.equation,
        "text": finding.variant.effect.text,
        "heldout_gain": finding.gain,
        "correction": finding.is_correction,
    }


def sentences(found: Discovery) -> list[str]:
    """The verdict in a sentence, after one on the time step where that is too coarse and one on noise that is wrong."""
    step, with_found = found.search.step.sentence, found.search.with_found
    later = f"with what was found below, {with_found.sentence}" if with_found and with_found.sentence else ""
    first = "; ".join(filter(None, (step, later)))
    said = [f"{first[0].upper()}{first[1:]}. All that follows is at that step."] if first else []
    effects = [finding for finding in found.findings if not finding.is_correction]
    if sizes := [_said(finding, True) for finding in found.findings if finding.is_correction]:
        noise = f"{VERDICT_PHRASES['noise']} {' and '.join(sizes)}"
        if not effects and found.verdict == "noise" and not found.search.rounds[0].nothing_found:
            return [*said, f"{noise} {_p_value(found)}."]
        said.append(f"{WRONG_NOISE} {' and '.join(sizes)}. What is found is fitted with the noise that they show.")
    return [*said, _verdict(found, effects)]


def _p_value(found: Discovery) -> str:
    return f"(p = {found.p_value:.2g})"


def _verdict(found: Discovery, effects: Sequence[Finding]) -> str:
    missing, p_value, shape = VERDICT_PHRASES["other"], _p_value(found), found.shape
    if found.search.rounds[0].nothing_found:
        return f"{VERDICT_PHRASES['none']} {p_value}; the limits below say what could not have been seen."
    if shape is not None:
        times = f" times {shape.times}" if shape.times else ""
        return f"{missing} {p_value}: {shape.channel} lacks a curve of {shape.variable}{times}."
    if found.verdict == "undecided":
        undecided = VERDICT_PHRASES["undecided"]
        return f"{undecided} {p_value}; the search was interrupted before an effect was chosen."
    if not effects:
        return f"{missing} {p_value}, and neither an effect nor a curve brings anything on held-out trajectories."
    clauses: list[str] = []
    for kind in dict.fromkeys(finding.kind for finding in effects):
        said = [_said(finding, found.search.is_complete) for finding in effects if finding.kind == kind]
        words = VERDICT_PHRASES[kind] if not clauses else VERDICT_PHRASES[kind][0].lower() + VERDICT_PHRASES[kind][1:]
        clauses.append(f"{words} {' and '.join(said)}")
    if found.search.cut_short:
        clauses.append("the search was interrupted, so that there may be more")
    elif not found.search.is_complete:
        clauses.append("they do not explain all, so that an effect nobody has named may stand behind these names")
    return f"{'; '.join(clauses)} {p_value}."


def _said(finding: Finding, is_complete: bool) -> str:
    """A finding with how sure it is, or what it brings where the probabilities leave out what else there may be."""
    unit = "" if finding.variant.unit in ("", "1") else f" {finding.variant.unit}"
    pairs = zip(finding.coefficient, finding.interval, strict=True)
    numbers = ", ".join(f"{value:.3g} [{low:.3g}, {high:.3g}]" for value, (low, high) in pairs)
    said = f"{finding.variant.label} = {numbers}{unit}"
    if len(finding.aliases) > 1:
        said += f", which these trajectories cannot tell from {' or '.join(finding.aliases[1:])}"
    if finding.confidence is None:
        return said
    if not is_complete:
        return f"{said} ({finding.gain:+.0f} nats held out)"
    sure = ">99 %" if finding.confidence > 0.99 else f"{100 * finding.confidence:.0f} %"
    return f"{said} (confidence {sure})"


def _table(found: Discovery) -> list[str]:
    header = ["candidate", "kind", "test", "p", "held-out gain", "one step", "± sd", "limit", "unit"]
    tests = ranked(found)
    rows, rest = [header, *(_line(found, tested) for tested in tests[:CANDIDATES_SHOWN])], tests[CANDIDATES_SHOWN:]
    more = _limits(found, rest) if found.search.rounds[0].nothing_found else [f"and {len(rest)} more"] * bool(rest)
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
    return [line for text, names in said if names for line in textwrap.wrap(f"{text}: {'; '.join(names)}", TEXT_WIDTH)]


def _line(found: Discovery, tested: Tested) -> list[str]:
    one = _candidate(found, tested)
    gain = "" if one["heldout_gain"] is None else f"{one['heldout_gain']:+.1f}"
    statistic, p_value = ("–", "–") if tested.untestable else (f"{one['statistic']:.1f}", f"{one['p_value']:.1g}")
    test = [one["kind"], statistic, p_value, gain]
    if tested.is_curve:
        return [f"curve {tested.variant.at}", *test, "", "", "", ""]
    return [one["effect"], *test, *(_short(one[key]) for key in ("coefficient", "sd", "detection_limit")), one["unit"]]


def _short(value: float | list[float] | None) -> str:
    return ", ".join(f"{v:.2g}" for v in value) if isinstance(value, list) else figure(value, ".3g")


def _numbers(values: np.ndarray) -> float | list[float] | None:
    if not np.isfinite(values).all():
        return None
    return float(values[0]) if len(values) == 1 else values.tolist()
