"""Text for a terminal, and what a file says on a line."""

import doctest

from small import HIDDEN

from steady_ppl.utils import text
from steady_ppl.utils.text import printable, shown, tell


def test_the_example_runs() -> None:
    assert doctest.testmod(text).attempted and not doctest.testmod(text).failed


def test_columns_are_flush_right_but_for_those_that_are_left() -> None:
    assert text.aligned([["a", "bb", "1"], ["", "b", "22"]], left=(1,)) == ["a  bb   1", "   b   22"]


def test_what_cannot_be_written_is_spelt_out(capsys) -> None:
    assert printable("tab\tline\n ä→² 🚗") == "tab\tline\n ä→² 🚗"
    tell(f"a\udcff{HIDDEN}b")
    assert capsys.readouterr().out == "a\\udcff\\x1b[2J\\x1b]0;owned\\x07\\r\\x9b31m\\u202eb\n"


def test_what_a_file_says_is_shown_on_one_line() -> None:
    assert shown("a\x1b[2J\nb\0\u202e") == r"a\x1b[2J\nb\x00\u202e"
    assert shown("x" * 200, 10) == "x" * 9 + "…"
