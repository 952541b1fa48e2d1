"""Many independent jobs, a record each, appended to a file as they are done; what is there already is left out."""

from __future__ import annotations

import hashlib
import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

Record = dict[str, Any]


def plain(value: Any) -> Any:
    """Return a value ready for JSON: figures to five digits, None where there is none."""
    if isinstance(value, Mapping):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if isinstance(value, float):
        return float(f"{value:.5g}") if math.isfinite(value) else None
    return value


def digest(*rooms: Path, files: Iterable[Path] = ()) -> str:
    """Of the source in these rooms, as far as it is imported, and of files."""
    loaded = [Path(module.__file__) for module in list(sys.modules.values()) if getattr(module, "__file__", None)]
    source = sorted({file for file in loaded if set(rooms) & set(file.parents)} | set(files))
    return hashlib.sha256(b"".join(file.read_bytes() for file in source)).hexdigest()[:12]


def stored(file: Path) -> dict[str, Record]:
    """The last record of each name, whichever source made it; a line that was cut off is none."""
    lines = file.read_text().splitlines(keepends=True) if file.exists() else []
    return {record["set"]: record for record in (json.loads(line) for line in lines if line.endswith("\n"))}


def _done(file: Path, version: str) -> dict[str, Record]:
    """What need not be run again, which what failed need; exits where another source made it."""
    done = {name: record for name, record in stored(file).items() if "failed" not in record}
    others = {record["version"] for record in done.values()} - {version}
    if others:
        raise SystemExit(
            f"{file} was made by another version of the source ({', '.join(sorted(others))}): move it away"
        )
    return done


def _drop_what_was_cut_off(file: Path) -> None:
    whole, _, rest = file.read_text().rpartition("\n") if file.exists() else ("", "", "")
    if rest:
        file.write_text(f"{whole}\n" if whole else "")


def run(
    work: Callable[..., Record],
    jobs: Mapping[str, tuple[Any, ...]],
    file: Path,
    *,
    version: str,
    workers: int = 2,
    said: Callable[[Record], str] = lambda record: "",
) -> list[Record]:
    """Records of all jobs, in any order; those that are not in the file are run.

    Args:
        work: makes the record of a job from its arguments.
        jobs: arguments by the name under which the record is kept (`set`).
        file: one record a line.
        version: of the source, see `digest`.
        workers: processes.
        said: what is printed of a record that is done.

    Returns:
        A record a job; one that failed has the reason under `failed`, and is tried again the next time.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    done = _done(file, version)
    _drop_what_was_cut_off(file)
    left = {name: arguments for name, arguments in jobs.items() if name not in done}
    began = time.perf_counter()
    with ProcessPoolExecutor(workers) as pool, file.open("a") as out:
        running = {pool.submit(work, *arguments): name for name, arguments in left.items()}
        try:
            for count, future in enumerate(as_completed(running), 1):
                name = running[future]
                record = _outcome(future)
                done[name] = {"set": name, "version": version} | record
                out.write(json.dumps(done[name]) + "\n")
                out.flush()
                minutes = (time.perf_counter() - began) / count * (len(left) - count) / 60
                outcome = f"failed: {record['failed']}" if "failed" in record else said(record)
                print(f"{count}/{len(left)} {name}  {outcome}  {minutes:.0f} min left", file=sys.stderr, flush=True)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [record for name, record in done.items() if name in jobs]


def _outcome(job: Future[Record]) -> Record:
    try:
        return job.result()
    except Exception as error:
        return {"failed": f"{type(error).__name__}: {error}"}
