"""What `prove` found, as one sentence, as a plain dict and as tables of text."""

import itertools
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from steady_ppl.comparison.scores import (
    BANDED_HORIZONS,
    BY_PARTICLES,
    COVERAGE,
    MEASURED_BEFORE,
    RESAMPLES,
    Change,
    Key,
    ProgramScores,
    Sums,
    paired,
)
from steady_ppl.effects import attached
from steady_ppl.likelihood.outliers import Outliers
from steady_ppl.model.program import error_indices
from steady_ppl.utils.context import Displayed
from steady_ppl.utils.text import TEXT_WIDTH, aligned, figure, with_unit

NAME_COLUMNS = 20  # characters of a row's name
NOISE_FLOOR, CONSTANT_VELOCITY, LAST_MEASUREMENT = "noise floor", "constant velocity", "last measurement"
"""Rows that `prove` adds; a model has to beat the last two."""
BASELINE_ROWS = (NOISE_FLOOR, CONSTANT_VELOCITY, LAST_MEASUREMENT, "oracle", "truth")  # that show what is possible
MAX_PLAIN = 1e6  # nats or percent that are written without a power of ten
MAX_DOUBT = 2.0  # nats a drive by which particles may see a difference of log p(y) otherwise, surely
MIN_LOSS = 0.1  # share of a simple row's error, by which a program that is no model errs more at least
SIMPLE_ROWS = {  # what knows nothing of the vehicle: the errors to compare, and what it is in words
    CONSTANT_VELOCITY: ("measurement", "a vehicle that keeps its velocity"),
    LAST_MEASUREMENT: (MEASURED_BEFORE, "the last measurement"),
}
PHRASES_OF_SIGNS = {  # the signs of what log p(y) and the error gained
    (0, 0): ("is not shown to help", "is not shown to be better than"),
    (1, 1): ("helps", "is better than"),
    (-1, -1): ("makes it worse", "is worse than"),
    (1, -1): ("helps log p(y) and harms the predictions", "fits better and predicts worse than"),
    (-1, 1): ("harms log p(y) and helps the predictions", "fits worse and predicts better than"),
}


