"""Send the jobs of a study out, on processes of this machine or on a Dask cluster, and keep what comes back.

joblib runs them, by loky or by Dask. What is here is what these leave open: a result is kept when it comes, a worker
that dies takes nothing with it but its job, which is tried again, and a job that kills one worker after the other is
given up.
"""

from __future__ import annotations

import logging
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError

from steady_ppl.errors import ComputationError, UsageError
from steady_ppl.studies import job as work
from steady_ppl.studies.plan import Job, Plan, record_plan
from steady_ppl.studies.table import read_results, study_table

WORKER_WAIT = 30  # s for the first worker of a cluster
Row = dict[str, Any]
Say = Callable[[str], None]


class Place:
    """Where jobs are computed.

    Attributes:
        died: what joblib raises when a worker has died of a job.
        lost: what it raises when there is nothing left to compute on.
        suspicious: how often a job must have been begun to be suspected of it.
        alone: how often a suspect is tried by itself before it is given up.
    """

    suspicious = 1
    alone = 2
    died: tuple[type[BaseException], ...] = ()
    lost: tuple[type[BaseException], ...] = ()

    def __enter__(self) -> Place:
        return self

    def __exit__(self, *raised: Any) -> None:
        raise NotImplementedError

    def results(self, jobs: Sequence[Job]) -> Iterator[Row]:
        """What comes back, in any order."""
        raise NotImplementedError

    def begun(self) -> Counter[str]:
        """How often each job was begun, by its key."""
        raise NotImplementedError


class Local(Place):
    """Processes of this machine, each with one thread; when one dies, all jobs that are begun have to be tried again.

    Args:
        workers: how many.
    """

    died = (TerminatedWorkerError,)

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def __enter__(self) -> Local:
        self.folder = tempfile.TemporaryDirectory(prefix="steady-study-")
        self.marks = Path(self.folder.name)  # a job that is begun leaves its mark there
        return self

    def __exit__(self, *raised: Any) -> None:
        self.folder.cleanup()

    def results(self, jobs: Sequence[Job]) -> Iterator[Row]:
        # of a single one joblib would make this process, which must not die of a job: it sees two, and one is sent work
        with joblib.parallel_config("loky", n_jobs=max(2, self.workers), inner_max_num_threads=1):
            yield from _sent(_marked, [(job, self.marks) for job in jobs], at_once=self.workers)

    def begun(self) -> Counter[str]:
        return Counter({mark.name: mark.stat().st_size for mark in self.marks.iterdir()})


def _marked(job: Job, marks: Path) -> Row:
    with (marks / job.key).open("a") as mark:
        mark.write("1")
    return work.run(job)


class Cluster(Place):
    """A Dask cluster that is there already; when a worker dies, Dask gives its job to another, three times.

    Args:
        address: of its scheduler, for example `tcp://10.0.0.1:8786`.

    Raises:
        UsageError: dask.distributed is not installed, nobody answers there, there is no worker, or one has several
            threads.
    """

    suspicious, alone = 3, 0

    def __init__(self, address: str) -> None:
        try:
            import distributed  # an extra, which --cluster alone needs
            from distributed.comm import CommClosedError
            from distributed.scheduler import KilledWorker
        except ImportError as error:
            raise UsageError("--cluster needs dask.distributed: pip install 'steady-ppl[cluster]'") from error
        from concurrent.futures import CancelledError

        self.topic = f"steady study {uuid.uuid4().hex}"
        self.died = (KilledWorker,)
        self.lost = (CancelledError, CommClosedError, OSError, TimeoutError)
        try:
            self.client = distributed.Client(address, timeout=10)
        except (OSError, TimeoutError, ValueError) as error:
            reason = str(error).partition("\n")[0]
            raise UsageError(f"no Dask scheduler answers at {address}: {reason}") from error
        _hush("distributed", "tornado", "asyncio")
        try:
            self.client.wait_for_workers(1, timeout=WORKER_WAIT)
        except TimeoutError as error:
            self.client.close()
            raise UsageError(f"the scheduler at {address} has no worker: start some") from error
        workers = self.client.scheduler_info()["workers"].values()
        several = sum(worker["nthreads"] > 1 for worker in workers)
        if several:
            self.client.close()
            raise UsageError(
                f"{several} workers have several threads, which would take turns: start them by "
                f"`dask worker {address} --nthreads 1 --nworkers N`"
            )

    def __exit__(self, *raised: Any) -> None:
        self.client.close(timeout=2)

    def results(self, jobs: Sequence[Job]) -> Iterator[Row]:
        from joblib._dask import DaskDistributedBackend

        class Backend(DaskDistributedBackend):
            """joblib does the work itself where it sees a single worker: let it see two."""

            def effective_n_jobs(self, n_jobs: int) -> int:
                return max(2, super().effective_n_jobs(n_jobs))

        with joblib.parallel_config(Backend(client=self.client)):
            yield from _sent(_logged, [(job, self.topic) for job in jobs], at_once="all")

    def begun(self) -> Counter[str]:
        return Counter(said for _, said in self.client.get_events(self.topic))


