"""A command in a child of this process, within limits of memory and time, and what a person should not see of it."""

from __future__ import annotations

import contextlib
import io
import json
import multiprocessing
import os
import resource
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from good_files import Desk, snapshot
from joblib.externals.loky import reusable_executor

from steady_ppl.cli import main as command_line

SECONDS = 10  # of the processor
PATIENCE = 4  # times as long by the clock, for what waits
CLIMBING = ("check", "report")  # fit the program at finer steps to what they are given
LONG = 180  # for these, and for a command that searches, climbs to a maximum or starts processes
ROOM = 4 << 30  # bytes of address space beside what the process has when it begins
MOST_MIB = 1024  # that a small file may cost
RESUMABLE = ("checkpoint.safetensors", "journal", "results.parquet")
CALLS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "socket.connect", "urllib.Request")
CHANGES = ("os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.symlink", "os.link", "os.truncate", "shutil.rmtree")
CACHES = ("__pycache__", "torchinductor_")  # of Python, numba and torch
LENT = ("steady-study-", "joblib_memmapping_folder_")  # folders of a study's processes in the system's place for such
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


@dataclass
class Ending:
    """What came of a command: its code, or how it left `main`; what it said, and was heard doing; its memory, MiB."""

    code: int | str
    out: str = ""
    error: str = ""
    heard: list[str] = field(default_factory=list)
    mib: int = 0


def attempt(
    place: Path, words: Sequence[str], strict: bool = True, do: Callable[[list[str]], int] = command_line.main
) -> Ending:
    """Run a command in a folder. One that does not end costs the child its life, and all that it started.

    Args:
        strict: what `main` puts into words at the last moment nobody has thought of: that counts as a crash.
    """
    seconds = LONG if is_long(words) or words[0] in CLIMBING else SECONDS
    reader, writer = multiprocessing.Pipe(duplex=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # threads of libraries, which do not run meanwhile
        child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            os.setpgid(0, 0)
            writer.send(_ended(place, words, seconds, strict, do))
        os._exit(0)
    writer.close()
    try:
        return reader.recv() if reader.poll(PATIENCE * seconds) else Ending(f"no end within {PATIENCE * seconds} s")
    except EOFError:
        return Ending(f"the process died, perhaps after {seconds} s of the processor")
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)


def is_long(words: Sequence[str]) -> bool:
    """Whether a command may compute for minutes on odd but readable input."""
    return words[0] in ("discover", "study") or "likelihood" in words


def _ended(place: Path, words: Sequence[str], seconds: int, strict: bool, do: Callable[[list[str]], int]) -> Ending:
    status = _status()
    resource.setrlimit(resource.RLIMIT_AS, (status["VmSize"] + ROOM,) * 2)
    resource.setrlimit(resource.RLIMIT_CPU, (seconds,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    reusable_executor._executor = None  # its threads stayed behind
    if strict:
        command_line.as_refusal = lambda error: None
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak of the memory
    before, heard, out, error = _status()["VmHWM"], [], io.StringIO(), io.StringIO()
    with contextlib.chdir(place), contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        sys.addaudithook(_listener(place, words[0] == "study", heard))
        try:
            code: int | str = do(list(words))
        except BaseException:
            code = traceback.format_exc()
    heard, mib = list(heard), round((_status()["VmHWM"] - before) / 2**20)
    return Ending(code, out.getvalue(), error.getvalue(), heard, max(0, mib))


def _status() -> Mapping[str, int]:
    """Sizes of this process, bytes."""
    lines = (line.split() for line in Path("/proc/self/status").read_text().splitlines())
    return {words[0].rstrip(":"): 1024 * int(words[1]) for words in lines if words[-1] == "kB"}


def _listener(place: Path, starts: bool, heard: list[str]) -> Callable[[str, tuple[Any, ...]], None]:
    """What the interpreter announces and no command does: files outside changed, code of a run's, others called."""

    def outside(path: Any, through: bool = False) -> bool:
        if not isinstance(path, str | bytes | os.PathLike):
            return False
        named = Path(os.fsdecode(path))
        real = Path(os.path.realpath(named)) if through else Path(os.path.realpath(named.parent), named.name)
        own = any(part.startswith(CACHES + LENT) for part in real.parts)
        return not (real.is_relative_to(place) or real == Path(os.devnull) or own)

    def listen(event: str, said: tuple[Any, ...]) -> None:
        if event == "exec" and Path(file := said[0].co_filename).is_relative_to(place):
            if not Path(file).is_relative_to(place / "models"):
                heard.append(f"code of {file}")
        elif event == "open" and isinstance(said[2], int) and said[2] & WRITING and outside(said[0], through=True):
            heard.append(f"written: {said[0]}")
        elif (event in CHANGES and any(map(outside, said[:2]))) or (event in CALLS and not starts):
            heard.append(f"{event} {said}")

    return listen


def faults(ending: Ending, words: Sequence[str], place: Path, before: Mapping[str, str]) -> list[str]:
    """What a person should not see, and what should not be in the folder."""
    code, error, both = ending.code, ending.error, ending.out + ending.error
    lines = error.splitlines()
    said = {
        f"left main: {str(code)[-1500:]}": code not in (0, 1, 2),
        f"{ending.mib} MiB": ending.mib > MOST_MIB,
        "a traceback": "Traceback" in both,
        "an error that no one has translated": "(--debug shows where)" in error,
        "it failed without a line": code != 0 and not any(line.startswith("steady: ") for line in lines),
        "refused, and printed on stdout": code == 2 and bool(ending.out),
        "a line of more than 2000 characters": any(len(line) > 2000 for line in lines),
        "control characters reach the terminal": any(char in both for char in "\x1b\0"),
    }
    return [fault for fault, holds in said.items() if holds] + ending.heard + _left(place, before, words, code)


def _left(place: Path, before: Mapping[str, str], words: Sequence[str], code: int | str) -> list[str]:
    """Inputs that changed, and what is half-written. A run that a command writes to is its own."""
    after = snapshot(place)
    target = words[words.index("--out") + 1] if "--out" in words else "out"
    own = target if words[0] in ("fit", "discover", "study") and target in before else None
    resumable = any((place / target / name).exists() for name in RESUMABLE)
    new = [name for name in after if name not in before]
    mine = [name for name in new if code and not ((resumable and name.startswith(target)) or _below(name, own))]
    return [
        *(f"input {n} changed" for n in before if after.get(n) != before[n] and not _below(n, own)),
        *(f"left over: {n}" for n in new if Path(n).name.startswith(".") or "previous" in Path(n).parts),
        *(f"half-written: {name}" for name in mine),
        *(["the old run is not as it was"] if code and "--force" in words and before.items() - after.items() else []),
        *(f"{name} is broken" for name in new if _is_broken(place / name)),
    ]


def _below(name: str, own: str | None) -> bool:
    return own is not None and Path(name).is_relative_to(own)


def _is_broken(file: Path) -> bool:
    """JSON that is none, a page that does not end."""
    try:
        if file.suffix == ".json" and file.is_file():
            json.loads(file.read_text())
        return file.suffix == ".html" and not file.read_text().rstrip().endswith("</html>")
    except ValueError:
        return True


def tried(desk: Desk, words: Sequence[str], **options: Any) -> tuple[Ending, list[str]]:
    """What came of a command on the desk as it is, which is good again afterwards, and what was wrong."""
    before = snapshot(desk.place)
    try:
        ending = attempt(desk.place, words, **options)
        return ending, faults(ending, words, desk.place, before)
    finally:
        desk.tidy()
