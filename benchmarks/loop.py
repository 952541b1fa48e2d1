"""Seconds and peak memory of each step of the loop, with empty caches of kernels and warm, and beside another engine.

    python benchmarks/loop.py [--sizes 16x101 64x301 300x101] [--cases boat truck mrclam] [--steps fit check …]
        [--warm 3] [--against FOLDER] [--beside N] [--profile FOLDER] [--results [FILE]]

Drives of `HovercraftTruth` are given to `models/hovercraft.py`, which lacks two effects: so many to fit, as many to
choose by, 32 to prove, of so many rows. Every run is a process of its own, as a person's shell starts it: no variable
says how many threads it may take. A step's caches of machine code are empty at first ("cold"), and full in the runs
after it ("warm", the median). Of a command the whole process is timed, its imports with it; of `maximise` and `refit`
only the call, before which `refit` has fitted the program as it is. Peak memory is the process's.

`--against` runs the same steps with the engine of another checkout, in turns, with the same tables and programs.
`--profile` runs every command once more and writes where its time goes, for `python -m pstats`.
`--beside` keeps other cores busy. Records are kept, and what is there is left out, with `--results` alone.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import loop_steps
from loop_steps import DRIVES, ROOT, STEPS, Case, Step, cases, sized, words_of
from resumable import Record, digest, run

RESULTS = ROOT / "benchmarks" / "results" / "loop.jsonl"
MEBI = 2**20 if sys.platform == "darwin" else 2**10  # units of `ru_maxrss` in a MiB
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
BUSY = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"


def environment(engine: Path, caches: Path) -> dict[str, str]:
    """Of a process that imports the engine of this checkout, keeps machine code in a folder and is told no threads."""
    own = {name: value for name, value in os.environ.items() if name not in THREADS}
    kept = {"STEADY_KERNEL_CACHE": str(caches / "kernels"), "NUMBA_CACHE_DIR": str(caches / "numba")}
    return {**own, **kept, "PYTHONPATH": str(engine), "MPLBACKEND": "Agg"}


def measured(words: Sequence[str], folder: Path, environ: Mapping[str, str], *, whole_output: bool = False) -> Record:
    """Run Python with these words: seconds by the wall and of the processor, peak memory in MiB, what it says at first.

    With `whole_output` it is all that it says, and `noted` has what came on stderr.

    A process counts the memory of the one that starts it as well; this one loads no torch.
    """
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as error:
        began = time.perf_counter()
        process = subprocess.Popen([sys.executable, *words], cwd=folder, env=environ, stdout=out, stderr=error)
        try:
            _, status, used = os.wait4(process.pid, 0)
        except BaseException:
            process.kill()
            process.wait()
            raise
        wall, process.returncode = time.perf_counter() - began, os.waitstatus_to_exitcode(status)
        out.seek(0), error.seek(0)
        said, complaint = out.read(), error.read()
    if process.returncode:
        raise RuntimeError(f"exit code {process.returncode}: {complaint.strip()[-300:]}")
    whole = {"wall": wall, "cpu": used.ru_utime + used.ru_stime, "peak": used.ru_maxrss / MEBI}
    if said.startswith('{"wall"'):  # the part that counts
        return whole | json.loads(said) | {"process": wall}
    if whole_output:
        return whole | {"said": said, "noted": complaint}
    return whole | {"said": " ".join(said.split())[:160]}


def work(
    name: str,
    case: Case,
    engines: dict[str, Path],
    desk: Path,
    warm: int,
    seed: int,
    beside: int,
    profile: Path | None = None,
) -> Record:
    """The record of a step: a cold run and warm ones of every engine, in turns."""
    step, place = STEPS[name], desk / case.name
    spare = desk / "caches"  # of what is not timed
    if not (place / "test.csv").exists():
        place.mkdir(exist_ok=True)
        measured(["-c", case.tables, *case.arguments], place, environment(ROOT, spare))
    runs: dict[str, Any] = {engine: [] for engine in engines}
    for turn in range(warm + 1):
        for engine in list(engines)[:: 1 if turn % 2 == 0 else -1]:
            folder, caches = place / engine, desk / f"{case.name} {name} {engine}"
            try:
                if turn == 0:
                    folder.mkdir(exist_ok=True)
                    caches.mkdir()
                    _prepare(step, case, folder, environment(engines[engine], spare), seed)
                if isinstance(runs[engine], list):
                    environ = environment(engines[engine], caches)
                    runs[engine].append(measured(words_of(step, case, seed), folder, environ))
            except RuntimeError as error:
                if engine == "new":
                    raise
                runs[engine] = f"{error}"
    if profile is not None and not step.source:
        told = ["-m", "cProfile", "-o", str(profile / f"{case.name}-{name}.prof"), *words_of(step, case, seed)]
        measured(told, place / "new", environment(ROOT, desk / f"{case.name} {name} new"))
    commits = {engine: commit(folder) for engine, folder in engines.items()}
    return {"step": name, "commits": commits, "seeds": [*DRIVES, seed], "beside": beside, "runs": runs}


def _prepare(step: Step, case: Case, folder: Path, environ: Mapping[str, str], seed: int) -> None:
    """Make the runs that a step needs, where there are none."""
    for need in (STEPS[name] for name in step.needs):
        _prepare(need, case, folder, environ, seed)
        if not (folder / need.makes).exists():
            measured(words_of(need, case, seed), folder, environ)


def commit(folder: Path) -> str:
    """Of a checkout, with a + where its engine differs from it."""
    git = ["git", "-C", str(folder)]
    head = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    changed = subprocess.run([*git, "status", "--porcelain", "steady_ppl"], capture_output=True, text=True).stdout
    return (head or "unknown") + "+" * bool(changed)


def _make_ready(engine: Path) -> None:
    """Compile the Python of a checkout's engine, so that no step does; exit where that engine is not what runs."""
    subprocess.run([sys.executable, "-m", "compileall", "-q", str(engine / "steady_ppl")], check=True)
    found = measured(["-c", "import steady_ppl; print(steady_ppl.__file__)"], ROOT.parent, environment(engine, engine))
    if Path(found["said"]).parent != engine / "steady_ppl":
        raise SystemExit(f"{engine} has no engine: {found['said']} would run")


