"""Jobs side by side in forked processes: the same results as one after another, whatever becomes of a process."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

import pytest
import torch

from steady_ppl.errors import FilterError
from steady_ppl.utils import cores
from steady_ppl.utils.cores import in_batches, one_core, run_in_parallel
from steady_ppl.utils.progress import listening, stages


@pytest.fixture(autouse=True)
def three_cores(monkeypatch):
    if sys.platform != "linux" or not hasattr(os, "pidfd_open"):
        pytest.skip("no safe fork on this system")
    monkeypatch.setattr(cores, "_cores", lambda: 3)


def jobs_of(count, run=lambda index: None):
    def job(index):
        run(index)
        return {"squares": torch.arange(index + 1.0).square()}, {"pid": os.getpid(), "at": [index, "é"]}

    return [lambda index=index: job(index) for index in range(count)]


def test_results_come_in_the_order_of_jobs_from_several_processes():
    found = run_in_parallel(jobs_of(7))
    assert [values["at"] for _, values in found] == [[index, "é"] for index in range(7)]
    for index, (tensors, _) in enumerate(found):
        torch.testing.assert_close(tensors["squares"], torch.arange(index + 1.0).square(), rtol=0, atol=0)
    assert len({values["pid"] for _, values in found}) == 3 and found[0][1]["pid"] == os.getpid()


def test_one_core_and_one_job_take_no_other_process():
    with one_core():
        assert {values["pid"] for _, values in run_in_parallel(jobs_of(4))} == {os.getpid()}
    assert run_in_parallel(jobs_of(1))[0][1]["pid"] == os.getpid()
    assert run_in_parallel([]) == []


def test_jobs_within_jobs_stay_in_their_process():
    def outer():
        return {}, {"pids": sorted({values["pid"] for _, values in run_in_parallel(jobs_of(4))})}

    inner = [values["pids"] for _, values in run_in_parallel([outer, outer, outer])]
    assert [len(pids) for pids in inner[1:]] == [1, 1]


def test_what_a_job_raises_elsewhere_is_raised_here():
    def fail(index):
        if index == 1:
            raise FilterError("trajectory 3 blew up")

    with pytest.raises(FilterError, match="trajectory 3 blew up"):
        run_in_parallel(jobs_of(4, fail))


def test_jobs_of_a_process_that_is_killed_are_run_here():
    mine = os.getpid()

    def die(index):
        if index == 1 and os.getpid() != mine:
            os.kill(os.getpid(), signal.SIGKILL)

    found = run_in_parallel(jobs_of(6, die))
    assert [values["at"][0] for _, values in found] == list(range(6))
    assert found[1][1]["pid"] == mine and found[4][1]["pid"] == mine and found[2][1]["pid"] != mine


def test_the_next_ones_are_run_with_the_first_that_is_asked_for():
    begun = []
    calls = in_batches(jobs_of(4, lambda index: begun.append(index)))
    assert begun == [] and calls[0]()[1]["at"] == [0, "é"]
    pids = [call()[1]["pid"] for call in calls[1:]]
    assert pids[0] != pids[1] and os.getpid() not in pids[:2] and pids[2] == os.getpid()
    assert begun == [0, 3]  # of this process
    with one_core():
        assert {call()[1]["pid"] for call in in_batches(jobs_of(3))} == {os.getpid()}


def test_one_that_fails_elsewhere_fails_when_it_is_its_turn():
    def fail(index):
        if index == 1:
            raise FilterError("trajectory 3 blew up", trajectory="3")

    calls = in_batches(jobs_of(3, fail))
    assert calls[0]()[1]["at"][0] == 0
    with pytest.raises(FilterError, match="trajectory 3 blew up") as caught:
        calls[1]()
    assert caught.value.trajectory == "3"
    assert calls[2]()[1]["at"][0] == 2


@pytest.mark.parametrize("how", ["error", "killed"])
def test_one_that_ends_its_process_is_run_in_its_turn_and_the_others_once(how, tmp_path):
    mine = os.getpid()

    def fail(index):
        (tmp_path / f"{index}-{time.monotonic_ns()}").touch()
        if index == 1 and how == "error":
            raise RuntimeError("of computation 1")
        if index == 1 and os.getpid() != mine:
            os.kill(os.getpid(), signal.SIGKILL)

    calls = in_batches(jobs_of(5, fail))
    assert calls[0]()[1]["at"][0] == 0
    if how == "error":
        with pytest.raises(RuntimeError, match="of computation 1"):
            calls[1]()
    else:
        assert calls[1]()[1]["pid"] == mine
    assert [call()[1]["at"][0] for call in calls[2:]] == [2, 3, 4]
    runs = [int(file.name[0]) for file in tmp_path.iterdir()]
    assert [runs.count(index) for index in (0, 1, 2)] == [1, 2, 1]


def test_other_processes_say_nothing_of_how_far_they_are():
    heard = []

    def work():
        with stages(("working", 1)) as begin:
            begin()
        return {}, {"heard": len(heard)}

    with listening(lambda doing, share: heard.append(doing)):
        found = run_in_parallel([work, work])
    assert heard == ["working", ""] and found[1][1]["heard"] == 0


def test_an_error_here_ends_the_other_processes(tmp_path):
    mine = os.getpid()

    def wait(index):
        if os.getpid() != mine:
            (tmp_path / str(os.getpid())).touch()
            time.sleep(60)
        while len(list(tmp_path.iterdir())) < 2:
            time.sleep(0.01)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_in_parallel(jobs_of(3, wait))
    for file in tmp_path.iterdir():
        with pytest.raises(ProcessLookupError):
            os.kill(int(file.name), 0)


def test_a_process_that_hangs_is_not_waited_for(monkeypatch):
    mine, held = os.getpid(), threading.Lock()
    monkeypatch.setattr(cores, "MIN_PATIENCE_SECONDS", 0.2)

    def wait(index):
        if os.getpid() != mine:
            with held:
                time.sleep(60)

    with held:
        found = run_in_parallel(jobs_of(4, wait))
    assert {values["pid"] for _, values in found} == {mine}


def test_where_no_process_or_memory_is_to_be_had_jobs_run_here(monkeypatch):
    def refuse(*_):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    for call in ("fork", "memfd_create", "pidfd_open"):
        with monkeypatch.context() as patched:
            patched.setattr(os, call, refuse)
            assert {values["pid"] for _, values in run_in_parallel(jobs_of(5))} == {os.getpid()}


def test_processes_that_someone_else_has_waited_for_are_as_good(monkeypatch):
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        found = run_in_parallel(jobs_of(6))
    finally:
        signal.signal(signal.SIGCHLD, before)
    assert len({values["pid"] for _, values in found}) == 3


def test_threads_and_processes_of_pools_take_no_other(monkeypatch):
    monkeypatch.undo()
    found = []
    thread = threading.Thread(target=lambda: found.append(cores._cores()))
    thread.start()
    thread.join()
    monkeypatch.setattr("multiprocessing.parent_process", lambda: "a pool")
    assert [*found, cores._cores()] == [1, 1]
