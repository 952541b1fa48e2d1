"""What a study costs on a Dask cluster: what one needs to know to plan ten thousand fits on a hundred machines.

    python benchmarks/cluster.py [--quick] [PART …]

A scheduler and workers are started as processes on loopback. Measured are: the same fits by one worker and by two in
turn (efficiency: seconds of one over twice the seconds of two), beside them by one and two processes without a cluster,
and how much longer a fit itself takes beside another one, which is the machine's part of what is lost;
how long a worker takes that has just been started; ten thousand jobs that end at once, for what scheduler, client and
table can take (processor time, so that it matters little what else the machine does); bytes of a job and of a result;
and workers that are killed in the middle, for what that costs. Written to results/cluster.json, parts that are not
named stay as they are there; exits with 1 where the efficiency is below 90 %, or no worker was killed, or a fit failed.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from dask_cluster import Dask, wait_for  # noqa: E402

from steady_ppl.runs.fit import packages  # noqa: E402
from steady_ppl.studies.executors import Cluster, Executor, Local, compute_on_worker  # noqa: E402
from steady_ppl.studies.job import Job  # noqa: E402
from steady_ppl.studies.plan import read_plan  # noqa: E402
from steady_ppl.studies.runner import run_study  # noqa: E402
from steady_ppl.studies.table import TABLE, read_results, study_table  # noqa: E402

RESULTS = Path(__file__).parent / "results" / "cluster.json"
MUST = 0.9
HOVERCRAFT, NETWORK, CART = (
    ROOT / "models" / name
    for name in ("hovercraft.py:HovercraftTruth", "neural_vehicle.py:NeuralHovercraft", "linear_gaussian.py")
)
ENDS_AT_ONCE = """
from steady_ppl import UsageError

def fit(program, table, valid=None, *, known_start=False, seed=0):
    raise UsageError("it ends at once")
