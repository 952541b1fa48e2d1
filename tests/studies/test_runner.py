"""A study is computed as far as it is not there, and what no job could do is said before any is begun."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import truck_logs
from small import MODELS, steady
from small_studies import CART, STUDY, written

from steady_ppl.data.table import write_table
from steady_ppl.errors import DataError, UsageError
from steady_ppl.model.loading import load_program
from steady_ppl.smc.simulate import simulate
from steady_ppl.studies.plan import read_plan
from steady_ppl.studies.runner import require_runnable
from steady_ppl.studies.table import TABLE, read_results


@pytest.mark.exhaustive
def test_the_command_computes_what_is_not_there_and_draws_it(tmp_path: Path, capsys):
    file, out = written(tmp_path), tmp_path / "out"
    assert steady("study", file, "--workers", 2, "--out", out) == 0
    said = capsys.readouterr()
    assert "6 of 6 jobs done" in said.out and "6/6" in said.err and "left" in said.err
    found = read_results(out).set_index("method")
    assert (found["outcome"] == "done").all() and found["log_likelihood"].notna().all()
    assert found.loc["learned", "settings.validation_particles"].tolist() and found["seed"].nunique() == 2
    before = (out / TABLE).read_bytes()
    assert steady("study", file, "--workers", 2, "--out", out) == 0
    assert "6 of 6 jobs are there already" in capsys.readouterr().err and (out / TABLE).read_bytes() == before
    assert steady("plot-study", out) == 0 and (out / "study.png").stat().st_size > 10_000
    assert sorted(file.name for file in out.iterdir()) == [TABLE, "study.json", "study.png"]


def test_a_folder_that_is_no_study_is_said(tmp_path: Path, capsys):
    assert steady("plot-study", tmp_path / "nowhere") == 2
    assert "nowhere is not a study: it has no study.json" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "{{validation_particles = [50, 60]}}",
            "{{validation_particles = [50, 60], particlez = 1}}",
            "no setting particlez",
        ),
        ('recipe = "hand"', 'recipe = "hands"', "method as declared: no recipe 'hands'"),
        ('program = "{model}"', 'program = "{model}:Nobody"', "Nobody"),
        ("test = 2", "test = 2\nsigma_deg = 3", "no bearing_sd that sigma_deg could set"),
        ("test = 2", 'test = 2\neffect = "zzz"', "zzz"),
        ('simulate = "{model}"', 'simulate = "{model}:Nobody"', "data: linear_gaussian.py has no model Nobody"),
        ('simulate = "{model}"', 'simulate = "nowhere.py"', "nowhere.py cannot be read"),
        (
            'program = "{model}"',
            f'program = "{MODELS / "hovercraft.py"}"',
            "as declared: the table has no column",
        ),
        (
            'simulate = "{model}"\ntrain = 2\nvalid = 2\ntest = 2',
            'tables = "."',
            "has no train.csv and no train.parquet",
        ),
    ],
)
def test_what_no_job_could_do_is_said_before_any_is_begun(tmp_path: Path, capsys, old: str, new: str, says: str):
    file = written(tmp_path, STUDY.replace(old, new, 1))
    assert steady("study", file, "--out", tmp_path / "out") == 2
    assert says in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_start_that_tables_do_not_know_is_said_before_any_job_is_begun(tmp_path: Path):
    measured = replace(simulate(load_program(CART), 2, seed=1), states=None)
    for part in ("train", "valid", "test"):
        write_table(measured, tmp_path / f"{part}.csv")
    text = STUDY.replace('simulate = "{model}"\ntrain = 2\nvalid = 2\ntest = 2', 'tables = "."')
    with pytest.raises(DataError, match="method as declared: a known start needs the true states"):
        require_runnable(read_plan(written(tmp_path, text)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("column", "says"),
    [
        ("forward.locaton", "there will be no column forward.locaton; forward has total, "),
        ("measurement.one", "measurement has one_step, coverage_90, open_loop_1s, open_loop_3s"),
    ],
)
def test_errors_that_no_program_has_are_said_before_any_job_is_begun(tmp_path: Path, column: str, says: str):
    text = STUDY[: STUDY.index("published")].replace('["log_likelihood"]', f'["{column}"]')
    with pytest.raises(UsageError, match=says):
        require_runnable(read_plan(written(tmp_path, text)))


@pytest.mark.slow
@pytest.mark.parametrize("file", sorted((MODELS.parent / "studies").glob("*.toml")), ids=lambda file: file.stem)
def test_a_ready_study_can_be_begun(tmp_path: Path, file: Path):
    for part in ("train", "valid", "test"):
        (tmp_path / part).mkdir()
        truck_logs.write(tmp_path / part, truck_logs.pose_log(), truck_logs.command_log())
    plan = read_plan(file, tmp_path if "alpha_truck" in file.read_text() else None)
    require_runnable(plan)
    assert plan.jobs and plan.picture is not None


def test_logs_that_are_not_there_are_said_before_any_job_is_begun(tmp_path: Path):
    with pytest.raises(DataError, match="data: train: no such folder"):
        require_runnable(read_plan(MODELS.parent / "studies" / "particles.toml", tmp_path))
