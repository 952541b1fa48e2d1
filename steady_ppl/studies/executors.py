"""Where the jobs of a study are computed: processes of this machine, or a Dask cluster.

joblib's own way to Dask is not taken: when a job had killed four workers, it waited for ever if there was another such
job, and otherwise computed twice what was left. A result is let go of when it is here, so that a worker that dies later
does not have it computed again. Each process of this machine has an executor of its own: joblib's pools do not say
which job a process died of.
"""

from __future__ import annotations

import logging
import time
import uuid
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from joblib.externals.loky.process_executor import BrokenProcessPool, ProcessPoolExecutor

from steady_ppl.errors import ComputationError, UsageError
from steady_ppl.runs.fit import packages
from steady_ppl.studies.job import OUTDATED, Job, JobFiles, differing_versions, digest_of, run
from steady_ppl.utils.cores import ONE_THREAD
from steady_ppl.utils.text import Say, one_line, shown

ResultRow = dict[str, Any]

WORKER_WAIT_SECONDS = 30  # for the first worker, and between looks at whether there still is one
MAX_UNLOADED = 3  # processes in a row that die while they load, after which no other is started
MAX_TRIES = 3  # of a job whose workers die; the scheduler itself tries it so often as it is set, four times at first
HOLD_SECONDS, MAX_HOLD_SECONDS = 10, 60  # that a worker which is not used holds what it is given, or it would get all
MIN_REFUSED_JOBS = 4  # jobs whose files are others, at which a worker has been refused if its files alone are
MAX_LOST_JOBS = 10  # jobs that Dask gives up while nothing is begun


class Executor(AbstractContextManager[Any]):
    """Where jobs are computed."""

    lost: tuple[type[BaseException], ...] = ()
    """What `results` raises when there is nothing left to compute on."""

    def __exit__(self, *raised: Any) -> None:
        pass

    def results(self, jobs: Sequence[Job], say: Say) -> Generator[ResultRow]:
        """What comes back, in any order; `say` hears of what holds it up. ComputationError: workers die before they
        begin."""
        raise NotImplementedError


def failed_row(job: Job) -> ResultRow:
    """The row of a job that kills its workers."""
    return job.columns | {"outcome": "failed", "reason": "its worker died each time that it was tried"}


class Local(Executor):
    """So many processes of this machine, each with one thread and one job at a time, so that one that dies takes no
    other job with it. Its job is tried again when all others have ended, the last time alone: it may need all the
    memory."""

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def results(self, jobs: Sequence[Job], say: Say) -> Generator[ResultRow]:
        left = list(jobs)
        with warnings.catch_warnings():
            # loky replaces a process that has grown, and says so where it is given its next job
            warnings.filterwarnings("ignore", "A worker stopped while some jobs were given", UserWarning)
            for workers in (*[self.workers] * (MAX_TRIES - 1), 1):
                died: list[Job] = []
                yield from _rows(left, min(workers, len(left)), died, say)
                left = died
        yield from map(failed_row, left)


class _Process:
    """A process of this machine, which first loads what jobs need."""

    def __init__(self) -> None:
        self.executor = ProcessPoolExecutor(1, env=ONE_THREAD)
        self.last = self.loaded = self.executor.submit(packages)
        self.died_idle = False

    def submit(self, job: Job) -> Future[ResultRow]:
        """The job's row, or that the process has died."""
        try:
            self.last = self.executor.submit(run, job)
        except BrokenProcessPool as error:
            self.died_idle, self.last = True, Future()
            self.last.set_exception(error)
        return self.last

    def end(self) -> None:
        """Kill it. loky's thread fails where it has not yet taken what was submitted: KeyError."""
        deadline = time.monotonic() + WORKER_WAIT_SECONDS
        while not (self.last.running() or self.last.done()) and time.monotonic() < deadline:
            time.sleep(0.001)
        self.executor.shutdown(kill_workers=True)


def _rows(jobs: Sequence[Job], workers: int, died: list[Job], say: Say) -> Generator[ResultRow]:
    """The rows of jobs, but of those whose processes have `died`."""
    waiting, running = list(reversed(jobs)), dict[Future[ResultRow], tuple[Job, _Process]]()
    idle, unloaded = list[_Process](), 0
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                job, process = waiting.pop(), idle.pop() if idle else _Process()
                running[process.submit(job)] = job, process
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job, process = running.pop(future)
                if not isinstance(future.exception(), BrokenProcessPool):
                    idle.append(process)
                    unloaded = 0
                    yield future.result()
                    continue
                process.end()
                if reason := process.loaded.exception():
                    unloaded += 1
                    if unloaded == MAX_UNLOADED:
                        raise ComputationError("workers die before they begin") from reason
                if reason or process.died_idle:
                    waiting.append(job)
                else:
                    say(f"a worker died of {job.label}")
                    died.append(job)
    finally:
        for process in [*idle, *(process for _, process in running.values())]:
            process.end()


