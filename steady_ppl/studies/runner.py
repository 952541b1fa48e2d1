"""Send the jobs of a study out and keep what comes back.

A result is kept when it comes; a worker that dies takes nothing with it but its job, which is tried again, and a job
that kills one worker after the other is given up.
"""

from __future__ import annotations

import time
from contextlib import closing
from pathlib import Path

from steady_ppl.errors import ComputationError
from steady_ppl.studies.places import Place, Row, Say, given_up
from steady_ppl.studies.plan import Job, Plan, record_plan
from steady_ppl.studies.table import read_results, study_table


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
        wanted = {job.key: job for job in plan.jobs}
        rows = {row["key"]: row for row in read_results(folder).to_dict("records") if row["key"] in wanted}
        record_plan(plan, folder)
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
                    before = len(left)
                    try:
                        with closing(place.results(list(left.values()), say)) as results:
                            for row in results:
                                keep(row)
                    except place.died as error:
                        begun = place.begun()
                        suspects = [job for key, job in left.items() if key in begun]
                        say(f"a worker died; of the jobs that were begun {len(suspects)} are tried by themselves")
                        for job in suspects:
                            keep(_alone(place, job, say))
                        if len(left) == before:
                            raise ComputationError(
                                f"workers die before they begin: {len(kept)} of {len(wanted)} jobs are kept in {folder}"
                            ) from error
            except KeyboardInterrupt:
                say(f"{len(kept)} of {len(wanted)} jobs are kept in {folder}; the same command goes on")
                raise
            except place.lost as error:
                raise ComputationError(
                    f"the cluster is gone ({type(error).__name__}): {len(kept)} of {len(wanted)} jobs are kept in "
                    f"{folder}; the same command goes on"
                ) from error
    return sum(outcome == "failed" for outcome in kept.values())


def _alone(place: Place, job: Job, say: Say) -> Row:
    """The result of a job that may have killed its worker; what is to be kept if it does so again, and again."""
    for _ in range(2):
        try:
            (row,) = place.results([job], say)
            return row
        except place.died:
            continue
    return given_up(job)


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
