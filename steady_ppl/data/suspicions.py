"""What may be wrong with a table's rows, times and cells, each by one look at all of them.

None of it is certain: a vehicle may have stood still, and a log may hold what looks like a code for "nothing was seen".
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
import pandas as pd

from steady_ppl.utils.text import counted, shown

Array = np.ndarray
CODES = (-9999.0, -999.0, -99.0, 999.0, 9999.0, 99999.0, -99999.0, 32767.0, -32768.0, 65535.0, 2147483647.0, 1e9, 1e30)
MIN_CELLS = 10  # of a column of which anything can be said
MIN_REPEATS = 3  # cells of one value that is no such code
FAR = 3.0  # spans of all other values by which a value lies outside them
MIN_JUMP = 8.0  # of the largest usual steps of a column, to a value that stands for nothing
USUAL = 0.95  # quantile of a column's steps
OUTLIER_JUMP = 25.0  # of the median step, to a wrong reading and back
MAX_JUMP_ROWS = 15  # of a wrong reading that lasts
MAX_RADIANS = 5 * math.pi  # rad; beyond it a reading on a circle looks like degrees
MAX_DEGREES = 361.0  # a circle, rounded
MIN_SHARE_OF_DEGREES = 0.05  # of the cells that are beyond one turn in radians
EPOCHS = ((1e17, "nanoseconds", 1e9), (1e14, "microseconds", 1e6), (1e11, "milliseconds", 1e3))  # since 1970
LONG_STEPS = ((1e6, "nanoseconds", 1e9), (1e3, "microseconds", 1e6), (20.0, "milliseconds", 1e3))  # from a step on
MAX_STEP_RATIO = (300.0, 3000.0)  # of a table's step and a program's, between which times look like milliseconds
MAX_TIMES_STEP = 20.0  # of a program's step, or one over it, within which a table's step is what the program expects
MIN_GAP, MAX_GAPS = 50.0, 0.02  # median steps, and share of the steps that may be so long
MAX_REPEATED_TIMES = 0.05  # share of the rows, beyond which stamps are too coarse
MIN_SHARED_ROWS = 5  # that follow one another, of two trajectories
MIN_STAND = 10  # rows of a vehicle that stands still
MAX_OUTLIERS = 0.02  # share of a column's cells; more are no outliers
MAX_PAIRS = 2000  # of columns that are compared
SAME_LINE = 1e-10  # share of its variance by which a column may be beside a line through another
SPANS = (4, 8, 16)  # rows, over which a vehicle's way is compared with its heading
MIN_SPANS = 3  # of a log
MIN_CONCENTRATION, MIN_CONTRAST = 0.5, 0.35  # of headings about the way, and by which another sense must be worse
MIN_RAYLEIGH = 2.2  # of these, in spans: chance gives so much in one of a hundred
MAX_BESIDE_QUARTER = 0.4  # rad, of a heading's offset beside whole quarters of a turn
NEW_LABELS = (
    'table["trajectory"] = table["trajectory"].astype(str) + "-" + (table["time"].diff() < 0).cumsum().astype(str)'
)
SAMPLE = 20_000  # rows by which columns are compared
ANGLE = re.compile(
    r"(heading|bearing|compass|azimuth|course|theta|yaw|(?<![a-z])(angle|roll|pitch|steer|steering|psi))"
    r"(?![a-z]|[ _]?(rate|speed|vel|torque|moment|force|dot|acc))",
    re.I,
)
HEADING = re.compile(r"(heading|compass|azimuth|course|theta|psi|yaw)(?!.*(rate|vel|acc|torque|moment))", re.I)
EAST = re.compile(r"^(?P<start>.*?)(?P<axis>x|east|easting)$", re.I)
NORTHS = {"x": "y", "east": "north", "easting": "northing"}


def cell(name: str) -> str:
    """A column of the table in a line for pandas."""
    return f"table[{json.dumps(name, ensure_ascii=False)}]"


@dataclass(frozen=True)
class Suspicion:
    """What may be wrong with a table."""

    kind: str
    column: str | None
    trajectories: tuple[str, ...]  # in which it is, no more than are named
    cells: int  # or rows, where no column is named
    why: str
    mend: str  # the line that mends it, for pandas; or what to do

    @property
    def where(self) -> str:
        """The column and the trajectories."""
        named = ", ".join(shown(label, 30) for label in self.trajectories[:3])
        more = f" and {len(self.trajectories) - 3} more" if len(self.trajectories) > 3 else ""
        of = f"trajectory {named}{more}" if self.trajectories else ""
        return ", ".join(part for part in (self.column, of) if part)

    def __str__(self) -> str:
        return f"{self.where}: {self.why}" if self.where else self.why


@dataclass
class Columns:
    """A table's cells as numbers, as far as they are."""

    labels: list[str]  # of every run of rows with one label
    run: Array  # (N,), which run a row belongs to
    time: Array  # (N,), s as the table says
    values: dict[str, Array]  # (N,) of every other column, NaN where empty
    units: Mapping[str, str]  # of columns, as a program reads them
    step: float | None  # s, of a program

    @property
    def begins(self) -> Array:
        """The first row of every run."""
        return np.flatnonzero(np.append(True, np.diff(self.run) > 0))

    def of(self, *kinds: str) -> list[str]:
        return [name for name in self.values if name[:2] in kinds]

    def within(self, rows: Array) -> tuple[str, ...]:
        """The labels of trajectories in which some rows `(N,)` bool are."""
        return tuple(dict.fromkeys(self.labels[i] for i in np.unique(self.run[rows])))

    def dropping(self, name: str) -> str:
        """The line that leaves a column out; advice where a program reads it."""
        if name in self.units:
            return "the model reads it: look whether the log has it under another name, or take it out of both"
        return f"table = table.drop(columns={json.dumps(name, ensure_ascii=False)})"

    def is_angle(self, name: str) -> bool:
        unit = self.units.get(name)
        return bool(ANGLE.search(name)) if unit is None else unit == "rad"

    def pairs(self, name: str) -> tuple[Array, Array, Array]:
        """The rows of a column's cells, and the places among them of those that follow another of its run; the steps
        between the two, the short way round where the column turns on a circle."""
        values = self.values[name]
        rows = np.flatnonzero(np.isfinite(values))
        seen = values[rows]
        later = 1 + np.flatnonzero(self.run[rows[1:]] == self.run[rows[:-1]])
        return rows, later, _short_way(seen[later] - seen[later - 1], seen)