class Cluster(Executor):
    """A cluster that is there already. Workers may come and go while a study goes on: when one dies, its job is given
    to another; one that joins late and would find something else is not used.

    Args:
        address: of its scheduler, for example `tcp://10.0.0.1:8786`.

    Raises:
        UsageError: dask.distributed is not installed, nobody answers, there is no worker, one has several threads or
            other versions than this machine; from `results`: one does not see the jobs' files as they are here.
        ComputationError: from `results`: workers die before they begin, or one cannot load what it is to do.
    """

    def __init__(self, address: str) -> None:
        try:
            import distributed  # an extra, which --cluster alone needs
            from distributed.comm.core import CommClosedError
            from distributed.scheduler import KilledWorker
        except ImportError as error:
            raise UsageError("--cluster needs dask.distributed: pip install 'steady-ppl[cluster]'") from error
        self.killed, self.looked, self.deserted = KilledWorker, time.monotonic(), False
        self.lost = (CancelledError, CommClosedError, OSError, TimeoutError)
        try:
            self.client = distributed.Client(address, timeout=10)
        except (OSError, TimeoutError, ValueError, TypeError) as error:  # the last of an address that needs TLS
            reason = str(error).partition("\n")[0]
            raise UsageError(f"no Dask scheduler answers at {address}: {reason}") from error
        for name in list(logging.root.manager.loggerDict):
            if name.partition(".")[0] in ("distributed", "tornado", "asyncio"):  # a lost connection is said in one line
                logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        try:
            self.client.wait_for_workers(1, timeout=WORKER_WAIT_SECONDS)
            self._require_same_versions(address)
        except (TimeoutError, UsageError) as error:
            self.client.close()
            if isinstance(error, UsageError):
                raise
            raise UsageError(f"the scheduler at {address} has no worker: start some") from error

    def __exit__(self, *raised: Any) -> None:
        self.client.close(timeout=2)

    def _require_same_versions(self, address: str) -> None:
        if several := [name for name, worker in self._workers().items() if worker["nthreads"] > 1]:
            which = shown(", ".join(several), 200)
            how = f"start them by `dask worker {address} --nthreads 1 --nworkers N`"
            raise UsageError(f"workers with several threads, which would take turns: {which}; {how}")
        here = packages()
        for worker, there in self._ask(packages).items():
            if other := differing_versions(here, there):
                raise UsageError(f"the worker {worker} has {other}: results would not be comparable")

    def _workers(self) -> dict[str, Any]:
        return self.client.scheduler_info(n_workers=-1)["workers"]

    def _ask(self, function: Callable[..., Any], *given: Any) -> dict[str, Any]:
        """What every worker answers."""
        try:
            answers = self.client.run(function, *given, on_error="return")
        except (ImportError, AttributeError) as error:
            raise UsageError(f"a worker has no such steady-ppl ({error}): install it there as here") from error
        for worker, answer in answers.items():
            if isinstance(answer, BaseException):
                raise UsageError(f"the worker {worker} cannot take part: {one_line(answer)}")
        return answers

    def results(self, jobs: Sequence[Job], say: Say) -> Generator[ResultRow]:
        for worker, other in self._ask(other_files, JobFiles().digests_of(jobs)).items():
            if other:
                raise UsageError(f"the worker {worker} does not see {other[0]} as it is here: it needs the same paths")
        sent = _Sent(self.client)
        try:
            for job in jobs:
                sent.send(job)
            while sent.jobs:
                batch = self._batch(sent, say)
                batch.sort(key=lambda one: not isinstance(one[1], Answer))  # what has come is kept before anything ends
                for future, answer in batch:
                    job = sent.jobs.pop(future)
                    if isinstance(answer, Answer):
                        if row := self._usable(answer, job, sent, say):
                            yield row
                    elif isinstance(answer, tuple) and isinstance(answer[1], self.killed):
                        if sent.attempts.killed(job.key):
                            yield failed_row(job)
                        else:
                            sent.send(job)
                    elif isinstance(answer, tuple):
                        raise ComputationError(f"a worker cannot begin a job: {one_line(answer[1])}") from answer[1]
                    else:
                        raise CancelledError
        finally:
            self.client.cancel(list(sent.jobs))

    def _batch(self, sent: _Sent, say: Say) -> list[tuple[Any, Any]]:
        """What has ended, with a line when there is no worker left to end anything."""
        while not sent.running.has_ready():
            time.sleep(0.05)
            if time.monotonic() - self.looked > WORKER_WAIT_SECONDS:
                alone = not self._workers().keys() - sent.refused
                if alone and not self.deserted:
                    say("the cluster has no worker left: start some, or stop this and go on later")
                self.looked, self.deserted = time.monotonic(), alone
        return sent.running.next_batch(block=False)

    def _usable(self, answer: Answer, job: Job, sent: _Sent, say: Say) -> ResultRow | None:
        """Its row; None, and the job is sent again, where the worker is unlike this machine."""
        reason = answer.unlike
        if answer.row.get("reason") == OUTDATED and JobFiles().is_of(job):
            reason = "other files than there are here"
            sent.attempts.begun[job.key] -= 1  # only its files were looked at
        if not reason:
            return answer.row
        if answer.worker not in sent.refused:
            say(f"the worker {answer.worker} is not used: it has {reason}")
            sent.refused.add(answer.worker)
            self.client.run(mark_unused, sent.topic, workers=[answer.worker], on_error="ignore")
        others = list(self._workers().keys() - sent.refused)  # rather than these; others still may take it from them
        sent.send(job, **({"workers": others, "allow_other_workers": True} if others else {}))
        return None


