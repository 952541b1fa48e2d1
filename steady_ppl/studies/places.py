"""Where the jobs of a study are computed: what a place has to do, and processes of this machine, by joblib.

What is here is what joblib leaves open: that a worker dies is told apart from what a job raises, and which jobs had
been begun, and which had ended, is known afterwards.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Generator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError

from steady_ppl.errors import RunError
from steady_ppl.studies import job as work
from steady_ppl.studies.plan import Job
from steady_ppl.utils.files import whole_file

Row = dict[str, Any]
Say = Callable[[str], None]
ENDED = ".json"  # of the name of a job's mark, with its row


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
        """The keys of the jobs that have been begun since this was last asked."""
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
        self.marks = Path(self.folder.name)  # a job that is begun leaves its mark there, and its row when it has ended
        return self

    def __exit__(self, *raised: Any) -> None:
        self.folder.cleanup()

    def results(self, jobs: Sequence[Job], say: Say) -> Generator[Row]:
        waiting = {job.key for job in jobs}
        try:
            with closing(self._computed(jobs)) as computed:
                for row in computed:
                    waiting.remove(row["key"])
                    (self.marks / f"{row['key']}{ENDED}").unlink(missing_ok=True)
                    yield row
        except self.died:  # joblib drops what had ended beside it and was not fetched yet
            for ended in self.marks.glob(f"*{ENDED}"):
                if ended.stem in waiting:
                    yield json.loads(ended.read_text())
            raise

    def _computed(self, jobs: Sequence[Job]) -> Generator[Row]:
        # of a single one joblib would make this process, which must not die of a job: it starts two, sent work in turn
        with joblib.parallel_config("loky", n_jobs=max(2, self.workers), inner_max_num_threads=1):
            parallel = joblib.Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch=self.workers)
            yield from parallel(joblib.delayed(_marked)(job, self.marks) for job in jobs)

    def begun(self) -> set[str]:
        marks = [mark for mark in self.marks.iterdir() if not mark.suffix]
        for mark in marks:
            mark.unlink()
        return {mark.name for mark in marks}


def _marked(job: Job, marks: Path) -> Row:
    (marks / job.key).touch()
    row = work.run(job)
    with suppress(RunError), whole_file(marks / f"{job.key}{ENDED}", RunError) as beside:  # no room: fetched, or again
        beside.write_text(json.dumps(row))
    return row
