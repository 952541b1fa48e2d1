"""Broken and hostile files through every command that takes them: what is refused, what crashes, what hangs.

    python benchmarks/hostile.py             all mutants: results/hostile.md, results/hostile.jsonl
    python benchmarks/hostile.py --quick     one command of every twentieth mutant; judges alike, writes nothing
    python benchmarks/hostile.py --again     what crashed, hung or is new; the stored records of the others are kept
    python benchmarks/hostile.py --only TEXT      the trials whose names hold the text, each with what it said

A mutant is a good file that was spoiled: a table, a run folder's files, a search's journal, a ROS bag, a mapping, a
log, a program. Everything follows from its name. A command may accept it, refuse it (exit code 2), or fail with a line
that says why (exit code 1), and it says so by an error of `steady_ppl.errors`. It crashes where the line is that of
any other exception, where an input changed, or where something half-written is left; it hangs after ten seconds and is
killed; a search, a study, and a fit to the maximum, of odd but readable input may take three minutes. Exits with 1 if
one did.
"""

from __future__ import annotations

import argparse
import json
import os
import selectors
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hostile_desk import lay
from hostile_trials import Trial, trials

HERE = Path(__file__).resolve().parent
LIMIT = 10.0  # s for one trial
LONG = 180.0  # s for one whose command searches, climbs to a maximum or starts processes, on odd but readable input
SEARCHES = ("discover", "fit --recipe likelihood", "study")
WARMING = 120.0  # s for a worker to begin, or for a command on good input for the first time
MOST_MIB = 1024  # that a small file may cost
OUTCOMES = ("accepted", "refused", "failed with a line", "crashed", "hung")


class Worker:
    """A process that does trials, and another one after it was killed."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.process = folder, None
        self.pending = b""

    def attempt(self, trial: Trial) -> dict[str, Any]:
        """What came of it; a trial that does not end costs the process its life."""
        if self.process is None:
            self._start()
        assert self.process is not None and self.process.stdin is not None
        self.process.stdin.write(json.dumps(trial.name).encode() + b"\n")
        self.process.stdin.flush()
        answer = self._answer(WARMING)
        if "broken" in answer:
            raise SystemExit(f"a good input is not accepted: {answer['broken']}")
        if "begins" in answer:
            began = time.perf_counter()
            limit = LONG if trial.command.startswith(SEARCHES) else LIMIT
            answer = self._answer(limit)
            if "outcome" in answer:
                return answer
            seconds = time.perf_counter() - began
            outcome = "hung" if seconds >= limit else "crashed"
            return {"outcome": outcome, "faults": [answer["lost"]], "seconds": round(seconds, 1), "mib": 0, "said": ""}
        raise SystemExit(f"a good input: {answer}, before {trial.name}")

    def _start(self) -> None:
        command = [sys.executable, str(HERE / "hostile_worker.py"), str(self.folder)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=_environment())

    def _answer(self, seconds: float) -> dict[str, Any]:
        """The next line; `lost` and a fresh process where none comes."""
        assert self.process is not None and self.process.stdout is not None
        end = time.monotonic() + seconds
        with selectors.DefaultSelector() as selector:
            selector.register(self.process.stdout, selectors.EVENT_READ)
            while b"\n" not in self.pending:
                left = end - time.monotonic()
                if left <= 0 or not selector.select(left):
                    return self._lost(f"no end within {seconds:.0f} s")
                got = os.read(self.process.stdout.fileno(), 65536)
                if not got:
                    return self._lost(f"the process died with {self.process.wait()}")
                self.pending += got
        line, _, self.pending = self.pending.partition(b"\n")
        return json.loads(line)

    def _lost(self, why: str) -> dict[str, Any]:
        self.close()
        return {"lost": why}

    def close(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.kill()
            self.process.communicate()
            self.process, self.pending = None, b""


def _environment() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore", "MPLBACKEND": "agg"}


def run(chosen: Sequence[Trial], folder: Path) -> Iterator[dict[str, Any]]:
    """A record a trial, in order."""
    worker = Worker(folder)
    try:
        for trial in chosen:
            found = worker.attempt(trial)
            if found["mib"] > MOST_MIB:
                found["outcome"], found["faults"] = "crashed", [*found["faults"], f"{found['mib']} MiB"]
            about = {"kind": trial.kind, "mutant": trial.mutant, "command": trial.command}
            yield {"set": trial.name, **about, **found}
    finally:
        worker.close()


def quick() -> list[Trial]:
    """A few of every kind of input and of every command, each with another mutant."""
    groups: dict[tuple[str, str], list[Trial]] = {}
    for trial in trials():
        groups.setdefault((trial.kind, trial.command), []).append(trial)
    return [group[(7 * i) % len(group)] for i, group in enumerate(groups.values())]


def table(records: Sequence[dict[str, Any]]) -> str:
    """A row a command and kind of input, and the sum."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for record in records:
        groups.setdefault((record["kind"], record["command"]), []).append(record)
    lines = [
        f"| input | command | tried | {' | '.join(OUTCOMES)} | most seconds | most MiB |",
        f"|---|---|{'---|' * (len(OUTCOMES) + 3)}",
        *(_row(kind, f"`{command}`", group) for (kind, command), group in groups.items()),
        _row("**all**", f"{len({record['mutant'] for record in records})} mutants", records),
    ]
    return "\n".join(lines) + "\n"


def _row(kind: str, command: str, group: Sequence[dict[str, Any]]) -> str:
    counts = [sum(record["outcome"] == outcome for record in group) for outcome in OUTCOMES]
    most = f"{max(r['seconds'] for r in group):.1f} | {max(r['mib'] for r in group)}"
    return f"| {kind} | {command} | {len(group)} | {' | '.join(map(str, counts))} | {most} |"


def _kept(file: Path) -> dict[str, dict[str, Any]]:
    """The stored records of trials that neither crashed nor hung."""
    lines = file.read_text().splitlines() if file.exists() else []
    return {one["set"]: one for one in map(json.loads, lines) if one["outcome"] not in ("crashed", "hung")}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--only", metavar="TEXT")
    parser.add_argument("--out", type=Path, default=HERE / "results", help="folder of hostile.md and hostile.jsonl")
    asked = parser.parse_args()
    chosen = quick() if asked.quick else trials()
    if asked.only:
        chosen = [trial for trial in trials() if asked.only in trial.name]
    kept = _kept(asked.out / "hostile.jsonl") if asked.again else {}
    chosen = [trial for trial in chosen if trial.name not in kept]
    folder = Path(tempfile.mkdtemp(prefix="hostile-"))
    records, began = [], time.monotonic()
    try:
        lay(folder / "good")
        for record in run(chosen, folder):
            records.append(record)
            if record["outcome"] in ("crashed", "hung") or asked.only:
                print(f"{record['outcome']}: {record['set']}: {record['faults'] or record['said']}", flush=True)
            if len(records) % 100 == 0:
                print(f"{len(records)}/{len(chosen)}, {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    new = {record["set"]: record for record in records}
    if not (asked.quick or asked.only):
        records = [{**kept, **new}[trial.name] for trial in trials()]
    print(table(records))
    if not (asked.quick or asked.only):
        asked.out.mkdir(exist_ok=True)
        (asked.out / "hostile.md").write_text(table(records))
        (asked.out / "hostile.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    return int(any(record["outcome"] in ("crashed", "hung") for record in records))


if __name__ == "__main__":
    sys.exit(main())
