"""What can happen to any file: cut short, bits turned over, replaced by something else."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path

from hypothesis import strategies as st

Change = Callable[[st.DrawFn, bytes], "bytes | str"]
"""From a good file's bytes to others, or to the name of what takes the file's place."""


def lay(file: Path, now: bytes | str) -> None:
    """Put something in the place of a good file: other bytes, `a folder`, `a pipe`, or a link, by where it leads."""
    file.unlink()
    if isinstance(now, bytes):
        file.write_bytes(now)
    elif now == "a folder":
        file.mkdir()
    elif now == "a pipe":
        os.mkfifo(file)  # reading from it never ends, since nobody writes
    else:
        file.symlink_to(now.format(name=file.name))


def of_text(change: Callable[[st.DrawFn, str], str | bytes]) -> Change:
    """A change of a file's text."""

    def changed(draw: st.DrawFn, content: bytes) -> bytes:
        now = change(draw, content.decode())
        return now if isinstance(now, bytes) else now.encode()

    return changed


def spelt(spell: Callable[[str], str | bytes]) -> Change:
    """A change of a file's text in which nothing is drawn."""
    return of_text(lambda draw, text: spell(text))


def of_lines(change: Callable[[st.DrawFn, list[str]], list[str]]) -> Change:
    """A change of the lines of a file's text."""
    return of_text(lambda draw, text: "\n".join(change(draw, text.splitlines())) + "\n")


def of_a_line(put: Callable[[st.DrawFn, str], list[str]], fits: Callable[[str], bool] = lambda line: True) -> Change:
    """Others in the place of a line that fits."""

    def change(draw: st.DrawFn, lines: list[str]) -> list[str]:
        at = draw(st.sampled_from([i for i, line in enumerate(lines) if fits(line)]))
        return [*lines[:at], *put(draw, lines[at]), *lines[at + 1 :]]

    return of_lines(change)


def _around(change: Callable[[st.DrawFn, bytes], bytes]) -> Change:
    """A change of a block of at most 64 bytes."""

    def changed(draw: st.DrawFn, content: bytes) -> bytes:
        start = draw(st.integers(0, len(content) - 1))
        end = start + draw(st.integers(1, 64))
        return content[:start] + change(draw, content[start:end]) + content[end:]

    return changed


def _flipped(draw: st.DrawFn, content: bytes) -> bytes:
    now = bytearray(content)
    for bit in draw(st.lists(st.integers(0, 8 * len(now) - 1), min_size=1, max_size=16)):
        now[bit // 8] ^= 1 << bit % 8
    return bytes(now)


def _overwritten(draw: st.DrawFn, content: bytes) -> bytes:
    now = bytearray(content)
    for at in draw(st.lists(st.integers(0, min(64, len(now)) - 1), min_size=1, max_size=4)):
        now[at] = draw(st.integers(0, 255))
    return bytes(now)


BYTES: Mapping[str, Change] = {
    "cut short": lambda draw, content: content[: draw(st.integers(1, len(content) - 1))],
    "bits flipped": _flipped,
    "its beginning overwritten": _overwritten,
    "a block of zeros": _around(lambda draw, block: bytes(len(block))),
    "a block lost": _around(lambda draw, block: b""),
    "a block inserted": _around(lambda draw, block: draw(st.binary(min_size=1, max_size=64)) + block),
    "a block twice": _around(lambda draw, block: block + block),
    "empty": lambda draw, content: b"",
    "one byte": lambda draw, content: draw(st.binary(min_size=1, max_size=1)),
    "junk": lambda draw, content: draw(st.randoms(use_true_random=False)).randbytes(5000),
    "NUL bytes": lambda draw, content: bytes(5000),
    "ten megabytes of zeros behind it": lambda draw, content: content + bytes(10_000_000),
    "UTF-16": lambda draw, content: content.decode("utf-8", "replace").encode("utf-16"),
    "a folder": lambda draw, content: "a folder",
    "a pipe": lambda draw, content: "a pipe",
    "a link to nothing": lambda draw, content: "nothing.{name}",
    "a link to itself": lambda draw, content: "{name}",
    "a link to endless zeros": lambda draw, content: "/dev/zero",
}