@dataclass(frozen=True, repr=False)
class Proof(Displayed):
    """What `prove` found.

    Attributes:
        rows: name → figures, in the order in which they were given, then the constant velocity and the noise floor.
        reference: the name of the row that the others are compared with.
        horizons: name → how many rows ahead, "one step" first.
        step: s, of a row.
        trajectories: how many trajectories.
        known_start: whether the true first states were given.
        seed: of the resampling.
        outliers: readings that every program finds wrong; nothing else is about them.
        notes: what was left out or is not as it seems.
    """

    rows: dict[str, ProgramScores]
    reference: str
    horizons: dict[str, int]
    step: float
    trajectories: int
    known_start: bool
    seed: int
    outliers: Outliers
    notes: list[str]

    @property
    def figures(self) -> dict[str, Any]:
        """Everything as a plain dict, ready for JSON; every figure is finite, None where there is none."""
        return {
            "verdict": verdict(self),
            "reference": self.reference,
            "trajectories": self.trajectories,
            "known_start": self.known_start,
            "resamples": RESAMPLES,
            "level": COVERAGE,
            "horizons": {name: rows * self.step for name, rows in self.horizons.items()},
            "units": units_of_states(self),
            "rows": [
                {"row": name, "program": type(row.program).__name__}
                | _by_key(self, {key: sums.value for key, sums in row.sums.items()})
                | {"neglected": float(row.neglected.mean()) if isinstance(row.neglected, Tensor) else None}
                | {"scales": row.scales, "against_reference": _against_reference(self, name)}
                for name, row in self.rows.items()
            ],
            "outliers": self.outliers.figures,
            "notes": self.notes,
        }

    def open_loop(self, name: str) -> dict[tuple[str, str], list[tuple[float, float]]]:
        """A row's open-loop errors by what they are of, as in `Key`: pairs of seconds ahead and root mean square."""
        curves: dict[tuple[str, str], list[tuple[float, float]]] = {}
        for key, sums in sorted(self.rows[name].sums.items(), key=lambda pair: pair[0].horizon):
            if key.kind in ("measurement", "state") and sums.value:
                curves.setdefault((key.kind, key.of), []).append((key.horizon * self.step, sums.value))
        return curves

    def __str__(self) -> str:
        content = self.figures
        rows, horizons = content["rows"], list(content["horizons"])
        far = horizons[1:] or horizons
        drives = f"{self.trajectories} trajectories; differences are from {self.reference}"
        said = f"{drives}, with {COVERAGE:.0%} intervals bootstrapped over trajectories"
        lines = [*textwrap.wrap(content["verdict"], TEXT_WIDTH), "", said, ""]
        bands = horizons[:BANDED_HORIZONS]
        shown = [name if i else f"in 90 % band, {name}" for i, name in enumerate(bands)]
        header = ["", "log p(y) [nats]", "difference [nats]", "by particles", *shown]
        lines += _table([header, *([row["row"], *_likelihood_cells(row, bands)] for row in rows)])
        lines += ["", "root mean square error of predictions ahead, and by how much it differs"]
        units_of = {("measurement", of): of for of in rows[0]["measurement"]}
        units_of |= {("state", of): unit for of, unit in content["units"].items()}
        for (kind, of), unit in units_of.items():
            title = of if kind == "state" else "measured"
            header = [with_unit(title, unit), *far, *(f"{name}, differs" for name in far)]
            cells = [[row["row"], *_errors(row, kind, of, far)] for row in rows if of in row[kind]]
            lines += [*_table([header, *cells]), ""] if cells else []
        lines += _scales([row for row in rows if row["row"] not in (NOISE_FLOOR, LAST_MEASUREMENT)])
        lines += self.outliers.lines(how="every model finds them so")
        for note in self.notes:
            lines += textwrap.wrap(f"note: {note}", TEXT_WIDTH)
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"Proof({verdict(self)!r})"


def units_of_states(found: Proof) -> dict[str, str]:
    """Error group of states → unit, empty where its components have several."""
    program = found.rows[found.reference].program
    of = {group: {program.state_units[i] for i in members} for group, members in error_indices(program).items()}
    return {group: kinds.pop() if len(kinds) == 1 else "" for group, kinds in of.items()}


def _against_reference(found: Proof, name: str) -> dict[str, Any] | None:
    if name in (found.reference, NOISE_FLOOR):
        return None
    return _by_key(found, {key: change and dict(vars(change)) for key, change in changes(found, name).items()})


def _by_key(found: Proof, values: Mapping[Key, Any]) -> dict[str, Any]:
    """Figures nested by kind, of what, and the horizon's name."""
    ahead = {rows: name for name, rows in found.horizons.items()}
    nested: dict[str, Any] = {"log_likelihood": None, "log_likelihood_by_particles": None}
    nested |= {"measurement": {}, "state": {}, "coverage_90": {}}
    for key, value in values.items():
        if not key.horizon:
            nested[key.kind] = value
        elif key.horizon in ahead and key.kind != MEASURED_BEFORE:
            place = nested[key.kind].setdefault(key.of, {}) if key.of or key.kind == "measurement" else nested[key.kind]
            place[ahead[key.horizon]] = value
    return nested


def changes(found: Proof, name: str) -> dict[Key, Change | None]:
    """A row's figures less the reference's, at the horizons that have names."""
    wanted = {0, *found.horizons.values()}
    keys = [key for key in found.rows[name].sums if key.horizon in wanted and key.kind != MEASURED_BEFORE]
    return _differences(found, name, found.reference, keys)


def _differences(found: Proof, name: str, other: str, keys: Iterable[Key]) -> dict[Key, Change | None]:
    """A row's figures less another's, of those that both have."""
    ours, theirs = found.rows[name].sums, found.rows[other].sums
    return {key: paired(ours[key], theirs[key], seed=found.seed) for key in keys if key in ours and key in theirs}


