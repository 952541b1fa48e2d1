"""One process that puts mutants through commands, one after another, and says what came of each.

    python benchmarks/hostile_worker.py FOLDER     names of trials on stdin, a line of JSON each on stdout

Its address space is limited: what wants more fails here, not on the machine. The peak of its
memory is measured anew for each trial.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import resource
import shutil
import stat
import sys
import time
import traceback
from pathlib import Path
from typing import Any

from hostile_bytes import restore
from hostile_trials import Trial, trials

from steady_ppl.cli import main as command_line
from steady_ppl.cli.main import main

command_line.as_refusal = lambda error: None  # what main puts into words at the last moment nobody has thought of
ROOM = 4 << 30  # bytes of address space beside what the process has when it begins
BIG = 5_000_000  # what is said beyond is cut
RESUMABLE = ("checkpoint.safetensors", "journal", "results.parquet")


def attempt(folder: Path, trial: Trial) -> dict[str, Any]:
    """What came of a trial, in a copy of the good files that is as before afterwards.

    Args:
        folder: holds `good` and the copy `desk`.
    """
    desk, good = folder / "desk", folder / "good"
    trial.make(desk)
    before = snapshot(desk)
    out, error = io.StringIO(), io.StringIO()
    base = _reset_peak()
    began = time.perf_counter()
    with contextlib.chdir(desk), contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        try:
            code: int | str = main(list(trial.words))
        except BaseException:
            code = traceback.format_exc()
    seconds, peak = time.perf_counter() - began, _peak() - base
    faults = _faults(code, error.getvalue(), out.getvalue()) + _left(desk, before, snapshot(desk), trial, code)
    _tidy(desk, good, before)
    said = [line for line in error.getvalue()[:BIG].splitlines() if line.startswith("steady: ")]
    outcome = "crashed" if faults else {0: "accepted", 2: "refused"}.get(code, "failed with a line")  # type: ignore[arg-type]
    return {
        "outcome": outcome,
        "faults": faults,
        "seconds": round(seconds, 3),
        "mib": max(0, round(peak / 2**20)),
        "said": (said[-1] if said else "")[:300],
    }


def _faults(code: int | str, error: str, out: str) -> list[str]:
    """What a person should not see; an error that no one has translated is a crash in a coat."""
    faults = []
    if code not in (0, 1, 2):
        faults.append(f"left main: {str(code)[-1500:]}")
    if "Traceback" in error + out:
        faults.append("a traceback")
    faults += [line[:300] for line in error.splitlines() if "(--debug shows where)" in line]
    if code != 0 and not any(line.startswith("steady: ") for line in error.splitlines()):
        faults.append("it failed without a line")
    if code == 2 and out:
        faults.append("refused, and printed on stdout")
    if any(len(line) > 2000 for line in error.splitlines()):
        faults.append("a line of more than 2000 characters")
    if any(char in error + out for char in "\x1b\0"):
        faults.append("control characters of a file reach the terminal")
    return faults


def snapshot(folder: Path) -> dict[str, str]:
    """A hash of every file below a folder; pipes and links by what they are."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name, mode = str(path.relative_to(folder)), path.lstat().st_mode
        if "__pycache__" in path.parts:
            continue
        if stat.S_ISREG(mode):
            found[name] = hashlib.blake2b(path.read_bytes()).hexdigest()
        else:
            found[name] = os.readlink(path) if stat.S_ISLNK(mode) else str(stat.S_IFMT(mode))
    return found


def _left(desk: Path, before: dict[str, str], after: dict[str, str], trial: Trial, code: int | str) -> list[str]:
    """Inputs that changed, and what is half-written."""
    own = next((word for word in ("begun", "searched", "before", "studied") if _writes_to(trial, word)), None)
    mine = [name for name in after.keys() | before.keys() if own is None or not name.startswith(f"{own}/")]
    faults = [f"input {name} changed" for name in mine if name in before and after.get(name) != before[name]]
    new = [name for name in after if name not in before and name != "out"]
    faults += [
        f"left over: {name}" for name in new if Path(name).name.startswith(".") or "previous" in Path(name).parts
    ]
    if code != 0:
        there = [place for place in ("out/run", "out/study") if _resumable(desk / place)]
        kept = [name for name in new if not name.startswith(tuple(there))]
        faults += [f"half-written: {name}" for name in kept if own is None or not name.startswith(f"{own}/")]
        if own == "before" and {k: v for k, v in after.items() if k not in new} != before:
            faults.append("--force failed and the old run is not as it was")
    return faults + [fault for name in new for fault in _unreadable(desk / name)]


def _writes_to(trial: Trial, run: str) -> bool:
    words = trial.words
    return words[0] in ("fit", "discover", "study") and "--out" in words and words[words.index("--out") + 1] == run


def _resumable(run: Path) -> bool:
    return any((run / name).exists() for name in RESUMABLE)


def _unreadable(file: Path) -> list[str]:
    """JSON that is none, a page that does not end."""
    if not file.is_file():
        return []
    if file.suffix == ".json":
        try:
            json.loads(file.read_text())
        except ValueError:
            return [f"{file.name} is no JSON"]
    if file.suffix == ".html" and not file.read_text().rstrip().endswith("</html>"):
        return [f"{file.name} does not end"]
    return []


def _tidy(desk: Path, good: Path, before: dict[str, str]) -> None:
    """Everything as it was."""
    now, wanted = snapshot(desk), snapshot(good)
    for name in sorted(now.keys() - wanted.keys(), reverse=True):
        place = desk / name
        if place.is_dir() and not place.is_symlink():
            shutil.rmtree(place)
        else:
            place.unlink(missing_ok=True)
    for name in sorted(wanted):
        if now.get(name) != wanted[name]:
            restore(good / name, desk / name)
    (desk / "out").mkdir(exist_ok=True)


def _reset_peak() -> int:
    """Forget the peak of the process's memory; what it has now, bytes."""
    Path("/proc/self/clear_refs").write_text("5")
    return _peak()


def _peak() -> int:
    words = Path("/proc/self/status").read_text().split()
    return 1024 * int(words[words.index("VmHWM:") + 1])


def fresh(folder: Path) -> None:
    """A copy of the good files to spoil."""
    shutil.rmtree(folder / "desk", ignore_errors=True)
    shutil.copytree(folder / "good", folder / "desk")
    (folder / "desk" / "out").mkdir(exist_ok=True)


def serve(folder: Path) -> None:
    """Answer names of trials until there are none."""
    known = {trial.name: trial for trial in trials()}
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    fresh(folder)
    warmed: set[tuple[str, ...]] = set()
    words = Path("/proc/self/status").read_text().split()
    size = 1024 * int(words[words.index("VmSize:") + 1])
    resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, size + ROOM))
    for line in sys.stdin:
        trial = known[json.loads(line)]
        if trial.words not in warmed:
            warmed.add(trial.words)
            _warm(folder, trial, answers)
        print(json.dumps({"begins": trial.name}), file=answers, flush=True)
        print(json.dumps(attempt(folder, trial)), file=answers, flush=True)


def _warm(folder: Path, trial: Trial, answers: Any) -> None:
    """The command on good input first: what is imported and compiled then is not the mutant's fault."""
    good = Trial(trial.kind, trial.file, "as it is", 0, trial.command, trial.words, lambda file, dice: None)
    found = attempt(folder, good)
    if found["outcome"] != "accepted":
        print(json.dumps({"broken": f"{good.name}: {found}"}), file=answers, flush=True)


if __name__ == "__main__":
    serve(Path(sys.argv[1]).resolve())