class Answer(NamedTuple):
    """The row of a job by a worker, named by its address; empty where the worker is unlike this machine."""

    worker: str
    unlike: str
    row: ResultRow


class _Sent:
    """What is on the cluster: jobs by their futures, which are handed out as they end, and workers not to be used."""

    def __init__(self, client: Any) -> None:
        from distributed import as_completed

        self.client, self.topic, self.here = client, f"steady-study-{uuid.uuid4().hex}", packages()
        self.jobs, self.attempts, self.refused = dict[Any, Job](), Attempts(), set[str]()
        self.running = as_completed(loop=client.loop, with_results=True, raise_errors=False)
        client.subscribe_topic(self.topic, lambda event: self.attempts.note_begun(event[1]))

    def send(self, job: Job, **where: Any) -> None:
        self.attempts.sent(job.key)  # before it can be begun
        future = self.client.submit(compute_on_worker, job, self.here, self.topic, pure=False, **where)
        self.jobs[future] = job
        self.running.add(future)


class Attempts:
    """Tells jobs that kill their workers from those that only waited at one that died, which Dask blames as well."""

    def __init__(self) -> None:
        self.begun = Counter[str]()  # how often each job was, by its key
        self.before, self.lost_in_a_row = dict[str, int](), 0

    def sent(self, key: str) -> None:
        self.before[key] = self.begun[key]

    def note_begun(self, key: str) -> None:
        self.begun[key] += 1
        self.lost_in_a_row = 0

    def killed(self, key: str) -> bool:
        """Dask has given it up: whether it has been begun so often that it is the one that kills. ComputationError
        where Dask gives up one after the other, and nothing is begun."""
        self.lost_in_a_row = 0 if self.begun[key] > self.before[key] else self.lost_in_a_row + 1
        if self.lost_in_a_row > MAX_LOST_JOBS:
            raise ComputationError("workers die before they begin")
        return self.begun[key] >= MAX_TRIES


_changed = Counter[str]()  # on a worker: jobs whose files were others there, by topic
_held = Counter[str]()  # on a worker that is not used: how often it has held what it was given, by topic


def mark_unused(topic: str) -> None:
    """On a worker: it is not used."""
    _held[topic] += 1


def compute_on_worker(job: Job, here: Mapping[str, str], topic: str) -> Answer:
    """On a worker: the row of a job, unless the worker has other packages than `here`, where it is asked. An event of
    the topic says that the job is begun."""
    from distributed import get_worker

    worker = get_worker()
    unlike = differing_versions(here, packages())
    if worker.state.nthreads > 1:
        unlike = f"{worker.state.nthreads} threads, which would take turns"
    if unlike or topic in _held:
        time.sleep(min(HOLD_SECONDS * 2.0 ** _held[topic], MAX_HOLD_SECONDS))
        mark_unused(topic)
        return Answer(worker.address, unlike or "been refused", {})
    worker.log_event(topic, job.key)
    row = run(job)
    if row.get("reason") == OUTDATED:
        _changed[topic] += 1
        if 1 < _changed[topic] <= MIN_REFUSED_JOBS:  # it would get everything before it is refused
            time.sleep(HOLD_SECONDS)
    return Answer(worker.address, "", row)


def other_files(digests: Mapping[str, str]) -> list[str]:
    """On a worker: the files that are not there, or are others."""
    other = dict(digests)
    for file, digest in digests.items():
        with suppress(UsageError):  # it cannot be read
            if digest_of(Path(file)) == digest:
                del other[file]
    return list(other)
