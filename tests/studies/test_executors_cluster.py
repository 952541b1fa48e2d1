"""A study on a Dask cluster of its own: the same results, whoever dies on the way."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pandas as pd
import pytest
from dask_cluster import Dask, free_port, wait_for
from small import MODELS, steady

from steady_ppl.errors import UsageError
from steady_ppl.studies import executors as clusters
from steady_ppl.studies.executors import Cluster
from steady_ppl.studies.plan import read_plan
from steady_ppl.studies.runner import run_study
from steady_ppl.studies.table import read_results

pytest.importorskip("distributed", reason="needs dask.distributed: pip install 'steady-ppl[cluster]'")

CART, HOVERCRAFT = MODELS / "linear_gaussian.py", MODELS / "hovercraft.py"
RECIPE = """
import os, time
from pathlib import Path
from steady_ppl import Fit

def fit(program, table, valid=None, *, known_start=False, seconds=0.0, seed=0):
    with (Path(__file__).parent / f"begun-{seed}").open("a") as file:
        file.write(f"{os.getpid()}\\n")
    time.sleep(seconds)
    return Fit(program, "slow", {}, seed=seed, known_start=known_start)
"""


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Dask]:
    cluster = Dask(tmp_path)
    try:
        yield cluster
    finally:
        cluster.end()


def study(folder: Path, seeds: int = 6, seconds: float = 1.0) -> Path:
    (folder / "slow.py").write_text(RECIPE)
    (folder / "study.toml").write_text(
        f"""
title = "On a cluster"
seeds = {list(range(1, seeds + 1))}
known_start = true
[data]
simulate = "{CART}"
train = 2
valid = 2
test = 2
[[method]]
name = "slow"
program = "{CART}"
recipe = "slow.py"
settings = {{seconds = {seconds}}}
"""
    )
    return folder / "study.toml"


@contextmanager
def begun(file: Path, dask: Dask, out: Path) -> Iterator[subprocess.Popen]:
    """`steady study` in a process, when its first results are there."""
    program = "import sys; from steady_ppl.cli.main import main; sys.exit(main(sys.argv[1:]))"
    words = ["study", str(file), "--cluster", dask.address, "--out", str(out)]
    with (out.parent / "said").open("w") as said:
        process = subprocess.Popen([sys.executable, "-c", program, *words], stdout=said, stderr=said)
    try:
        wait_for(lambda: process.poll() is not None or (out.is_dir() and len(read_results(out)) >= 2))
        assert process.poll() is None, (out.parent / "said").read_text()
        yield process
    finally:
        process.kill()
        process.wait()


def begun_by(folder: Path) -> dict[int, list[int]]:
    """The processes that have begun each seed's job."""
    return {
        int(file.name.partition("-")[2]): [int(line) for line in file.read_text().split()]
        for file in folder.glob("begun-*")
    }


def begun_times(folder: Path) -> dict[int, int]:
    """How often each seed's job was begun."""
    return {seed: len(processes) for seed, processes in begun_by(folder).items()}


def in_flight(folder: Path, out: Path) -> dict[int, int]:
    """Jobs that are begun and have not come, and the processes that are at them."""
    come = set(read_results(out)["seed"])
    return {seed: processes[-1] for seed, processes in begun_by(folder).items() if seed not in come}


def figures(out: Path) -> pd.DataFrame:
    """What does not depend on the machine."""
    found = read_results(out).sort_values("key").set_index("key")
    return found.drop(columns=["seconds", "peak_mib", "fit_seconds"])


@pytest.mark.exhaustive
def test_a_cluster_finds_what_this_machine_finds(tmp_path: Path, dask: Dask):
    file = study(tmp_path, seeds=4, seconds=0.0)
    text = file.read_text()
    text += f'[[method]]\nname = "trained"\nprogram = "{HOVERCRAFT}"\n'
    text += 'settings = {guide = "bootstrap", particles = 20, draws = 3, steps = 3}\n'
    file.write_text(text.replace(str(CART), str(HOVERCRAFT)))
    dask.scheduler()
    for _ in range(2):
        dask.worker()
    assert steady("study", file, "--workers", 1, "--out", tmp_path / "here") == 0
    assert steady("study", file, "--cluster", dask.address, "--out", tmp_path / "there") == 0
    pd.testing.assert_frame_equal(figures(tmp_path / "here"), figures(tmp_path / "there"))


