"""Text for a terminal."""

import doctest

from steady_ppl.utils import text


def test_the_example_runs() -> None:
    assert doctest.testmod(text).attempted and not doctest.testmod(text).failed


def test_columns_are_flush_right_but_for_those_that_are_left() -> None:
    assert text.aligned([["a", "bb", "1"], ["", "b", "22"]], left=(1,)) == ["a  bb   1", "   b   22"]
