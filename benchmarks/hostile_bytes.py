"""What can happen to any file: cut short, bits turned over, replaced by something else.

A mutation takes a good file and a random generator and spoils the file where it lies.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random

Spoil = Callable[[Path, Random], None]


def _changed(change: Callable[[bytearray, Random], bytes]) -> Spoil:
    def spoil(file: Path, dice: Random) -> None:
        file.write_bytes(change(bytearray(file.read_bytes()), dice))

    return spoil


def _place(content: bytearray, dice: Random) -> tuple[int, int]:
    """Where a block of at most 64 bytes begins and ends."""
    start = dice.randrange(len(content))
    return start, min(len(content), start + dice.randint(1, 64))


def _flipped(content: bytearray, dice: Random) -> bytes:
    for _ in range(dice.choice((1, 4, 16))):
        content[dice.randrange(len(content))] ^= 1 << dice.randrange(8)
    return content


def _beginning_flipped(content: bytearray, dice: Random) -> bytes:
    for _ in range(dice.choice((1, 4))):
        content[dice.randrange(min(64, len(content)))] = dice.randrange(256)
    return content


def _zeroed(content: bytearray, dice: Random) -> bytes:
    start, end = _place(content, dice)
    content[start:end] = bytes(end - start)
    return content


def _lost(content: bytearray, dice: Random) -> bytes:
    start, end = _place(content, dice)
    del content[start:end]
    return content


def _inserted(content: bytearray, dice: Random) -> bytes:
    start, _ = _place(content, dice)
    content[start:start] = dice.randbytes(dice.randint(1, 64))
    return content


def _repeated(content: bytearray, dice: Random) -> bytes:
    start, end = _place(content, dice)
    content[start:start] = content[start:end]
    return content


def _cut(content: bytearray, dice: Random) -> bytes:
    return content[: dice.randrange(1, len(content))]


def _many_zeros(content: bytearray, dice: Random) -> bytes:
    return content + bytes(10_000_000)


def _as_folder(file: Path, dice: Random) -> None:
    file.unlink()
    file.mkdir()


def _as_pipe(file: Path, dice: Random) -> None:
    """Reading from it never ends, since nobody writes."""
    file.unlink()
    os.mkfifo(file)


def _as_link(place: str) -> Spoil:
    def spoil(file: Path, dice: Random) -> None:
        file.unlink()
        file.symlink_to(place.format(name=file.name))

    return spoil


BYTES: Mapping[str, Spoil] = {
    "cut short": _changed(_cut),
    "bits flipped": _changed(_flipped),
    "its beginning overwritten": _changed(_beginning_flipped),
    "a block of zeros": _changed(_zeroed),
    "a block lost": _changed(_lost),
    "a block inserted": _changed(_inserted),
    "a block twice": _changed(_repeated),
}
"""Several mutants of each make sense."""

WHOLE: Mapping[str, Spoil] = {
    "empty": _changed(lambda content, dice: b""),
    "one byte": _changed(lambda content, dice: dice.randbytes(1)),
    "junk": _changed(lambda content, dice: dice.randbytes(5000)),
    "NUL bytes": _changed(lambda content, dice: bytes(5000)),
    "ten megabytes of zeros behind it": _changed(_many_zeros),
    "UTF-16": _changed(lambda content, dice: content.decode("utf-8", "replace").encode("utf-16")),
    "a folder": _as_folder,
    "a pipe": _as_pipe,
    "a link to nothing": _as_link("nothing.{name}"),
    "a link to itself": _as_link("{name}"),
    "a link to endless zeros": _as_link("/dev/zero"),
}
"""One mutant of each says it all."""


def restore(good: Path, place: Path) -> None:
    """Put the good file or folder back, whatever has taken its place."""
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    else:
        place.unlink(missing_ok=True)
    if good.is_dir():
        shutil.copytree(good, place)
    else:
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(good, place)