@pytest.mark.slow
def test_a_worker_that_is_killed_takes_nothing_with_it(tmp_path: Path, dask: Dask):
    file, out = study(tmp_path, seconds=3.0), tmp_path / "out"
    dask.scheduler()
    for _ in range(2):
        dask.worker()
    with begun(file, dask, out) as process:
        wait_for(lambda: len(in_flight(tmp_path, out)) == 2)
        seed, victim = min(in_flight(tmp_path, out).items())
        os.kill(victim, signal.SIGKILL)
        assert process.wait(120) == 0, (tmp_path / "said").read_text()
    found = read_results(out)
    assert len(found) == 6 and (found["outcome"] == "done").all()
    assert begun_times(tmp_path) == {one: 2 if one == seed else 1 for one in range(1, 7)}  # none but what it was at


@pytest.mark.exhaustive
def test_what_has_come_is_let_go_of(tmp_path: Path, dask: Dask):
    """Or a worker that dies would have all that it has ever found computed again."""
    held = []
    dask.scheduler()
    dask.worker()
    with Cluster(dask.address) as place:
        run_study(
            read_plan(study(tmp_path, seeds=6, seconds=0.2)),
            tmp_path / "out",
            place,
            say=lambda line: held.append(len(place.client.futures)),
        )
    assert len(held) == 6 and held[-1] <= 2 and held == sorted(held, reverse=True)


@pytest.mark.exhaustive
def test_a_cluster_without_a_worker_is_said_and_waited_for(tmp_path: Path, dask: Dask, monkeypatch):
    monkeypatch.setattr(clusters, "WORKER_WAIT_SECONDS", 2)
    said, out = list[str](), tmp_path / "out"

    def hear(line: str) -> None:
        said.append(line)
        if "no worker left" in line:
            dask.worker()
        elif line.startswith("2/"):
            os.kill(only.pid, signal.SIGKILL)

    dask.scheduler()
    only = dask.worker()
    with Cluster(dask.address) as place:
        assert run_study(read_plan(study(tmp_path, seeds=4)), out, place, say=hear) == 0
    assert len(read_results(out)) == 4 and sum("no worker left" in line for line in said) == 1


DEADLY = RECIPE.replace("time.sleep(seconds)", "time.sleep(seconds)\n    if seed in (1, 5): os._exit(9)")


@pytest.mark.exhaustive
def test_jobs_that_kill_every_worker_are_given_up_and_no_other(tmp_path: Path, dask: Dask):
    """Also not what waits behind them at a worker, which Dask blames as well."""
    file, out = study(tmp_path, seeds=6, seconds=0.2), tmp_path / "out"
    (tmp_path / "slow.py").write_text(DEADLY)
    dask.scheduler()
    for _ in range(2):
        dask.nanny()
    with Cluster(dask.address) as place:
        assert run_study(read_plan(file), out, place) == 2
    found = read_results(out).set_index("seed")
    assert found["outcome"].to_dict() == {seed: "failed" if seed in (1, 5) else "done" for seed in range(1, 7)}
    times = begun_times(tmp_path)
    deaths = times[1] + times[5]
    assert all(3 <= times[deadly] <= 6 for deadly in (1, 5))
    # a worker may die before what it had just found has been fetched
    assert 4 <= sum(times[seed] for seed in (2, 3, 4, 6)) <= 4 + deaths


def joining(dask: Dask, path: Path, said: list[str]) -> Callable[[str], None]:
    """Hears what a study says, and starts a worker with `path` before all packages when a first result is there."""

    def hear(line: str) -> None:
        said.append(line)
        if line.startswith("1/"):
            dask.worker(PYTHONPATH=str(path))
            wait_for(lambda: (dask.folder / "dask.log").read_text().count("Register worker") >= 2)

    return hear


@pytest.mark.exhaustive
def test_a_worker_that_joins_late_and_is_unlike_this_machine_is_not_used(tmp_path: Path, dask: Dask):
    said, out = list[str](), tmp_path / "out"

    hear = joining(dask, other_version(tmp_path), said)
    dask.scheduler()
    dask.worker()
    with Cluster(dask.address) as place:
        assert run_study(read_plan(study(tmp_path, seeds=8, seconds=0.5)), out, place, say=hear) == 0
    (line,) = [line for line in said if "is not used" in line]
    assert "it has steady-ppl 0.0.1 (here " in line and (read_results(out)["outcome"] == "done").all()


@pytest.mark.exhaustive
def test_a_worker_that_joins_late_without_steady_ppl_disturbs_nobody(tmp_path: Path, dask: Dask):
    """Dask ends it with the first job that it cannot load."""
    said, out, other = list[str](), tmp_path / "out", tmp_path / "other" / "steady_ppl"
    other.mkdir(parents=True)
    (other / "__init__.py").write_text("raise ModuleNotFoundError('there is no steady-ppl here')\n")

    hear = joining(dask, other.parent, said)
    dask.scheduler()
    dask.worker()
    with Cluster(dask.address) as place:
        assert run_study(read_plan(study(tmp_path, seeds=8, seconds=0.5)), out, place, say=hear) == 0
    assert "there is no steady-ppl here" in (tmp_path / "dask.log").read_text()
    assert (read_results(out)["outcome"] == "done").sum() == 8