def verdict(found: Proof) -> str:
    """One sentence on the last row but the reference and, if there are others, those that show what is possible."""
    others = [name for name in found.rows if name != found.reference]
    name = next((name for name in reversed(others) if name not in BASELINE_ROWS), others[0])
    changed = changes(found, name)
    likely, how = _ruling(found, name, changed)
    horizon = _far(found)
    errors = {key.of: change for key, change in changed.items() if key[::2] == ("measurement", found.horizons[horizon])}
    parts = (
        [f"log p(y) {how}{with_interval(likely.difference, likely.interval, 1, ' nats a trajectory')}"]
        if likely
        else []
    )
    parts += [how] if how and not likely else []
    for of, change in errors.items():
        where = f" in {of}" if len(errors) > 1 and of else ""
        if differs := _differs(vars(change) if change else None):
            parts.append(f"{horizon.replace(' ', '-')} open-loop error{where} {differs}")
    gained = _sign([likely]), -_sign([*errors.values()])
    alone, between = PHRASES_OF_SIGNS[gained if gained in PHRASES_OF_SIGNS else (sum(gained), sum(gained))]
    added = _added(found.rows[found.reference], found.rows[name])
    said = f"Adding {added} {alone}" if added else f"{name} {between} {found.reference}"
    return f"{_no_models(found, name)}{said}: {', '.join(parts)}."


def _far(found: Proof) -> str:
    """The horizon of which the sentence speaks."""
    return list(found.horizons)[:BANDED_HORIZONS][-1]


def _ruling(found: Proof, name: str, changed: Mapping[Key, Change | None]) -> tuple[Change | None, str]:
    """The difference of log p(y) that counts, and what is said of it: particles', where they see it otherwise; none,
    where they do not follow both programs."""
    linear, by_particles = changed[Key("log_likelihood", "", 0)], changed.get(BY_PARTICLES)
    lost = [one for one in (found.reference, name) if isinstance(found.rows[one].neglected, str)]
    if lost:
        return None, f"no particle filter follows {' or '.join(lost)}, so that log p(y) says nothing"
    pair = [found.rows[one].sums for one in (name, found.reference)]
    if linear is None or not all(BY_PARTICLES in sums for sums in pair):
        return linear, ""
    if by_particles is None:
        return None, "by particles log p(y) is not finite"
    ours, theirs = (_neglected(sums) for sums in pair)
    apart = paired(ours, theirs, seed=found.seed)
    is_apart = apart is not None and (apart.interval[0] > MAX_DOUBT or apart.interval[1] < -MAX_DOUBT)
    if not is_apart and _sign([linear]) == _sign([by_particles]):
        return linear, ""
    return by_particles, f"by particles (linearised {linear.difference:+.1f}) ".replace("-", "−")


def _neglected(sums: Mapping[Key, Sums]) -> Sums:
    """What the linearised log p(y) of each drive leaves out."""
    by_particles, linear = sums[BY_PARTICLES], sums[Key("log_likelihood", "", 0)]
    return replace(linear, total=by_particles.total - linear.total)


def _no_models(found: Proof, name: str) -> str:
    """That programs predict worse than what knows nothing of the vehicle."""
    lost = {one: by for one in (found.reference, name) if (by := _lost_to(found, one))}
    if name not in lost:
        return ""
    horizon, words = lost[name]
    if found.reference not in lost:
        return f"{name} is not yet a model: {horizon} ahead it errs more than {words}. "
    neither = f"Neither {found.reference} nor {name} is yet a model"
    other, others = lost[found.reference]
    if (horizon, words) == (other, others):
        return f"{neither}: {horizon} ahead both err more than {words}. "
    return f"{neither}: {other} ahead the one errs more than {others}, {horizon} ahead the other more than {words}. "


