"""Jobs computed by processes of this machine, some of which die."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import pytest
from dask_cluster import wait_for
from small_studies import STUDY, written

from steady_ppl.errors import ComputationError
from steady_ppl.runs.fit import packages
from steady_ppl.studies import executors
from steady_ppl.studies.executors import MAX_TRIES, Attempts, Local
from steady_ppl.studies.plan import read_plan
from steady_ppl.studies.runner import run_study
from steady_ppl.studies.table import TABLE, read_results

RECIPE = """
import os, signal, time
from pathlib import Path
from steady_ppl import Fit

def fit(program, table, valid=None, *, known_start=False, mark="", deadly=False, seed=0):
    times = Path(mark) / str(seed)
    with times.open("a") as file:
        file.write("1")
    while seed == 13 and not (Path(mark) / "1").exists():
        time.sleep(0.05)  # otherwise 1 may have been begun twice, for all anybody knows, before it dies by itself
    if deadly and (seed == 13 or times.stat().st_size == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 7:
        raise ValueError("seven\\nis not liked")
    if seed == 4:
        raise SystemExit("four \\udcff")
    return Fit(program, "mine", {{}}, seed=seed, known_start=known_start)
"""


@pytest.mark.slow
@pytest.mark.parametrize("workers", [pytest.param(1, marks=pytest.mark.exhaustive), 2])
def test_a_worker_that_dies_takes_nothing_with_it_and_a_deadly_job_is_given_up(tmp_path: Path, workers: int):
    (tmp_path / "mine.py").write_text(RECIPE.format())
    (tmp_path / "marks").mkdir()
    text = STUDY[: STUDY.index("[[method]]")].replace("[1, 2]", "[1, 7, 13, 4]") + (
        '[[method]]\nname = "mine"\nprogram = "{model}"\nrecipe = "mine.py"\n'
        f'settings = {{{{deadly = true, mark = "{tmp_path / "marks"}"}}}}\n'
    )
    plan, out = read_plan(written(tmp_path, text)), tmp_path / "out"
    assert run_study(plan, out, Local(workers)) == 3
    found = read_results(out).set_index("seed")
    assert found["outcome"].to_dict() == {1: "done", 4: "failed", 7: "failed", 13: "failed"}
    assert found.loc[4, "reason"] == "SystemExit: four \\udcff"
    assert (
        found.loc[7, "reason"] == "ValueError: seven"
        and found.loc[13, "reason"] == "its worker died each time that it was tried"
    )
    begun = {seed: (tmp_path / "marks" / str(seed)).stat().st_size for seed in (1, 7, 13)}
    assert begun == {1: 2, 7: 2, 13: MAX_TRIES}
    assert sorted(file.name for file in out.iterdir()) == [TABLE, "study.json"]
    assert run_study(plan, out, Local(workers)) == 3  # what has failed is left
    assert (tmp_path / "marks" / "7").stat().st_size == begun[7]
    assert run_study(plan, out, Local(workers), again=True) == 3
    assert (tmp_path / "marks" / "7").stat().st_size == begun[7] + 1


@pytest.mark.exhaustive
def test_a_deadly_job_takes_nothing_with_it_and_is_tried_after_the_others(tmp_path: Path):
    (tmp_path / "mine.py").write_text(RECIPE.format())
    (tmp_path / "marks").mkdir()
    text = STUDY[: STUDY.index("[[method]]")].replace("[1, 2]", "[13, 1, 2, 3, 5]") + (
        '[[method]]\nname = "mine"\nprogram = "{model}"\nrecipe = "mine.py"\n'
        f'settings = {{{{mark = "{tmp_path / "marks"}", deadly = [false]}}}}\n'
        '[[method]]\nname = "deadly"\nprogram = "{model}"\nrecipe = "mine.py"\n'
        f'settings = {{{{mark = "{tmp_path / "marks"}", deadly = true}}}}\n'
    )
    jobs = [job for job in read_plan(written(tmp_path, text)).jobs if (job.method == "deadly") == (job.seed == 13)]
    said: list[str] = []
    with Local(2) as place:
        found = list(place.results(jobs, said.append))
    assert [(row["seed"], row["outcome"]) for row in found[4:]] == [(13, "failed")]
    assert {(row["seed"], row["outcome"]) for row in found[:4]} == {(seed, "done") for seed in (1, 2, 3, 5)}
    begun = {int(mark.name): mark.stat().st_size for mark in (tmp_path / "marks").iterdir()}
    assert begun == {1: 1, 2: 1, 3: 1, 5: 1, 13: MAX_TRIES}
    assert said == [f"a worker died of {jobs[0].label}"] * MAX_TRIES


def test_workers_that_die_before_they_begin_end_a_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(executors, "packages", os.abort)  # what a worker does first
    with pytest.raises(ComputationError, match="workers die before they begin: 0 of 6 jobs are kept"):
        run_study(read_plan(written(tmp_path)), tmp_path / "out", Local(2))


def test_a_worker_ends_at_once_without_a_word(monkeypatch: pytest.MonkeyPatch):
    failed: list[BaseException | None] = []
    monkeypatch.setattr(threading, "excepthook", lambda given: failed.append(given.exc_value))
    monkeypatch.setattr(executors, "run", time.sleep)
    for _ in range(20):  # one in ten failed when nothing waited
        worker = executors._Process()
        worker.submit(60.0)  # type: ignore[arg-type]
        worker.end()
    assert failed == []


@pytest.mark.slow
def test_one_worker_that_dies_before_it_begins_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    mark = tmp_path / "died"

    def dies_once() -> dict[str, str]:
        try:
            mark.touch(exist_ok=False)
        except FileExistsError:
            return packages()
        os.abort()

    monkeypatch.setattr(executors, "packages", dies_once)
    said: list[str] = []
    found = list(Local(2).results(read_plan(written(tmp_path)).jobs, said.append))
    assert [row["outcome"] for row in found] == ["done"] * 6 and said == []


@pytest.mark.exhaustive
def test_a_worker_that_dies_while_it_has_nothing_to_do_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made: list[executors._Process] = []

    class Process(executors._Process):
        def __init__(self) -> None:
            super().__init__()
            made.append(self)

    monkeypatch.setattr(executors, "_Process", Process)
    said: list[str] = []
    rows = Local(1).results(read_plan(written(tmp_path)).jobs, said.append)
    found = [next(rows)]
    executor = made[0].executor
    for process_id in executor._processes:
        os.kill(process_id, signal.SIGKILL)
    wait_for(lambda: executor._flags.broken is not None)
    found += rows
    assert [row["outcome"] for row in found] == ["done"] * 6 and said == [] and len(made) == 2


GROWING = """
import os, time
from pathlib import Path
from steady_ppl import Fit

kept = []

def fit(program, table, valid=None, *, known_start=False, mark="", seed=0):
    (Path(mark) / str(os.getpid())).touch()
    kept.append(b"1" * 400_000_000)
    time.sleep(1.1)  # so often loky looks at the memory
    return Fit(program, "mine", {{}}, seed=seed, known_start=known_start)
"""


@pytest.mark.slow
def test_a_worker_that_has_grown_is_replaced_without_a_word(tmp_path: Path, recwarn: pytest.WarningsRecorder):
    (tmp_path / "mine.py").write_text(GROWING.format())
    (tmp_path / "workers").mkdir()
    text = STUDY[: STUDY.index("[[method]]")] + (
        '[[method]]\nname = "mine"\nprogram = "{model}"\nrecipe = "mine.py"\n'
        f'settings = {{{{mark = "{tmp_path / "workers"}"}}}}\n'
    )
    said: list[str] = []
    found = list(Local(1).results(read_plan(written(tmp_path, text)).jobs, said.append))
    assert [row["outcome"] for row in found] == ["done"] * 2 and said == [] and not recwarn.list
    assert len(list((tmp_path / "workers").iterdir())) == 2


def test_a_cluster_gives_up_every_job_that_kills_and_none_that_only_waited():
    attempts, deadly = Attempts(), [f"deadly {place}" for place in range(16)]
    for key in [*deadly, "waits"]:
        attempts.sent(key)
    for key in 4 * deadly:
        attempts.note_begun(key)
    assert all(attempts.killed(key) for key in deadly)  # all at once
    assert not attempts.killed("waits")
    assert not any(attempts.killed("waits") for _ in range(9))
    with pytest.raises(ComputationError, match="workers die before they begin"):
        attempts.killed("waits")


def test_jobs_that_a_machine_takes_along_once_are_tried_again():
    attempts = Attempts()
    for key in map(str, range(40)):  # of a scheduler that tries once
        attempts.sent(key)
        attempts.note_begun(key)
    assert not any(attempts.killed(str(place)) for place in range(40))