NO_RECIPE = """
import os
known = os.stat

def stat(path, *more, **others):
    if str(path).endswith("slow.py"):
        raise FileNotFoundError(2, "not there", path)
    return known(path, *more, **others)

os.stat = stat
"""


@pytest.mark.exhaustive
def test_a_worker_that_joins_late_and_sees_other_files_is_not_given_everything(tmp_path: Path, dask: Dask, monkeypatch):
    said, sent, out = list[str](), list[str](), tmp_path / "out"
    send, batch = clusters._Sent.send, Cluster._batch
    monkeypatch.setattr(clusters._Sent, "send", lambda of, job, **where: (sent.append(job.key), send(of, job, **where)))
    monkeypatch.setattr(Cluster, "_batch", lambda *given: (time.sleep(1), batch(*given))[1])  # it hears late
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "sitecustomize.py").write_text(NO_RECIPE)

    hear = joining(dask, tmp_path / "other", said)
    dask.scheduler()
    dask.worker()
    with Cluster(dask.address) as place:
        assert run_study(read_plan(study(tmp_path, seeds=20, seconds=0.5)), out, place, say=hear) == 0
    (line,) = [line for line in said if "is not used" in line]
    assert "it has other files than there are here" in line and (read_results(out)["outcome"] == "done").sum() == 20
    assert 1 <= len(sent) - 20 < 8  # 10 to 18 if it did not hold what it is given


@pytest.mark.exhaustive
def test_a_study_goes_on_when_its_scheduler_is_there_again(tmp_path: Path, dask: Dask):
    file, out = study(tmp_path), tmp_path / "out"
    scheduler = dask.scheduler()
    for _ in range(2):
        dask.worker()
    with begun(file, dask, out) as process:
        os.kill(scheduler.pid, signal.SIGKILL)
        assert process.wait(120) == 1
    said = (tmp_path / "said").read_text()
    there = int(re.search(r"the cluster is gone .*: (\d) of 6 jobs are kept", said)[1])  # type: ignore[index]
    kept = set(read_results(out)["seed"])
    assert "Traceback" not in said and len(kept) == there >= 2
    dask.end()
    dask.scheduler()
    dask.worker()
    assert steady("study", file, "--cluster", dask.address, "--out", out) == 0
    assert (read_results(out)["outcome"] == "done").sum() == 6
    assert {seed: times for seed, times in begun_times(tmp_path).items() if seed in kept} == dict.fromkeys(kept, 1)


@pytest.mark.slow
def test_nobody_who_answers_is_one_line(tmp_path: Path, capsys):
    address = f"tcp://127.0.0.1:{free_port()}"
    assert steady("study", study(tmp_path), "--cluster", address, "--out", tmp_path / "out") == 2
    assert f"no Dask scheduler answers at {address}" in capsys.readouterr().err


def other_version(folder: Path) -> Path:
    """A path on which steady-ppl says that it is of another version."""
    other = folder / "other" / "steady_ppl-0.0.1.dist-info"
    other.mkdir(parents=True)
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: steady-ppl\nVersion: 0.0.1\n")
    return other.parent


@pytest.mark.slow
def test_workers_that_would_find_something_else_are_refused(tmp_path: Path, dask: Dask, capsys, monkeypatch):
    file, out = study(tmp_path), tmp_path / "out"
    dask.scheduler()
    worker = dask.worker(PYTHONPATH=str(other_version(tmp_path)))
    assert steady("study", file, "--cluster", dask.address, "--out", out) == 2
    assert "has steady-ppl 0.0.1 (here " in capsys.readouterr().err and len(read_results(out)) == 0
    worker.kill()
    worker.wait()
    worker = dask.worker("--nthreads", "2")
    assert steady("study", file, "--cluster", dask.address, "--out", out) == 2
    said = capsys.readouterr().err
    assert "workers with several threads, which would take turns: tcp://127.0.0.1:" in said
    worker.kill()
    worker.wait()
    dask.worker()
    cluster = Cluster(dask.address)
    plan = read_plan(file)
    elsewhere = {str(tmp_path / "nowhere.py"): "nowhere.py 0"}
    monkeypatch.setattr(clusters.JobFiles, "digests_of", lambda files, jobs: elsewhere)
    with cluster, pytest.raises(UsageError, match="does not see .*nowhere.py as it is here: it needs the same paths"):
        list(cluster.results(plan.jobs, print))