def _lost_to(found: Proof, name: str) -> tuple[str, str] | None:
    """How far ahead, and to what that knows nothing of the vehicle, a program surely loses by a tenth; None where it
    surely wins at some time ahead or in some unit."""
    named = {rows: horizon for horizon, rows in list(found.horizons.items())[:BANDED_HORIZONS]}
    for simple, (kind, words) in SIMPLE_ROWS.items():
        if simple not in found.rows:
            continue
        keys = [key for key in found.rows[name].sums if key.kind == kind and key.horizon in named]
        errors = {key: change for key, change in _differences(found, name, simple, keys).items() if change}
        if any(change.interval[1] < 0 for change in errors.values()):
            continue
        lost = [key for key, change in errors.items() if change.interval[0] > 0 and (change.relative or 0.0) > MIN_LOSS]
        if lost:
            return named[max(key.horizon for key in lost)], words
    return None


def _sign(found: Sequence[Change | None]) -> int:
    signs = {int(change.interval[0] > 0) - int(change.interval[1] < 0) for change in found if change} - {0}
    return signs.pop() if len(signs) == 1 else 0


def _added(before: ProgramScores, after: ProgramScores) -> str:
    """The effects that the one has more, empty where that is not the whole difference."""
    ours, theirs = ({variant.name: variant for variant in attached(row.program)} for row in (after, before))
    if theirs.keys() - ours.keys():
        return ""
    return " and ".join(variant.label for name, variant in ours.items() if name not in theirs)


def with_interval(value: float, interval: Sequence[float], digits: int, unit: str = "") -> str:
    """A difference with its sign, and its interval; in powers of ten where a million is reached."""
    kind = f".{digits}f" if max(map(abs, (value, *interval))) < MAX_PLAIN else ".1e"
    low, high = (f"{end:{kind}}" for end in interval)
    return f"{value:+{kind}}{unit} [{low}, {high}]".replace("-", "−")


def _likelihood_cells(row: Mapping[str, Any], bands: Sequence[str]) -> list[str]:
    change = (row["against_reference"] or {}).get("log_likelihood")
    said = with_interval(change["difference"], change["interval"], 1) if change else ""
    cells = [figure(row["log_likelihood"], ".1f"), said, figure(row["neglected"], "+.2f")]
    cells += [figure(row["coverage_90"].get(name), ".1%") for name in bands]
    return [cell.replace("-", "−") for cell in cells]


def _errors(row: Mapping[str, Any], kind: str, of: str, horizons: Sequence[str]) -> list[str]:
    errors, against = row[kind][of], (row["against_reference"] or {}).get(kind, {}).get(of, {})
    return [figure(errors.get(name), ".3g") for name in horizons] + [_differs(against.get(name)) for name in horizons]


def _differs(change: Mapping[str, Any] | None) -> str:
    if change is None or change["relative"] is None:
        return ""
    return with_interval(100 * change["relative"], [100 * end for end in change["relative_interval"]], 0, " %")


def _scales(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Columns that say the same as the one before them, as those of like sensors do, are left out."""
    columns: dict[str, list[str]] = {}
    for kind in ("channels", "measurements"):
        before: list[str] | None = None
        for label in rows[0]["scales"][kind]:
            column = [figure(row["scales"][kind].get(label), ".4g") for row in rows]
            if column == before:
                last = list(columns)[-1]
                columns[last if "…" in last else last.replace(" ", " … ", 1)] = columns.pop(last)
            else:
                columns[label] = column
            before = column
    lines = [[row["row"], *(column[i] for column in columns.values())] for i, row in enumerate(rows)]
    return _table([["noise σ", *columns], *lines])


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Aligned rows, the header first; columns that find no room go into a second table below."""
    cut = [[name if len(name) <= NAME_COLUMNS else f"{name[: NAME_COLUMNS - 1]}…", *cells] for name, *cells in rows]
    ends = itertools.accumulate(2 + max(map(len, column)) for column in zip(*cut, strict=True))
    room = max(2, sum(end - 2 <= TEXT_WIDTH for end in ends))
    lines = aligned([row[:room] for row in cut])
    if room < len(cut[0]):
        lines += ["", *_table([[row[0], *row[room:]] for row in rows])]
    return lines