@contextmanager
def busy(count: int) -> Iterator[list[int]]:
    """So many busy loops beside the block; their process ids. They end with it, or with this process."""
    loops = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(count)]
    try:
        yield [loop.pid for loop in loops]
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def figure(runs: Sequence[Record], name: str, *, cold: bool = False) -> float:
    """Of the cold run, or the median of the warm ones."""
    return float(runs[0][name] if cold else statistics.median(one[name] for one in runs[1:] or runs))


def row(record: Record) -> str:
    """A step's line of the table."""
    case, name = record["set"].split()
    title = STEPS[name].title
    if "failed" in record:
        return f"| {case} | {title} | {record['failed'][-120:]} |"
    new, old = record["runs"]["new"], record["runs"].get("old")
    cells = [f"{figure(new, 'wall', cold=cold):.2f} ({figure(new, 'cpu', cold=cold):.2f})" for cold in (True, False)]
    cells.append(f"{figure(new, 'peak'):.0f}")
    if isinstance(old, str):
        cells.append(f"old: {old.splitlines()[-1][-120:]}")
    elif old:
        kinds = (("wall", True), ("cpu", True), ("wall", False), ("cpu", False), ("peak", False))
        cells += [f"{figure(old, kind, cold=cold) / figure(new, kind, cold=cold):.2f}" for kind, cold in kinds]
        cells.append("" if old[0].get("said") == new[0].get("said") else "other words")
    return f"| {case} | {title} | {' | '.join(cells)} |"


def table(records: Sequence[Record], skipped: Sequence[str], against: bool, beside: int) -> str:
    """What is measured, in Markdown."""
    commits: dict[str, str] = next((record["commits"] for record in records if "commits" in record), {})
    of = ", ".join(f"{engine} {sha}" for engine, sha in commits.items())
    heads = ["case", "step", "cold: s (CPU s)", "warm: s (CPU s)", "peak MiB"]
    heads += ["old/new: cold", "cold CPU", "warm", "warm CPU", "peak", "says"] if against else []
    lines = [f"Commits: {of}; {beside} busy loops beside; seeds in the records.", ""]
    lines += [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *map(row, records)]
    return "\n".join([*lines, "", *skipped]).rstrip() + "\n"


def said(record: Record) -> str:
    """A record in a few words, as it is done."""
    cold, warm = (figure(record["runs"]["new"], "wall", cold=cold) for cold in (True, False))
    return f"{cold:.2f} s cold, {warm:.2f} s warm"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="*", default=["16x101"], help="DRIVESxROWS of the hovercraft")
    parser.add_argument("--cases", nargs="*", default=[], choices=[case.name for case in cases(Path())])
    parser.add_argument("--steps", nargs="*", default=[*STEPS], choices=[*STEPS])
    parser.add_argument("--warm", type=int, default=3, help="warm runs of each step")
    parser.add_argument("--seed", type=int, default=0, help="of the commands")
    parser.add_argument("--against", type=Path, help="another checkout")
    parser.add_argument("--beside", type=int, default=0, help="busy loops")
    parser.add_argument("--profile", type=Path, help="an existing folder for a profile of each command")
    parser.add_argument("--shared", type=Path, default=ROOT.parent / "shared", help="where the data of cases are")
    parser.add_argument("--results", type=Path, nargs="?", const=RESULTS, help="keep the records, and the table (.md)")
    chosen = parser.parse_args(arguments)
    engines = {"new": ROOT} | ({"old": chosen.against.resolve()} if chosen.against else {})
    others = {case.name: case for case in cases(chosen.shared.resolve())}
    wanted = [*map(sized, chosen.sizes), *(others[name] for name in chosen.cases)]
    skipped = [f"{case.name} is skipped: there is no {case.data}." for case in wanted if case.is_absent]
    sources = [file for folder in engines.values() for file in (folder / "steady_ppl").rglob("*.py")]
    for folder in engines.values():
        _make_ready(folder)
    with tempfile.TemporaryDirectory() as room, busy(chosen.beside):
        profile = chosen.profile and chosen.profile.resolve()
        rest = (engines, Path(room), chosen.warm, chosen.seed, chosen.beside, profile)
        jobs: dict[str, tuple[Any, ...]] = {
            f"{case.name} {step}": (step, case, *rest)
            for case in wanted
            if not case.is_absent
            for step in case.steps
            if step in chosen.steps
        }
        file = chosen.results or Path(room) / "loop.jsonl"
        made = digest(files=[*sources, Path(__file__), Path(loop_steps.__file__)])
        version = f"{made} {chosen.warm} {chosen.seed} {chosen.beside}"
        records = run(work, jobs, file, version=version, workers=1, said=said)
        text = table(records, skipped, "old" in engines, chosen.beside)
        if chosen.results:
            file.with_suffix(".md").write_text(text)
    print(text)
    return int(any("failed" in record for record in records))


if __name__ == "__main__":
    sys.exit(main())