def _short_way(steps: Array, seen: Array) -> Array:
    span = float(seen.max() - seen.min()) if len(seen) else 0.0
    for turn in (2 * math.pi, 360.0):
        if 0.8 * turn < span <= 1.01 * turn:
            return (steps + turn / 2) % turn - turn / 2
    return steps


def _runs(table: Columns) -> Iterator[Suspicion]:
    """Trajectories of one row, in several places, and that share rows."""
    labels = pd.Series(table.labels, dtype=object)
    rows, places = labels.repeat(np.bincount(table.run)).value_counts(sort=False), labels.value_counts(sort=False)
    if single := tuple(rows.index[rows == 1]):
        have = "trajectory has" if len(single) == 1 else "trajectories have"
        why = f"{len(single)} {have} one row, and a motion needs two"
        mend = 'table = table[table.groupby("trajectory")["time"].transform("size") > 1]'
        yield Suspicion("one row", None, single, len(single), why, mend)
    if again := tuple(places.index[places > 1]):
        why = "its rows are in several places, between those of others"
        mend = 'table = table.sort_values(["trajectory", "time"], kind="stable")'
        if _restarts(table, again):
            why = "its rows are in several places, and its time begins again there: one label for several trajectories"
            mend = NEW_LABELS
        yield Suspicion("apart", None, again, int(rows[list(again)].sum()), why, mend)
    yield from _shared(table)


def _restarts(table: Columns, labels: Sequence[str]) -> bool:
    """Whether the rows of a label in a later place begin before the end of those in the place before."""
    begins = table.begins
    ends = np.append(begins[1:], len(table.run)) - 1
    for label in labels:
        places = [i for i, one in enumerate(table.labels) if one == label]
        back = [table.time[begins[j]] <= table.time[ends[i]] for i, j in pairwise(places)]
        if any(back):
            return True
    return False


