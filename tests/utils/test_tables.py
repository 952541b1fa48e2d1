"""Tables of text."""

import doctest

from steady_ppl.utils import tables


def test_the_example_runs() -> None:
    assert doctest.testmod(tables).attempted and not doctest.testmod(tables).failed


def test_columns_are_flush_right_but_for_those_that_are_left() -> None:
    assert tables.aligned([["a", "bb", "1"], ["", "b", "22"]], left=(1,)) == ["a  bb   1", "   b   22"]