def _hush(*owners: str) -> None:
    """What they log of a connection that is lost is said in one line here."""
    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] in owners:
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def _logged(job: Job, topic: str) -> Row:
    from distributed import get_worker

    get_worker().log_event(topic, job.key)
    return work.run(job)


def _sent(function: Callable[..., Row], arguments: Sequence[tuple[Any, ...]], at_once: int | str) -> Iterator[Row]:
    parallel = joblib.Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch=at_once)
    yield from parallel(joblib.delayed(function)(*given) for given in arguments)


def run_study(plan: Plan, folder: Path, place: Place, *, again: bool = False, say: Say = lambda line: None) -> int:
    """Compute what of a study is not there yet.

    Args:
        plan: the study.
        folder: where its table is.
        place: where to compute.
        again: try jobs that have failed once more.
        say: hears a line a job.

    Returns:
        How many jobs have failed.

    Raises:
        RunError: the folder cannot be written or read, or another process writes to it.
        ComputationError: there is nothing left to compute on; all that had come is kept.
    """
    with study_table(folder) as table:
        record_plan(plan, folder)
        wanted = {job.key: job for job in plan.jobs}
        rows = {row["key"]: row for row in read_results(folder).to_dict("records") if row["key"] in wanted}
        kept = {key: row["outcome"] for key, row in rows.items() if not (again and row["outcome"] == "failed")}
        left = {key: job for key, job in wanted.items() if key not in kept}
        if kept:
            say(f"{len(kept)} of {len(wanted)} jobs are there already")
        clock = _Clock(len(left))

        def keep(row: Row) -> None:
            table.add(row)
            kept[row["key"]] = row["outcome"]
            say(f"{len(kept)}/{len(wanted)} {left.pop(row['key']).label}: {_in_words(row)}, {clock.tick()}")

        with place:
            try:
                while left:
                    try:
                        for row in place.results(list(left.values())):
                            keep(row)
                    except place.died:
                        begun = place.begun()
                        suspects = [job for key, job in left.items() if begun[key] >= place.suspicious]
                        say(f"a worker died; of the jobs that were begun {len(suspects)} are tried by themselves")
                        for job in suspects:
                            keep(_alone(place, job))
            except place.lost as error:
                raise ComputationError(
                    f"the cluster is gone ({type(error).__name__}): {len(kept)} of {len(wanted)} jobs are kept in "
                    f"{folder}; the same command goes on"
                ) from error
    return sum(outcome == "failed" for outcome in kept.values())


def _alone(place: Place, job: Job) -> Row:
    """The result of a job that may have killed its worker; what is to be kept if it does so again."""
    for _ in range(place.alone):
        try:
            (row,) = place.results([job])
            return row
        except place.died:
            continue
    return job.columns | {"outcome": "failed", "reason": "its worker died each time that it was tried"}


def _in_words(row: Row) -> str:
    return f"failed, {row['reason']}" if row["outcome"] == "failed" else f"{row['seconds']:.0f} s"


class _Clock:
    """Says how long it will take."""

    def __init__(self, jobs: int) -> None:
        self.left, self.done, self.began = jobs, 0, time.monotonic()

    def tick(self) -> str:
        self.left, self.done = self.left - 1, self.done + 1
        seconds = (time.monotonic() - self.began) / self.done * self.left
        for size, unit in ((86_400, "days"), (3600, "h"), (60, "min")):
            if seconds > 2 * size:
                return f"{seconds / size:.0f} {unit} left"
        return f"{seconds:.0f} s left"