def _shared(table: Columns) -> Iterator[Suspicion]:
    """Rows of two trajectories that say the same: these overlap, or one is a copy of the other."""
    seen = table.of("y.")
    if not seen or len(set(table.labels)) < 2:
        return
    cells = pd.DataFrame({name: table.values[name] for name in [*table.of("u."), *seen]})
    moves = (cells[seen].diff().abs().max(axis=1) > 0).to_numpy()
    own = pd.util.hash_pandas_object(cells, index=False).to_numpy()
    keys, inside = own.copy(), moves.copy()
    for back in range(1, MIN_SHARED_ROWS):  # rows that follow one another
        keys[back:] = keys[back:] * np.uint64(1_000_003) + own[:-back]
        inside[back:] &= moves[:-back] & (table.run[back:] == table.run[:-back])
        inside[:back] = False
    if not pd.Series(keys[inside]).duplicated().any():
        return
    rows = np.flatnonzero(inside)
    owner = pd.Series(np.array(table.labels, dtype=object)[table.run[rows]])
    several = owner.groupby(keys[rows]).transform("nunique").to_numpy() > 1
    if several.any():
        shared = tuple(dict.fromkeys(owner[several]))
        count = int(several.sum()) + len(shared) * (MIN_SHARED_ROWS - 1)
        why = f"{count} rows say exactly what rows of another trajectory say: they overlap, or one is a copy"
        mend = (
            "keep each row in one trajectory: rows that are there twice count twice, and a test on a copy tests nothing"
        )
        yield Suspicion("overlap", None, shared, count, why, mend)


def _times(table: Columns) -> Iterator[Suspicion]:
    """Times that go back, are no seconds, or have gaps."""
    all_steps = np.diff(table.time)
    inner = (table.run[1:] == table.run[:-1]) & np.isfinite(all_steps)
    steps = all_steps[inner]
    if not len(steps):
        return
    rows = np.append(False, inner & ~(all_steps > 0))
    count = int(rows.sum())
    if count:
        repeats = bool((all_steps[rows[1:]] == 0).all())
        why = f"times {'repeat' if repeats else 'go back'} in {counted(count, 'row')}, and have to rise from row to row"
        mend = 'table = table.sort_values(["trajectory", "time"]).drop_duplicates(["trajectory", "time"])'
        starts = table.time[table.begins][table.run[rows]]
        lengths = table.time[rows] - starts
        if repeats and count > MAX_REPEATED_TIMES * len(table.time):
            mend = "the stamps are coarser than the rows: take finer ones, or spread those that are equal evenly"
        elif not repeats and bool((np.abs(lengths) <= np.abs(table.time[rows.nonzero()[0] - 1] - starts) / 2).all()):
            why += ": the time begins again, one label for several trajectories"
            mend = NEW_LABELS
        yield Suspicion("time", "time", table.within(rows), count, why, mend)
    step, first = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0, float(np.nanmin(table.time))
    unit = next(((name, by) for least, name, by in EPOCHS if first > least), None)
    told = f"they begin at {first:.6g}"
    ratio = step / table.step if table.step else math.nan
    if unit is None and not 1 / MAX_TIMES_STEP < ratio < MAX_TIMES_STEP:
        unit = next(((name, by) for least, name, by in LONG_STEPS if step >= least), None)
        told = f"rows are {step:.3g} apart"
        if unit is None and MAX_STEP_RATIO[0] < ratio < MAX_STEP_RATIO[1]:
            unit, told = ("milliseconds", 1e3), f"rows are {step:.3g} apart, steps of the model {table.step:g} s"
    if unit is not None:
        name, by = unit
        why = f"{told}: are these {name}? The table's times are seconds"
        yield Suspicion("time unit", "time", (), len(table.time), why, f"{cell('time')} /= 1e{round(math.log10(by))}")
    gaps = np.append(False, inner & (all_steps > MIN_GAP * step)) if step > 0 else np.zeros_like(rows)
    if 0 < gaps.sum() <= MAX_GAPS * len(steps):
        longest = float(all_steps[gaps[1:]].max())
        longer = counted(int(gaps.sum()), "step") + (" is" if gaps.sum() == 1 else " are")
        why = f"{longer} longer than {MIN_GAP:g} usual steps, the longest {longest:.4g}"
        mend = "let a trajectory end before a gap, and another one begin behind it"
        yield Suspicion("gap", "time", table.within(gaps), int(gaps.sum()), why, mend)


