"""What can be wrong in JSON and in safetensors, which begin with JSON: values, keys, nesting, claims of size."""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Callable, Iterable, Mapping
from functools import reduce
from operator import getitem
from typing import Any

from hypothesis import strategies as st
from mutants import Change, of_text, spelt

ODD: tuple[Any, ...] = (
    None, True, False, 0, -1, 2, 1e300, -1e300, 10**30, math.nan, math.inf, "", "x", "nan", "1", [], {}, [[]], [None],
    [1, 2, 3], ["a"], {"a": 1}, [{}], "x" * 100_000, "../" * 40 + "etc/passwd", "/dev/zero", "\x1b[2J\x1b[31m", "\0",
    "<script>alert(1)</script>", "\ud800", "a\nb", "🚗" * 50, [[[[[[1]]]]]],
)  # fmt: skip
leaves = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20)
odd = st.sampled_from(ODD) | st.recursive(
    leaves, lambda one: st.lists(one) | st.dictionaries(st.text(max_size=9), one), max_leaves=5
)
odd_keys = st.sampled_from([str(value)[:1000] for value in ODD]) | st.text(max_size=20)
JsonChange = Callable[[st.DrawFn, Any], Any]


def _json(change: JsonChange) -> Change:
    return of_text(lambda draw, text: json.dumps(change(draw, json.loads(text))))


def places(content: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The ways to every value within, that of the whole first."""
    inner = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    return [here, *(place for key, value in inner for place in places(value, (*here, key)))]


def at(content: Any, place: Iterable[Any]) -> Any:
    """The value to which a way leads."""
    return reduce(getitem, place, content)


def _place(draw: st.DrawFn, content: Any) -> tuple[Any, Any]:
    """A dict or list and a key of it, the upper level as often as all that lie deeper."""
    every = places(content)[1:]
    *path, last = draw(st.sampled_from([place for place in every if len(place) == 1]) | st.sampled_from(every))
    return at(content, path), last


def _odd_value(draw: st.DrawFn, content: Any) -> Any:
    where, key = _place(draw, content)
    where[key] = draw(odd)
    return content


def _key_lost(draw: st.DrawFn, content: Any) -> Any:
    where, key = _place(draw, content)
    del where[key]
    return content


def _everywhere(kind: str, value: str) -> Change:
    """Every value of a kind, by what it looks like, becomes another one."""
    return spelt(lambda text: re.sub(rf"(?<=[\s\[]){kind}(?=[,\n\]}}])", value, text))


def _first(value: str) -> Change:
    """A key before all others, with a value as it is written."""
    return spelt(lambda text: text.replace("{", f'{{"a": {value}, ', 1))


JSON: Mapping[str, Change] = {
    "another value": _json(_odd_value),
    "a key lost": _json(_key_lost),
    "another kind": _json(lambda draw, content: draw(odd)),
    "a key too many": _json(lambda draw, content: content | {draw(odd_keys): draw(odd)}),
    "nested 100,000 deep": spelt(lambda text: "[" * 100_000),
    "nested in a value": _first("[" * 50_000 + "]" * 50_000),
    "a number of 10,000 digits": _first("9" * 10_000),
    "two documents": spelt(lambda text: text + text),
    "every number NaN": _everywhere(r"-?\d[\d.e+-]*", "NaN"),
    "every number 1e300": _everywhere(r"-?\d[\d.e+-]*", "1e300"),
    "every word HTML": _everywhere(r'"[^"]*"', '"<img src=x onerror=alert(1)>"'),
}


def _payload(draw: st.DrawFn, content: Any) -> Any:
    """The program is another file with the same text, which lies in a run folder."""
    content["program"]["file"] = draw(
        st.sampled_from(["payload.py", "./payload.py", "../before/payload.py", "../models/../before/payload.py"])
    )
    return content


RECORD = {**JSON, "a program in the run": _json(_payload)}


def _split(content: bytes) -> tuple[Any, bytes]:
    """A safetensors file's header, and its numbers."""
    (length,) = struct.unpack("<Q", content[:8])
    return json.loads(content[8 : 8 + length]), content[8 + length :]


def _header(change: JsonChange) -> Change:
    """A header that says something else of the same numbers."""

    def changed(draw: st.DrawFn, content: bytes) -> bytes:
        header, numbers = _split(content)
        text = json.dumps(change(draw, header)).encode()
        return struct.pack("<Q", len(text)) + text + numbers

    return changed


def _values(value: float) -> Change:
    """Some or all of the single-precision numbers become another one."""

    def changed(draw: st.DrawFn, content: bytes) -> bytes:
        numbers = len(_split(content)[1]) // 4
        now, start = bytearray(content), len(content) - 4 * numbers
        for i in draw(st.just(range(numbers)) | st.sets(st.integers(0, numbers - 1), min_size=1)):
            now[start + 4 * i : start + 4 * i + 4] = struct.pack("<f", value)
        return bytes(now)

    return changed


def _claims(length: int) -> Change:
    return lambda draw, content: struct.pack("<Q", length) + content[8:]


TEXTS = ("", "null", "[]", "-1", "1e300", "nan", '"word"', "{", "[" * 50_000, '{"values": 3}')
SHAPES = (
    [], [1], [0], [2**40], [-1], [3, 3], "F64", "I64", "BOOL", "F16", "C64", [0, 2**50], [4, 0], [0, 0], None,
)  # fmt: skip


def _text(draw: st.DrawFn, header: Any) -> Any:
    """Another text beside the tensors, or one less."""
    texts = header.get("__metadata__", {})
    name, now = draw(st.sampled_from(sorted(texts) or ["step"])), draw(st.none() | st.sampled_from(TEXTS))
    kept = {key: text for key, text in texts.items() if key != name}
    return header | {"__metadata__": kept if now is None else kept | {name: now}}


def _tensor(draw: st.DrawFn, header: Any) -> str:
    return draw(st.sampled_from(sorted(name for name in header if name != "__metadata__")))


def _shape(draw: st.DrawFn, header: Any) -> Any:
    header[_tensor(draw, header)][draw(st.sampled_from(("shape", "dtype", "data_offsets")))] = draw(
        st.sampled_from(SHAPES)
    )
    return header


def _name(draw: st.DrawFn, header: Any) -> Any:
    name = _tensor(draw, header)
    now = draw(odd_keys | st.sampled_from((f"odd/{name}", f"optimizer/{name}")))
    return {now if key == name else key: value for key, value in header.items()}


TENSORS: Mapping[str, Change] = {
    "another header": _header(_odd_value),
    "a tensor lost": _header(_key_lost),
    "another shape": _header(_shape),
    "another name": _header(_name),
    "another text": _header(_text),
    "NaN": _values(math.nan),
    "infinity": _values(math.inf),
    "3e38": _values(3e38),
    "-1e5": _values(-1e5),
    "a header of 2^63 bytes": _claims(2**63),
    "a header of 2^40 bytes": _claims(2**40),
    "a header of 100 megabytes": _claims(100_000_000),
    "a header of no bytes": _claims(0),
}
