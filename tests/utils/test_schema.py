"""The form of JSON, and where it departs from it."""

from __future__ import annotations

import math
from pathlib import Path

from steady_ppl.utils.schema import NUMBER, TEXT, WHOLE, Paired, mismatch


def test_a_form_is_told_from_another(tmp_path: Path) -> None:
    form = {"a": NUMBER, "b": ([WHOLE], None), "c?": TEXT, "d": (NUMBER, TEXT)}
    assert mismatch({"a": 1, "b": None, "d": "x"}, form) is None
    assert mismatch({"a": 1, "b": [1, -1], "d": 2}, form) == "b[1] is -1, expected a whole number from 0 to 2^63"
    assert mismatch({"a": math.inf, "b": [], "d": 2}, form) == "a is inf, expected a finite number"
    assert mismatch({"a": True, "b": [], "d": 2}, form) == "a is True, expected a finite number"
    assert mismatch({"b": [], "d": 2}, form) == "it has no a"
    assert mismatch([], form) == "it is [], expected names and values"
    assert mismatch({"x": 10**400}, {str: NUMBER}).startswith("x is 1000")
    assert mismatch({"a": 1, "b": [], "c": 3, "d": 2}, form) == "c is 3, expected text"


def test_a_list_of_another_length_is_told() -> None:
    form = [Paired({"a": [NUMBER], "b": (NUMBER, [NUMBER], None), "c": [NUMBER, TEXT]}, ("a", "b"))]
    for good in ({"a": [1], "b": 2}, {"a": [1, 2], "b": [3, 4]}, {"a": [], "b": None}):
        assert mismatch([good | {"c": [1, "x"]}], form, "it") is None
    assert mismatch([{"a": [1, 2], "b": 3, "c": [1, "x"]}], form) == "[0].b has length 1, expected 2 as a has"
    assert mismatch([{"a": [], "b": None, "c": [1]}], form) == "[0].c is [1], expected a list of 2"
    assert mismatch([{"a": [], "b": None, "c": [1, 2]}], form) == "[0].c[1] is 2, expected text"