def _constants(table: Columns) -> Iterator[Suspicion]:
    """Columns that never change."""
    for name in table.of("u.", "y."):
        values = table.values[name]
        seen = values[np.isfinite(values)]
        if len(seen) >= MIN_CELLS and float(seen.min()) == float(seen.max()):
            what = "command" if name.startswith("u.") else "measurement"
            why = f"this {what} is {seen[0]:.6g} in every row: it tells nothing of what it does"
            yield Suspicion("constant", name, (), len(seen), why, "look whether the log has it under another name")
        elif not len(seen):
            yield Suspicion("empty", name, (), 0, "every cell is empty", table.dropping(name))


def _codes(table: Columns) -> Iterator[Suspicion]:
    """Values that stand for "nothing was measured". They are taken for empty by what looks on."""
    for name in table.of("u.", "y.", "x."):
        for _ in range(3):
            values = table.values[name]
            seen = values[np.isfinite(values)]
            if len(seen) < MIN_CELLS or (code := _code(table, name, seen)) is None:
                break
            rows = values == code
            rest = seen[seen != code]
            cells = "1 cell is" if rows.sum() == 1 else f"{int(rows.sum())} cells are"
            told = f"{code:g}" if float(f"{code:g}") == code else repr(code)
            why = f"{cells} {told}, all others between {rest.min():.4g} and {rest.max():.4g}"
            why += ": is it what the log writes where nothing was measured?"
            is_code = f"{cell(name)} == {told}"
            mend = f'table.loc[{is_code}, {json.dumps(name, ensure_ascii=False)}] = float("nan")'
            if name.startswith("u."):  # a command may not be empty
                mend = f'{cell(name)} = {cell(name)}.mask({is_code}).groupby(table["trajectory"]).ffill()'
            yield Suspicion("code", name, table.within(rows), int(rows.sum()), why, mend)
            table.values[name] = np.where(rows, np.nan, values)


def _code(table: Columns, name: str, seen: Array) -> float | None:
    for code in dict.fromkeys((float(seen.min()), float(seen.max()), 0.0)):
        cells = seen == code
        count, is_known = int(cells.sum()), code in CODES
        if not 0 < count < len(seen) or (count < MIN_REPEATS and not is_known):
            continue
        rest = seen[~cells]
        low, high = float(rest.min()), float(rest.max())
        is_far = max(low - code, code - high) > FAR * (high - low) and (high > low or is_known)
        if is_known and is_far:
            return code
        if name.startswith("u.") or count > 0.95 * len(seen) or _stands(table, name, code):
            continue
        if is_far or (name.startswith("y.") and _is_apart(table, name, code)):
            return code
    return None


def _stands(table: Columns, name: str, value: float) -> bool:
    """Whether a column keeps a value for long, or only where trajectories begin and end: the vehicle stood still."""
    values = table.values[name]
    rows = np.flatnonzero(np.isfinite(values))
    same = values[rows] == value
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(int), [0]])))
    begins, ends = edges[::2], edges[1::2]
    lengths = ends - begins
    first = (begins == 0) | (table.run[rows[begins]] != table.run[rows[np.maximum(begins - 1, 0)]])
    after = np.minimum(ends, len(rows) - 1)
    last = (ends == len(rows)) | (table.run[rows[after]] != table.run[rows[ends - 1]])
    return bool(np.median(lengths) >= MIN_STAND or (first | last).all())


def _is_apart(table: Columns, name: str, code: float) -> bool:
    """Whether a column jumps to a value and back, farther than it moves otherwise."""
    rows, later, steps = table.pairs(name)
    is_code = table.values[name][rows] == code
    one_is = is_code[later] ^ is_code[later - 1]
    usual = np.abs(steps[~is_code[later] & ~is_code[later - 1]])
    jumps = np.abs(steps[one_is])
    if len(jumps) < 2 or len(usual) < 10:
        return False
    largest = float(np.quantile(usual, USUAL))
    return float(np.median(jumps)) > MIN_JUMP * largest and float(np.quantile(jumps, 0.1)) > 2 * largest > 0


