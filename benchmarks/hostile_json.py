"""What can be wrong in JSON and in safetensors, which begin with JSON: values, keys, nesting, claims of size."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random
from typing import Any

from hostile_bytes import Spoil

ODD: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 2, 1e300, -1e300, 10**30, float("nan"), float("inf"), "", "x", "nan", "1", [], {}),
    *([[]], [None], [1, 2, 3], ["a"], {"a": 1}, [{}], "x" * 100_000, "../" * 40 + "etc/passwd", "/dev/zero"),
    *("<script>alert(1)</script>", "\x1b[2J\x1b[31m", "\0", "\ud800", "a\nb", "🚗" * 50, [[[[[[1]]]]]]),
)
"""What stands where something else is expected."""


def places(content: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The ways to every value within, that of the whole first."""
    inner = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    return [here, *(place for key, value in inner for place in places(value, (*here, key)))]


def _at(content: Any, place: tuple[Any, ...]) -> Any:
    for key in place:
        content = content[key]
    return content


def odd_value(content: Any, dice: Random) -> Any:
    """Another value somewhere, upper levels as often as all that lie deeper."""
    every = places(content)[1:]
    shallow = [place for place in every if len(place) == 1]
    place = dice.choice(shallow if dice.random() < 0.5 else every)
    _at(content, place[:-1])[place[-1]] = dice.choice(ODD)
    return content


def key_lost(content: Any, dice: Random) -> Any:
    """A key, or an element of a list, is gone."""
    every = places(content)[1:]
    shallow = [place for place in every if len(place) == 1]
    place = dice.choice(shallow if dice.random() < 0.5 else every)
    del _at(content, place[:-1])[place[-1]]
    return content


def another_kind(content: Any, dice: Random) -> Any:
    """Something else altogether."""
    return dice.choice(ODD)


def odd_key(content: Any, dice: Random) -> Any:
    """One key too many."""
    content[dice.choice([str(value)[:1000] for value in ODD])] = dice.choice(ODD)
    return content


CHANGES: Mapping[str, Callable[[Any, Random], Any]] = {
    "another value": odd_value,
    "a key lost": key_lost,
    "another kind": another_kind,
    "a key too many": odd_key,
}


def _rewritten(change: Callable[[Any, Random], Any]) -> Spoil:
    def spoil(file: Path, dice: Random) -> None:
        file.write_text(json.dumps(change(json.loads(file.read_text()), dice)))

    return spoil


def _text(make: Callable[[str, Random], str]) -> Spoil:
    def spoil(file: Path, dice: Random) -> None:
        file.write_text(make(file.read_text(), dice))

    return spoil


JSON: Mapping[str, Spoil] = {name: _rewritten(change) for name, change in CHANGES.items()}
JSON_ONCE: Mapping[str, Spoil] = {
    "nested 100,000 deep": _text(lambda text, dice: "[" * 100_000),
    "nested in a value": _text(lambda text, dice: text.replace("{", '{"a": ' + "[" * 50_000 + "]" * 50_000 + ", ", 1)),
    "a number of 10,000 digits": _text(lambda text, dice: text.replace("{", '{"a": ' + "9" * 10_000 + ", ", 1)),
    "two documents": _text(lambda text, dice: text + text),
    "every number NaN": _rewritten(lambda content, dice: _numbers(content, float("nan"))),
    "every number 1e300": _rewritten(lambda content, dice: _numbers(content, 1e300)),
    "every word HTML": _rewritten(lambda content, dice: _words(content, "<img src=x onerror=alert(1)>")),
}


def _numbers(content: Any, value: float) -> Any:
    if isinstance(content, dict):
        return {key: _numbers(inner, value) for key, inner in content.items()}
    if isinstance(content, list):
        return [_numbers(inner, value) for inner in content]
    return value if isinstance(content, int | float) and not isinstance(content, bool) else content


def _words(content: Any, word: str) -> Any:
    if isinstance(content, dict):
        return {key: _words(inner, word) for key, inner in content.items()}
    if isinstance(content, list):
        return [_words(inner, word) for inner in content]
    return word if isinstance(content, str) else content


def _header(change: Callable[[Any, Random], Any]) -> Spoil:
    """A safetensors file whose header says something else of the same bytes."""

    def spoil(file: Path, dice: Random) -> None:
        content = file.read_bytes()
        (length,) = struct.unpack("<Q", content[:8])
        text = json.dumps(change(json.loads(content[8 : 8 + length]), dice)).encode()
        file.write_bytes(struct.pack("<Q", len(text)) + text + content[8 + length :])

    return spoil


def _claims(length: int) -> Spoil:
    def spoil(file: Path, dice: Random) -> None:
        file.write_bytes(struct.pack("<Q", length) + file.read_bytes()[8:])

    return spoil


def _values(value: float) -> Spoil:
    """Some or all of the single-precision numbers become another one."""

    def spoil(file: Path, dice: Random) -> None:
        content = bytearray(file.read_bytes())
        start = 8 + struct.unpack("<Q", content[:8])[0]
        whole = dice.random() < 0.5
        for at in range(start, len(content) - 3, 4):
            if whole or dice.random() < 0.3:
                content[at : at + 4] = struct.pack("<f", value)
        file.write_bytes(content)

    return spoil


def _said(content: Any, dice: Random) -> Any:
    """Another text beside the tensors."""
    texts = content.get("__metadata__", {})
    name = dice.choice(sorted(texts) or ["step"])
    texts[name] = dice.choice(["", "null", "[]", "-1", "1e300", "nan", '"word"', "{", "[" * 50_000, '{"values": 3}'])
    if dice.random() < 0.2:
        del texts[name]
    return content | {"__metadata__": texts}


def _another_shape(content: Any, dice: Random) -> Any:
    entry = content[dice.choice(sorted(name for name in content if name != "__metadata__"))]
    entry[dice.choice(["shape", "dtype", "data_offsets"])] = dice.choice(
        [[], [1], [0], [2**40], [-1], [3, 3], "F64", "I64", "BOOL", "F16", "C64", [0, 2**50], [4, 0], [0, 0], None]
    )
    return content


def _other_name(content: Any, dice: Random) -> Any:
    name = dice.choice(sorted(name for name in content if name != "__metadata__"))
    content[dice.choice([*(str(value)[:200] for value in ODD), f"odd/{name}", f"optimizer/{name}"])] = content.pop(name)
    return content


TENSORS: Mapping[str, Spoil] = {
    "another header": _header(odd_value),
    "a tensor lost": _header(key_lost),
    "another shape": _header(_another_shape),
    "another name": _header(_other_name),
    "another text": _header(_said),
    "NaN": _values(float("nan")),
    "infinity": _values(float("inf")),
    "3e38": _values(3e38),
    "-1e5": _values(-1e5),
}
TENSORS_ONCE: Mapping[str, Spoil] = {
    "a header of 2^63 bytes": _claims(2**63),
    "a header of 2^40 bytes": _claims(2**40),
    "a header of 100 megabytes": _claims(100_000_000),
    "a header of no bytes": _claims(0),
}
