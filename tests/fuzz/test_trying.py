"""The fuzzer sees what it is for: every kind of fault, made on purpose."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import trying
from good_files import snapshot
from trying import attempt, faults


def said(code: int, error: str = "", out: str = "") -> Callable[[list[str]], int]:
    def do(words: list[str]) -> int:
        sys.stderr.write(error)
        sys.stdout.write(out)
        return code

    return do


def wrote(name: str, text: str = "", code: int = 0) -> Callable[[list[str]], int]:
    def do(words: list[str]) -> int:
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(text)
        return said(code, "steady: no\n")(words)

    return do


FAULTS = {
    "left main": lambda words: [][0],
    "it failed without a line": said(1, "no\n"),
    "no one has translated": said(1, "steady: KeyError: 'a' (--debug shows where)\n"),
    "a traceback": said(1, "steady: no\nTraceback (most recent call last):\n"),
    "printed on stdout": said(2, "steady: no\n", "yes"),
    "more than 2000 characters": said(2, f"steady: {'n' * 2000}\n"),
    "control characters": said(0, out="\x1b[2J"),
    "input t.csv changed": wrote("t.csv", "spoiled"),
    "half-written: out": wrote("out/page.html", "</html>", 1),
    "left over": wrote("out/.1234.partial"),
    "page.html is broken": wrote("out/page.html", "<html>"),
    "errors.json is broken": wrote("out/errors.json", "{"),
    "written: ": wrote("../outside.csv"),
    "code of ": lambda words: exec(compile("x = 1", str(Path("run/payload.py").resolve()), "exec")) or 0,
    "subprocess.Popen": lambda words: subprocess.run(["true"]).returncode,
    " MiB": lambda words: len(b"x" * (400 << 20)) * 0,
    "MemoryError": lambda words: len(bytearray(8 << 30)) * 0,
    "no end within": lambda words: time.sleep(60) or 0,
    "the process died": lambda words: sum(iter(lambda: 0, 1)),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", list(FAULTS))
def test_a_fault_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str) -> None:
    for limit, value in {"MOST_MIB": 20, "SECONDS": 1, "LONG": 1, "PATIENCE": 3}.items():
        monkeypatch.setattr(trying, limit, value)
    place = tmp_path / "desk"
    place.mkdir()
    (place / "t.csv").write_text("good")
    before, words = snapshot(place), ("check", "run", "t.csv")
    found = faults(attempt(place, words, do=FAULTS[fault]), words, place, before)
    assert any(fault in one for one in found), found
    assert faults(attempt(place, words, do=said(2, "steady: no\n")), words, place, snapshot(place)) == []