def _outliers(table: Columns) -> Iterator[Suspicion]:
    """Readings to which a measurement jumps, and from which it jumps back within some rows."""
    for name in table.of("y."):
        rows, later, steps = table.pairs(name)
        if len(steps) < 20:
            continue
        sizes = np.abs(steps)
        moving = sizes[sizes > 0]
        least = OUTLIER_JUMP * float(np.median(moving)) if len(moving) else math.inf
        large = np.flatnonzero((sizes > least) & (sizes > 4 * float(np.quantile(sizes, USUAL))))
        wrong = np.zeros(len(rows), dtype=bool)
        for one, other in pairwise(large):
            back = -steps[other] / steps[one]
            first, last = later[one], later[other]
            near = sizes[max(0, one - 2) : one].tolist() + sizes[other + 1 : other + 3].tolist()
            is_alone = not near or max(near) < 0.2 * sizes[one]
            is_short = last - first <= MAX_JUMP_ROWS and table.run[rows[first]] == table.run[rows[last]]
            if 0.5 < back < 2 and is_short and is_alone:
                wrong[first:last] = True
        if 0 < wrong.sum() <= max(1.0, MAX_OUTLIERS * len(rows)):
            at = np.zeros(len(table.run), dtype=bool)
            at[rows[wrong]] = True
            when = float(table.time[rows[wrong][0]])
            one = wrong.sum() == 1
            told = "1 reading jumps" if one else f"{int(wrong.sum())} readings jump"
            why = f"{told} away and back, the first at {when:.6g} s: {'is it' if one else 'are they'} wrong?"
            mend = "steady check RUN TABLE --mask CLEAN.csv leaves out what a fitted model finds impossible"
            yield Suspicion("outlier", name, table.within(at), int(wrong.sum()), why, mend)


