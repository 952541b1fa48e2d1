"""What is being done and about how long it will take: one line on a terminal, a line now and then in a file."""

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

from steady_ppl.utils.context import QUIET
from steady_ppl.utils.text import MAX_LINE_LENGTH, printable, shown

PATIENCE_SECONDS = 2.0  # before anything is said
FILE_PATIENCE_SECONDS = 10.0  # before a line is written to a file, and between two lines
CLEAR_LINE = "\r\x1b[K"


class _Stage:
    """The stage that is going on; looked at twice a second by a thread of its own."""

    def __init__(self) -> None:
        self.begun = time.monotonic()
        self.doing, self.share, self.since = "", 0.0, self.begun
        self.lock, self.ended = threading.Lock(), threading.Event()

    def heard(self, doing: str, share: float) -> None:
        """A stage begins; the outermost one ends with no name."""
        with self.lock:
            self.since = time.monotonic()
            if share == 0.0 and not self.doing:
                self.begun = self.since
            self.doing, self.share = doing, share
            if share == 1.0:
                self.clear()

    def keep_showing(self) -> None:
        """Until it is ended."""
        with suppress(OSError):  # nobody reads it any more
            while not self.ended.wait(0.5):
                with self.lock:
                    if self.doing:
                        self.show(time.monotonic())

    def show(self, now: float) -> None:
        """Say what is going on, if it is time to."""

    def clear(self) -> None:
        """Take away what is shown."""


class _Line(_Stage):
    """A line on a terminal, which is drawn anew."""

    drawn = False

    def show(self, now: float) -> None:
        if now - self.begun > PATIENCE_SECONDS:
            said = in_words(self.doing, self.share, self.since - self.begun, now - self.begun)
            print(f"{CLEAR_LINE}{_end(printable(said))}", end="", file=sys.stderr, flush=True)
            self.drawn = True

    def clear(self) -> None:
        if self.drawn:
            print(CLEAR_LINE, end="", file=sys.stderr, flush=True)
            self.drawn = False


class _Lines(_Stage):
    """Lines in a file, one a stage at most, and none soon after another."""

    def __init__(self, file: TextIO) -> None:
        super().__init__()
        self.file, self.first, self.last = file, self.begun, self.begun
        self.said: tuple[str, float] | None = None

    def show(self, now: float) -> None:
        stage = (self.doing, self.share)
        if now - self.last < FILE_PATIENCE_SECONDS or stage == self.said:
            return
        left = left_in_words(self.share, self.since - self.begun, now - self.begun)
        said = ", ".join(filter(None, (f"{self.doing} … {_in_words(now - self.first)} gone by", left)))
        self.file.write(shown(f"steady: {said}", MAX_LINE_LENGTH) + "\n")
        self.file.flush()
        self.said, self.last = stage, now


@contextmanager
def progress_line() -> Iterator[Callable[[str, float], None]]:
    """Yields what is to be told of stages; shows nothing in quiet."""
    if QUIET.get():
        yield lambda doing, share: None
        return
    line = _Line() if sys.stderr.isatty() else _Lines(sys.stderr)
    thread = threading.Thread(target=line.keep_showing, daemon=True)
    thread.start()
    try:
        yield line.heard
    finally:
        line.ended.set()
        thread.join()
        line.clear()


def _end(line: str) -> str:
    """As much of the end of a line as a row of the terminal holds: longer lines leave rows behind."""
    try:
        width = os.get_terminal_size(sys.stderr.fileno()).columns or 80
    except OSError:  # it does not know its width
        width = 80
    return line if len(line) < width else f"…{line[len(line) - max(0, width - 2) :]}"


def in_words(doing: str, share: float, until_now: float, elapsed: float) -> str:
    """What is being done, and the time left if all of it goes on as fast as its stages have until now: a share of the
    whole was done, `until_now` s after its beginning, when the stage began, and now `elapsed` s have gone by."""
    return f"{doing} … " + (left_in_words(share, until_now, elapsed) or f"{_in_words(elapsed)} so far")


def left_in_words(share: float, until_now: float, elapsed: float) -> str:
    """The time left, see `in_words`; nothing where too little is done to tell."""
    if share < 0.02:
        return ""
    left = until_now / share - elapsed
    return f"about {_in_words(left)} left" if left >= 1 else "about to end"


def _in_words(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