"""


def study(folder: Path, jobs: int, truth: Path, sizes: int, method: str) -> Path:
    """A study of one method and so many seeds."""
    text = f'title = "Cluster"\nseeds = {list(range(1, jobs + 1))}\nknown_start = true\n'
    text += f'[data]\nsimulate = "{truth}"\ntrain = {sizes}\nvalid = {sizes}\ntest = {sizes}\n'
    folder.mkdir(exist_ok=True)
    (folder / "study.toml").write_text(f"{text}[[method]]\nname = 'it'\n{method}\n")
    return folder / "study.toml"


def fits(folder: Path, jobs: int, steps: int) -> Path:
    """Short fits of a network by the Gaussian guide, each some seconds."""
    settings = f"{{guide = 'gaussian', steps = {steps}, validate_every = {steps}}}"
    return study(folder, jobs, HOVERCRAFT, 16, f"program = '{NETWORK}'\nsettings = {settings}")


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[Dask]:
    """A scheduler and workers that have loaded what they need."""
    folder.mkdir(exist_ok=True)
    dask = Dask(folder)
    try:
        dask.scheduler()
        for _ in range(workers):
            dask.worker()
        with Cluster(dask.address) as place:
            wait_for(lambda: len(place.client.scheduler_info(n_workers=-1)["workers"]) == workers)
            run_study(read_plan(fits(folder / "warm", 3 * workers, 2)), folder / "warm" / "out", place)
        yield dask
    finally:
        dask.end()


def efficiency(folder: Path, rounds: int, jobs: int, steps: int) -> dict[str, Any]:
    """Seconds of the same study by one worker and by two, in turn, on a cluster and on processes of this machine."""
    seconds: dict[str, list[float]] = {"cluster, 1": [], "cluster, 2": [], "processes, 1": [], "processes, 2": []}
    fit_seconds: dict[str, list[float]] = {name: [] for name in seconds}
    plan = read_plan(fits(folder / "fits", jobs, steps))
    with cluster(folder / "one", 1) as one, cluster(folder / "two", 2) as two:
        places: dict[str, Callable[[], Executor]] = {
            "cluster, 1": lambda: Cluster(one.address),
            "cluster, 2": lambda: Cluster(two.address),
            "processes, 1": lambda: Local(1),
            "processes, 2": lambda: Local(2),
        }
        run_study(read_plan(fits(folder / "warm", 6, 2)), folder / "warm" / "out", Local(2))
        for turn in range(rounds):
            for name in list(places) if turn % 2 == 0 else reversed(places):
                out = folder / f"{name}, {turn}"
                place = places[name]()
                began = time.perf_counter()
                failed = run_study(plan, out, place)
                seconds[name].append(time.perf_counter() - began)
                assert not failed and len(read_results(out)) == jobs
                fit_seconds[name].append(float(read_results(out)["seconds"].mean()))
                print(f"{name}: {seconds[name][-1]:.1f} s, of a fit {fit_seconds[name][-1]:.1f} s", flush=True)
    found = {where: _efficiency(seconds[f"{where}, 1"], seconds[f"{where}, 2"]) for where in ("cluster", "processes")}
    return {
        "jobs": jobs,
        "seconds": seconds,
        "seconds_a_fit": fit_seconds,
        **found,
    }


def _efficiency(alone: list[float], both: list[float]) -> dict[str, Any]:
    found = [one / (2 * two) for one, two in zip(alone, both, strict=True)]
    spread = statistics.stdev(found) if len(found) > 1 else 0.0
    return {"rounds": found, "mean": statistics.mean(found), "sd": spread}


def start(folder: Path, rounds: int) -> dict[str, Any]:
    """Seconds of a short fit by a worker that has just been started, and by the same one when it has done others."""
    new, used = list[float](), list[float]()
    for turn in range(rounds):
        at = folder / str(turn)
        at.mkdir()
        plan = read_plan(fits(at / "fits", 1, 2))
        dask = Dask(at)
        try:
            dask.scheduler()
            for name, seconds in (("first", new), ("again", used)):
                began = time.perf_counter()
                if name == "first":
                    dask.worker()
                run_study(plan, at / name, Cluster(dask.address))
                seconds.append(time.perf_counter() - began)
        finally:
            dask.end()
    return {"new": new, "used": used}


def many(folder: Path, jobs: int) -> dict[str, Any]:
    """Jobs that end at once: what everything but the computing takes."""
    (folder / "ends.py").write_text(ENDS_AT_ONCE)
    began = time.perf_counter()
    plan = read_plan(study(folder, jobs, CART, 1, f"program = '{CART}'\nrecipe = 'ends.py'"))
    planning = time.perf_counter() - began
    with cluster(folder / "dask", 2) as dask, Cluster(dask.address) as place:
        scheduling = dask.processes[0].pid
        began, client, scheduler = time.perf_counter(), time.process_time(), _processor_seconds(scheduling)
        failed = run_study(plan, folder / "out", place)
        seconds, client = time.perf_counter() - began, time.process_time() - client
        scheduler, resident = _processor_seconds(scheduling) - scheduler, _resident(scheduling)
    assert failed == jobs == len(read_results(folder / "out"))
    own = float(read_results(folder / "out")["seconds"].sum())
    return {
        "jobs": jobs,
        "planning_s": planning,
        "seconds": seconds,
        "a_second": jobs / seconds,
        "worker_ms_a_job": 1000 * own / jobs,
        "client_ms_a_job": 1000 * client / jobs,
        "scheduler_ms_a_job": 1000 * scheduler / jobs,
        "client_mib": _resident(os.getpid()),
        "scheduler_mib": resident,
        "bytes_a_job": _sent_bytes(plan.jobs[0]),
    }


def _sent_bytes(job: Job) -> int:
    """What goes to a worker with a job."""
    from distributed.protocol import serialize

    _, frames = serialize((compute_on_worker, job, packages(), "steady-study-" + 32 * "0"))
    return sum(memoryview(frame).nbytes for frame in frames)


def kept(folder: Path, results: int) -> dict[str, Any]:
    """As many results as those of a fit that is done, put into a table."""
    plan = read_plan(fits(folder / "fit", 1, 2))
    run_study(plan, folder / "one", Local(1))
    (row,) = read_results(folder / "one").to_dict("records")
    began = time.process_time()
    with study_table(folder / "many") as table:
        for place in range(results):
            figures = {name: value * (1 + place / results) for name, value in row.items() if isinstance(value, float)}
            table.add(row | figures | {"key": f"{place:016x}"})
    spent = time.process_time() - began
    return {
        "results": results,
        "columns": len(row),
        "ms_a_result": 1000 * spent / results,
        "bytes_a_result": (folder / "many" / TABLE).stat().st_size / results,
    }


def killed(folder: Path, jobs: int, steps: int, every: float) -> dict[str, Any]:
    """Fits by two workers, and the same while one of them is killed again and again, another one taking its place."""
    plan, kills = read_plan(fits(folder / "fits", jobs, steps)), 0
    with cluster(folder / "dask", 2) as dask:
        began = time.perf_counter()
        assert not run_study(plan, folder / "undisturbed", Cluster(dask.address))
        undisturbed, place = time.perf_counter() - began, Cluster(dask.address)
        over = threading.Event()

        def kill() -> None:
            nonlocal kills
            while not over.wait(every):
                victim = dask.processes.pop(1)
                victim.kill()
                victim.wait()
                dask.worker()
                kills += 1

        killer = threading.Thread(target=kill)
        killer.start()
        began = time.perf_counter()
        try:
            failed = run_study(plan, folder / "out", place)
        finally:
            over.set()
            killer.join()
        seconds = time.perf_counter() - began
    return {"jobs": jobs, "kills": kills, "seconds": seconds, "undisturbed": undisturbed, "failed": failed}


def _resident(process: int) -> float:
    words = Path(f"/proc/{process}/status").read_text().split()
    return int(words[words.index("VmHWM:") + 1]) / 1024


def _processor_seconds(process: int) -> float:
    """What it has used until now, by itself and for the system."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


PARTS: dict[str, Callable[[Path, bool], dict[str, Any]]] = {
    "efficiency": lambda at, quick: efficiency(at, *((1, 4, 5) if quick else (4, 8, 20))),
    "start": lambda at, quick: start(at, 1 if quick else 3),
    "many": lambda at, quick: many(at, 200 if quick else 10_000),
    "kept": lambda at, quick: kept(at, 200 if quick else 10_000),
    "killed": lambda at, quick: killed(at, *((6, 5, 40.0) if quick else (24, 20, 60.0))),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few and short jobs; writes nothing")
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; all of them when none is named")
    words = parser.parse_args()
    if unknown := set(words.parts) - set(PARTS):
        parser.error(f"no part {', '.join(unknown)}; there are {', '.join(PARTS)}")
    found = {} if words.quick or not RESULTS.exists() else json.loads(RESULTS.read_text())
    signal.signal(signal.SIGTERM, lambda *received: sys.exit(1))  # so that what was started is ended
    for part in words.parts or PARTS:
        with tempfile.TemporaryDirectory() as name:
            found[part] = PARTS[part](Path(name), words.quick)
        print(part, json.dumps(found[part]), flush=True)
        if not words.quick:
            RESULTS.write_text(json.dumps(found, indent=1) + "\n")
    efficient = "efficiency" not in found or found["efficiency"]["cluster"]["mean"] >= MUST
    survived = "killed" not in found or (found["killed"]["kills"] > 0 and not found["killed"]["failed"])
    return int(not (efficient and survived))


if __name__ == "__main__":
    sys.exit(main())
