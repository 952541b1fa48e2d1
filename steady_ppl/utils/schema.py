"""The form of JSON that somebody gives, and where it departs from it.

A form is `NUMBER`, `WHOLE`, `TEXT`, `BOOL`, `ANYTHING` or None, which is null; `[form]` for a list, `[form, form]` for
one of two; `(form, form)` for one of several; `{"key": form, "other?": form}` for what has these keys, of which those
with a `?` need not be there, and perhaps others; `{str: form}` for any keys; `Paired(form, keys)`.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from steady_ppl.utils.text import shown

NUMBER, WHOLE, TEXT, BOOL = "a finite number", "a whole number from 0 to 2^63", "text", "true or false"
ANYTHING = "anything"
LINES = [TEXT]


class Paired(NamedTuple):
    """A form of names and values, of which some hold equally many numbers: those that are there and not null."""

    form: dict[str, Any]
    keys: tuple[str, ...]


def mismatch(content: Any, form: Any, place: str = "") -> str | None:
    """Return where JSON has another form than expected, as the module says it, in words; None where it has not.

    Example:
        >>> mismatch({"seed": "one"}, {"seed": WHOLE})
        "seed is 'one', expected a whole number from 0 to 2^63"
    """
    if isinstance(form, Paired):
        return mismatch(content, form.form, place) or _unpaired(content, form.keys, place)
    if isinstance(form, tuple):
        problems = [mismatch(content, one, place) for one in form]
        return None if None in problems else problems[0]
    if isinstance(form, list):
        if not isinstance(content, list) or len(form) not in (1, len(content)):
            return _wrong(content, place, "a list" if len(form) == 1 else f"a list of {len(form)}")
        inner = form * len(content) if len(form) == 1 else form
        pairs = enumerate(zip(content, inner, strict=True))
        return _first(mismatch(one, of, f"{place}[{i}]") for i, (one, of) in pairs)
    if isinstance(form, dict):
        if not isinstance(content, dict):
            return _wrong(content, place, "names and values")
        known = dict.fromkeys(content, form[str]) if str in form else {key.rstrip("?"): form[key] for key in form}
        if lacking := [key for key in known if key not in content and key in form]:
            return f"{place or 'it'} has no {', '.join(lacking)}"
        return _first(mismatch(content[key], known[key], _inside(place, key)) for key in known if key in content)
    return None if _is(content, form) else _wrong(content, place, form)


def surplus(content: Iterable[str], known: Iterable[str], place: str = "") -> str | None:
    """Return which key has no meaning, in words; None where all are `known`, which may be the keys of a form."""
    keys = [key.rstrip("?") for key in known]
    return _first(f"unknown key {place}{key}; there are {', '.join(keys)}" for key in content if key not in keys)


def count(numbers: Any) -> int:
    """How many there are in a list, or in one number that stands for a list of it."""
    return len(numbers) if isinstance(numbers, list) else 1


def _unpaired(content: Mapping[str, Any], keys: tuple[str, ...], place: str) -> str | None:
    counts = {key: count(content[key]) for key in keys if content.get(key) is not None}
    first = next(iter(counts), "")
    for key, found in counts.items():
        if found != counts[first]:
            return f"{_inside(place, key)} has length {found}, expected {counts[first]} as {first} has"
    return None


def _is(content: Any, form: str | None) -> bool:
    if form is None or form == ANYTHING:
        return form == ANYTHING or content is None
    if form in (TEXT, BOOL):
        return isinstance(content, str if form == TEXT else bool)
    if isinstance(content, bool) or not isinstance(content, int | float):
        return False
    if form == WHOLE:
        return isinstance(content, int) and 0 <= content < 2**63
    return abs(content) <= 1e300 if isinstance(content, int) else math.isfinite(content)


def _first(problems: Iterable[str | None]) -> str | None:
    return next((problem for problem in problems if problem is not None), None)


def _inside(place: str, key: str) -> str:
    return f"{place}.{key}" if place else key


def _wrong(content: Any, place: str, wanted: str) -> str:
    return f"{place or 'it'} is {shown(repr(content), 40)}, expected {wanted}"
