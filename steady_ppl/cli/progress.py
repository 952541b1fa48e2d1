"""One line on a terminal that says what is being done and about how long it will take."""

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from steady_ppl.utils.context import QUIET
from steady_ppl.utils.text import printable

PATIENCE_SECONDS = 2.0  # before anything is said
CLEAR_LINE = "\r\x1b[K"


class _Line:
    """What is shown; drawn anew twice a second by a thread of its own."""

    def __init__(self) -> None:
        self.begun = time.monotonic()
        self.doing, self.share, self.since = "", 0.0, self.begun
        self.drawn = False
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

    def keep_drawing(self) -> None:
        """Until it is ended."""
        while not self.ended.wait(0.5):
            with self.lock:
                now = time.monotonic()
                if self.doing and now - self.begun > PATIENCE_SECONDS:
                    said = in_words(self.doing, self.share, self.since - self.begun, now - self.begun)
                    print(f"{CLEAR_LINE}{_end(printable(said))}", end="", file=sys.stderr, flush=True)
                    self.drawn = True

    def clear(self) -> None:
        if self.drawn:
            print(CLEAR_LINE, end="", file=sys.stderr, flush=True)
            self.drawn = False


@contextmanager
def progress_line() -> Iterator[Callable[[str, float], None]]:
    """Yields what is to be told of stages; shows nothing where stderr is no terminal, or in quiet."""
    if QUIET.get() or not sys.stderr.isatty():
        yield lambda doing, share: None
        return
    line = _Line()
    thread = threading.Thread(target=line.keep_drawing, daemon=True)
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
    if share < 0.02:
        return f"{doing} … {elapsed:.0f} s so far"
    left = until_now / share - elapsed
    if left < 1:
        return f"{doing} … about to end"
    return f"{doing} … about " + (f"{left:.0f} s left" if left < 90 else f"{left / 60:.0f} min left")
