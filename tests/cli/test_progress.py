"""Progress: on a terminal one line that is gone afterwards, in a file a line now and then."""

from __future__ import annotations

import io
import os
import re
import time

import pytest

from steady_ppl.cli import progress as progress_line
from steady_ppl.cli.progress import in_words
from steady_ppl.utils.context import QUIET, bound
from steady_ppl.utils.progress import listening, stages


@pytest.mark.parametrize(
    ("share", "until_now", "elapsed", "said"),
    [
        (0.0, 0.0, 5.0, "x … 5 s so far"),
        (0.0, 0.0, 300.0, "x … 5 min so far"),
        (0.5, 10.0, 12.0, "x … about 8 s left"),
        (0.1, 60.0, 60.0, "x … about 9 min left"),
        (0.9, 9.0, 20.0, "x … about to end"),
    ],
)
def test_the_time_left_goes_by_what_is_done(share: float, until_now: float, elapsed: float, said: str) -> None:
    assert in_words("x", share, until_now, elapsed) == said


class Terminal(io.StringIO):
    """A place to write to that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def two_seconds() -> None:
    with stages(("first", 1), ("second", 1)) as begin:
        for _ in range(2):
            begin()
            time.sleep(0.7)


@pytest.mark.parametrize("is_terminal", [True, False])
def test_progress_is_drawn_on_a_terminal_only_and_cleared(monkeypatch, is_terminal: bool) -> None:
    screen = Terminal() if is_terminal else io.StringIO()
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setattr(progress_line, "PATIENCE_SECONDS", 0.1)
    with progress_line.progress_line() as line, listening(line):
        two_seconds()
        shown = screen.getvalue()
    if not is_terminal:
        assert screen.getvalue() == ""
        return
    assert "first … 0 s so far" in shown or "first … 1 s so far" in shown
    assert "second … about to end" in shown or "second … about 1 s left" in shown
    assert shown.endswith(progress_line.CLEAR_LINE)


def written_to_a_file(monkeypatch, patience: float) -> list[str]:
    """The lines that two stages leave in a file."""
    file = io.StringIO()
    monkeypatch.setattr("sys.stderr", file)
    monkeypatch.setattr(progress_line, "FILE_PATIENCE_SECONDS", patience)
    with progress_line.progress_line() as line, listening(line):
        monkeypatch.setattr("sys.stderr", io.StringIO())  # as a command may that keeps its notes to itself
        two_seconds()
    return file.getvalue().splitlines()


def test_a_file_gets_a_plain_line_a_stage(monkeypatch) -> None:
    first, second = written_to_a_file(monkeypatch, 0.3)
    assert re.fullmatch(r"steady: first … \d s gone by", first)
    assert re.fullmatch(r"steady: second … \d s gone by, about (\d s left|to end)", second)
    assert len(written_to_a_file(monkeypatch, 0.9)) == 1


def test_a_file_gets_nothing_of_a_short_command_or_in_quiet(monkeypatch) -> None:
    assert written_to_a_file(monkeypatch, 5.0) == []
    with bound(QUIET, True):
        assert written_to_a_file(monkeypatch, 0.1) == []


def test_a_file_that_cannot_be_written_ends_nothing(monkeypatch) -> None:
    class Full(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr("sys.stderr", Full())
    monkeypatch.setattr(progress_line, "FILE_PATIENCE_SECONDS", 0.1)
    with progress_line.progress_line() as line, listening(line):
        two_seconds()


@pytest.mark.parametrize("width", [2, 30])
def test_progress_keeps_to_one_row_of_a_narrow_terminal(monkeypatch, width: int) -> None:
    screen = Terminal()
    screen.fileno = lambda: 2
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setattr("os.get_terminal_size", lambda _: os.terminal_size((width, 24)))
    monkeypatch.setattr(progress_line, "PATIENCE_SECONDS", 0.1)
    with progress_line.progress_line() as line, listening(line), stages(("a stage whose name is long", 1)) as begin:
        begin()
        time.sleep(0.7)
    drawn = screen.getvalue().split(progress_line.CLEAR_LINE)
    assert max(map(len, drawn)) == width - 1 and any(said.startswith("…") for said in drawn)
    assert width == 2 or any(said.endswith("s so far") for said in drawn)