def _copies(table: Columns) -> Iterator[Suspicion]:
    """Columns that are other columns again, perhaps in another unit."""
    stride = max(1, len(table.run) // SAMPLE)
    taken, left = set[str](), MAX_PAIRS
    for kind in ("u.", "y."):
        names = [name for name in table.of(kind) if np.isfinite(table.values[name]).sum() >= MIN_CELLS]
        for one, other in combinations(names, 2):
            if other in taken or left == 0:
                continue
            left -= 1
            a, b = table.values[one][::stride], table.values[other][::stride]
            both = np.isfinite(a) & np.isfinite(b)
            a, b = a[both], b[both]
            if len(a) < 2 * MIN_CELLS or len(np.unique(a[:1000])) < 5 or not (spread := float(np.std(b))) > 0:
                continue
            slope, offset = _line(a, b)
            if float(np.var(b - slope * a - offset)) > SAME_LINE * spread**2:
                continue
            taken.add(other)
            shift = f" (and {offset:+.4g})" if abs(offset) > 1e-6 * spread else ""
            how = "the same as" if abs(slope - 1) < 1e-6 and not shift else f"{slope:.5g} times"
            why = f"it is {how} {one}{shift}: it tells nothing new" + (", and counts twice" if kind == "y." else "")
            yield Suspicion("copy", other, (), len(a), why, table.dropping(other))


def _line(a: Array, b: Array) -> tuple[float, float]:
    centre = a - a.mean()
    slope = float(centre @ (b - b.mean()) / (centre @ centre)) if (centre @ centre) > 0 else 0.0
    return slope, float(b.mean() - slope * a.mean())


def are_degrees(seen: Array, min_share: float = 0.0) -> bool:
    """Whether angles, none of them missing, reach farther than radians would and no farther than a circle, and more
    than a share of them lies beyond one turn in radians."""
    sizes = np.abs(seen)
    is_far = len(sizes) > 0 and MAX_RADIANS < float(sizes.max()) <= MAX_DEGREES
    return is_far and float((sizes > 2 * math.pi).mean()) > min_share


def _degrees(table: Columns) -> Iterator[Suspicion]:
    """Angles that look like degrees where radians are read."""
    for name in table.of("u.", "y.", "x."):
        values = table.values[name]
        looked_at = values[table.begins] if name.startswith("x.") else values  # later states may have counted turns
        seen = looked_at[np.isfinite(looked_at)]
        if table.is_angle(name) and are_degrees(seen, MIN_SHARE_OF_DEGREES):
            why = f"it is between {seen.min():.4g} and {seen.max():.4g}, and angles are radians: are these degrees?"
            yield Suspicion("degrees", name, (), len(seen), why, f"{cell(name)} *= np.pi / 180")
            table.values[name] = np.deg2rad(values)


def _headings(table: Columns) -> Iterator[Suspicion]:
    """Headings beside the course over ground: from north, clockwise or backwards; or the axes are swapped."""
    for east in table.of("y."):
        match = EAST.match(east)
        north = match and f"{match['start']}{_like(match['axis'], NORTHS[match['axis'].lower()])}"
        if not north or north not in table.values:
            continue
        swapped = _is_swapped(table, east, north)
        if swapped:
            mend = f"table = table.rename(columns={json.dumps({east: north, north: east}, ensure_ascii=False)})"
            why = f"it goes with {swapped}: are {east} and {north} swapped?"
            yield Suspicion("axes", east, (), len(table.run), why, mend)
            continue
        for heading in (name for name in table.of("y.") if HEADING.search(name)):
            yield from _against_course(table, east, north, heading)


def _like(sample: str, word: str) -> str:
    return word.upper() if sample.isupper() else word.capitalize() if sample[0].isupper() else word


def _is_swapped(table: Columns, east: str, north: str) -> str | None:
    """The known state with which a position goes, if it is the other axis."""
    states = [name for name in ("x.x", "x.y") if name in table.values]
    if len(states) < 2:
        return None

    def agreement(one: str, other: str) -> float:
        both = np.isfinite(table.values[one]) & np.isfinite(table.values[other])
        apart = np.abs(table.values[one][both] - table.values[other][both])
        return float(apart.mean()) if len(apart) > 2 * MIN_CELLS else math.nan

    straight = agreement(east, "x.x") + agreement(north, "x.y")
    across = agreement(east, "x.y") + agreement(north, "x.x")
    return "x.y" if across < 0.3 * straight else None


def _against_course(table: Columns, east: str, north: str, heading: str) -> Iterator[Suspicion]:
    """A vehicle moves or accelerates along its heading, mostly; either is looked at over several spans."""
    x, y, angle = (table.values[name] for name in (east, north, heading))
    rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y) & np.isfinite(angle))[:SAMPLE]
    found = []
    for span in SPANS:
        first, middle, last = rows[: -2 * span], rows[span:-span], rows[2 * span :]
        same = table.run[first] == table.run[last]
        first, middle, last = first[same], middle[same], last[same]
        spans = len(first) / (2 * span)
        for weights in ((-1.0, 0.0, 1.0), (1.0, -2.0, 1.0)):
            along = sum(w * (x[at] + 1j * y[at]) for w, at in zip(weights, (first, middle, last), strict=True))
            length = float(np.abs(along).sum())
            if spans < MIN_SPANS or not length > 0:
                continue
            turned = {1: np.exp(1j * angle[middle]) * np.conj(along), -1: np.exp(1j * angle[middle]) * along}
            means = {sign: complex(values.sum()) / length for sign, values in turned.items()}
            sign = max(means, key=lambda one: abs(means[one]))
            best, worse = abs(means[sign]), abs(means[-sign])
            if best > MIN_CONCENTRATION and best - worse > MIN_CONTRAST and best * math.sqrt(spans) > MIN_RAYLEIGH:
                found.append((best - worse, sign, float(np.angle(means[sign]))))
    if not found:
        return
    _, sign, offset = max(found)
    quarters = round(offset / (math.pi / 2))
    if abs(offset - quarters * math.pi / 2) > MAX_BESIDE_QUARTER or (sign == 1 and quarters == 0):
        return
    turn = f"{quarters * math.pi / 2:.6g}"
    clockwise = sign == -1 and quarters == 1
    counts = "from north, clockwise" if clockwise else "clockwise" if quarters == 0 else f"{turn} rad too much"
    if sign == -1 and quarters and not clockwise:
        counts = f"clockwise, {turn} rad beside it"
    why = f"along the way of {east} and {north} it counts {counts}; expected is 0 along {east}, pi/2 along {north}"
    why += f"; or {east} and {north} are swapped" if clockwise else ""
    why += "; or the vehicle drives backwards" if sign == 1 and abs(quarters) == 2 else ""
    mended = f"{turn} - {cell(heading)}" if quarters else f"-{cell(heading)}"
    mended = mended if sign == -1 else f"{cell(heading)} - {turn}"
    yield Suspicion("heading", heading, (), len(rows), why, f"{cell(heading)} = {mended}")


LOOKS: Sequence[Callable[[Columns], Iterator[Suspicion]]] = (
    _runs,
    _times,
    _codes,
    _degrees,
    _constants,
    _outliers,
    _copies,
    _headings,
)
