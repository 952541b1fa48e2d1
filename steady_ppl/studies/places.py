"""Where the jobs of a study are computed: on processes of this machine by joblib, or on a Dask cluster.

What is here is what these leave open: that a worker dies is told apart from what a job raises, and which jobs had been
begun is known afterwards. joblib's own way to Dask is not taken: when a job had killed four workers, it waited for ever
if there was another such job, and otherwise had everything that was left computed twice.
"""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import Any

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError

from steady_ppl.errors import UsageError
from steady_ppl.fit import packages
from steady_ppl.studies import job as work
from steady_ppl.studies.job_files import JobFiles
from steady_ppl.studies.plan import Job

WORKER_WAIT = 30  # s for the first worker of a cluster, and between looks at whether there still is one
Row = dict[str, Any]
Say = Callable[[str], None]


class Place:
    """Where jobs are computed.

    Attributes:
        died: what `results` raises when a worker has died and taken others with it.
        lost: what it raises when there is nothing left to compute on.
    """

    died: tuple[type[BaseException], ...] = ()
    lost: tuple[type[BaseException], ...] = ()

    def __enter__(self) -> Place:
        return self

    def __exit__(self, *raised: Any) -> None:
        raise NotImplementedError

    def results(self, jobs: Sequence[Job], say: Say) -> Generator[Row]:
        """What comes back, in any order; `say` hears of what holds it up."""
        raise NotImplementedError

    def begun(self) -> set[str]:
        """The keys of the jobs that had been begun when a worker died."""
        return set()


def given_up(job: Job) -> Row:
    """The row of a job that kills its workers."""
    return job.columns | {"outcome": "failed", "reason": "its worker died each time that it was tried"}


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

    def results(self, jobs: Sequence[Job], say: Say) -> Generator[Row]:
        # of a single one joblib would make this process, which must not die of a job: it starts two, sent work in turn
        with joblib.parallel_config("loky", n_jobs=max(2, self.workers), inner_max_num_threads=1):
            yield from _sent(_marked, [(job, self.marks) for job in jobs], at_once=self.workers)

    def begun(self) -> set[str]:
        return {mark.name for mark in self.marks.iterdir()}


def _marked(job: Job, marks: Path) -> Row:
    (marks / job.key).touch()
    return work.run(job)


class Cluster(Place):
    """A Dask cluster that is there already; when a worker dies, Dask gives its job to another, three times. Workers may
    come and go while a study goes on.

    Args:
        address: of its scheduler, for example `tcp://10.0.0.1:8786`.

    Raises:
        UsageError: dask.distributed is not installed, nobody answers there, there is no worker, one has several
            threads, or other versions than this machine; from `results`, one does not see the files of the jobs.
    """

    def __init__(self, address: str) -> None:
        try:
            import distributed  # an extra, which --cluster alone needs
            from distributed.comm import CommClosedError
            from distributed.scheduler import KilledWorker
        except ImportError as error:
            raise UsageError("--cluster needs dask.distributed: pip install 'steady-ppl[cluster]'") from error
        from concurrent.futures import CancelledError

        self.killed = KilledWorker
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
        try:
            self._require_alike(address)
        except UsageError:
            self.client.close()
            raise

    def _require_alike(self, address: str) -> None:
        workers = self.client.scheduler_info(n_workers=-1)["workers"].values()
        several = sum(worker["nthreads"] > 1 for worker in workers)
        if several:
            raise UsageError(
                f"{several} workers have several threads, which would take turns: start them by "
                f"`dask worker {address} --nthreads 1 --nworkers N`"
            )
        here = packages()
        try:
            there = self.client.run(packages)
        except (ImportError, AttributeError) as error:
            raise UsageError(f"a worker has no such steady-ppl ({error}): install it there as here") from error
        for worker, found in there.items():
            other = work.differing(here, found)
            if other:
                raise UsageError(f"the worker {worker} has {other}: results would not be comparable")

    def _require_files(self, jobs: Sequence[Job]) -> None:
        read = JobFiles()
        files = sorted({str(file) for job in jobs for file in read.of(job)})
        for worker, lacking in self.client.run(_lacking, files).items():
            if lacking:
                raise UsageError(f"the worker {worker} does not see {lacking[0]}: workers need this machine's paths")

    def __exit__(self, *raised: Any) -> None:
        self.client.close(timeout=2)

    def results(self, jobs: Sequence[Job], say: Say) -> Generator[Row]:
        self._require_files(jobs)
        here = packages()
        sent = {self.client.submit(work.run, job, here, pure=False): job for job in jobs}
        try:
            for future in self._ended(list(sent), say):
                if future.status == "error" and isinstance(future.exception(), self.killed):
                    yield given_up(sent[future])
                else:
                    yield future.result()
                del sent[future]
        finally:
            self.client.cancel(list(sent))

    def _ended(self, sent: Sequence[Any], say: Say) -> Iterator[Any]:
        """Futures as they end, with a line when there is no worker left to end any."""
        from distributed import as_completed

        running, looked, deserted = as_completed(sent), time.monotonic(), False
        while not running.is_empty():
            if running.has_ready():
                yield from running.next_batch(block=False)
            elif time.monotonic() - looked < WORKER_WAIT:
                time.sleep(0.05)
            else:
                alone = not self.client.scheduler_info(n_workers=-1)["workers"]
                if alone and not deserted:
                    say("the cluster has no worker left: start some, or stop this and go on later")
                looked, deserted = time.monotonic(), alone


def _hush(*owners: str) -> None:
    """What they log of a connection that is lost is said in one line here."""
    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] in owners:
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def _lacking(files: Sequence[str]) -> list[str]:
    return [file for file in files if not Path(file).is_file()]


def _sent(function: Callable[..., Row], arguments: Sequence[tuple[Any, ...]], at_once: int) -> Generator[Row]:
    parallel = joblib.Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch=at_once)
    yield from parallel(joblib.delayed(function)(*given) for given in arguments)
