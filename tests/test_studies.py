"""Studies: grids from TOML, one table of results, workers that die, and what is drawn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from small import MODELS, steady

from steady_ppl.errors import RunError, UsageError
from steady_ppl.studies.job import require_runnable
from steady_ppl.studies.pictures import study_picture
from steady_ppl.studies.runner import Local, run_study
from steady_ppl.studies.study_file import read_plan
from steady_ppl.studies.table import ARRIVED, TABLE, StudyTable, read_results, study_table

CART = f"{MODELS / 'linear_gaussian.py'}"
STUDY = """
title = "Small"
seeds = [1, 2]
known_start = true

[data]
simulate = "{model}"
train = 2
valid = 2
test = 2

[[method]]
name = "as declared"
program = "{model}"
recipe = "hand"

[[method]]
name = "learned"
program = "{model}"
recipe = "likelihood"
settings = {{validation_particles = [50, 60]}}

[picture]
x = "settings.validation_particles"
y = ["log_likelihood"]
published = {{log_likelihood = {{learned = [[50, -5.0], [60, -4.0]]}}}}
"""


def written(folder: Path, text: str = STUDY, name: str = "study.toml", **words: str) -> Path:
    file = folder / name
    file.write_text(text.format(**{"model": CART} | words))
    return file


# --- the plan ---------------------------------------------------------------------------------------------------------


def test_every_list_is_an_axis_and_seeds_are_outermost(tmp_path: Path):
    plan = read_plan(written(tmp_path))
    assert [job.label for job in plan.jobs] == [
        f"{label} seed={seed}"
        for seed in (1, 2)
        for label in ("as declared", "learned validation_particles=50", "learned validation_particles=60")
    ]
    assert len({job.key for job in plan.jobs}) == 6 and plan.jobs[2].settings == {"validation_particles": 60}
    columns = plan.jobs[1].columns
    assert columns["data.simulate"] == "linear_gaussian.py" and columns["data.train"] == 2  # no folder of this machine


def test_a_job_is_known_by_what_it_depends_on_and_not_by_where_it_is(tmp_path: Path):
    keys = {}
    for place in ("here", "there", "changed"):
        (tmp_path / place).mkdir()
        program = tmp_path / place / "cart.py"
        program.write_text(Path(CART).read_text() + ("# changed\n" if place == "changed" else ""))
        keys[place] = [job.key for job in read_plan(written(tmp_path / place, model="cart.py:LinearGaussian")).jobs]
    assert keys["here"] == keys["there"] and not set(keys["here"]) & set(keys["changed"])


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('title = "Small"', "", "has no title"),
        ("seeds = [1, 2]", "seeds = [-1]", r"seeds\[0\] is -1"),
        ("seeds = [1, 2]", "seeds = []", "at least one seed"),
        ("known_start", "known_stat", "known_stat means nothing here"),
        ("train = 2", "trian = 2", "data.trian means nothing beside simulate"),
        ("simulate", "simulation", "data has no source"),
        ('simulate = "{model}"', 'simulate = "{model}"\ntables = "."', "data has simulate and tables"),
        ("settings =", "setting =", "method.setting means nothing here"),
        ("[50, 60]", "[50, 50]", "learned is there twice"),
        ("[50, 60]", "[]", "validation_particles is an axis without a value"),
        ("[50, 60]", "2020-01-01", "validation_particles is .*expected numbers"),
        ("train = 2", "train = []", "train is an axis without a value"),
        ("train = 2", "train = 1.5", r"data.train\[0\] is 1.5, expected a whole number"),
        ("train = 2", "effect = 3", r"data.effect\[0\] is 3, expected text"),
        ("x = ", "z = ", "picture has no x"),
        ("title", "title title", "cannot be read as TOML"),
        ('simulate = "{model}"', 'tables = "nowhere"', "there is no folder .*nowhere"),
    ],
)
def test_what_is_wrong_with_a_study_is_named(tmp_path: Path, old: str, new: str, says: str):
    text = STUDY.replace(old, new, 1)
    text = text.replace("train = 2\nvalid = 2\ntest = 2\n", "") if "nowhere" in new else text
    with pytest.raises(UsageError, match=says):
        read_plan(written(tmp_path, text))


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("{{validation_particles", "{{particlez", "method learned: recipe likelihood has no setting particlez"),
        ('recipe = "hand"', 'recipe = "hands"', "method as declared: no recipe 'hands'"),
        ('program = "{model}"', 'program = "{model}:Nobody"', "Nobody"),
        ("test = 2", "test = 2\nsigma_deg = 3", "no bearing_sd that sigma_deg could set"),
    ],
)
def test_what_no_job_could_do_is_said_before_any_is_begun(tmp_path: Path, capsys, old: str, new: str, says: str):
    file = written(tmp_path, STUDY.replace(old, new, 1))
    assert steady("study", file, "--out", tmp_path / "out") == 2
    assert says in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.parametrize("file", sorted((MODELS.parent / "studies").glob("*.toml")), ids=lambda file: file.stem)
def test_a_ready_study_can_be_begun(tmp_path: Path, file: Path):
    plan = read_plan(file, tmp_path if "alpha_truck" in file.read_text() else None)
    require_runnable(plan)
    assert plan.jobs and plan.picture is not None


# --- the table --------------------------------------------------------------------------------------------------------


def row(key: str, outcome: str = "done", **more: object) -> dict:
    return {"key": key, "outcome": outcome, **more}


def test_a_result_is_there_at_once_and_the_later_one_of_a_job_counts(tmp_path: Path):
    with study_table(tmp_path) as table:
        table.add(row("a", "failed", reason="no"))
        table.add(row("b", figure=2.0))
        assert set(read_results(tmp_path)["key"]) == {"a", "b"} and not (tmp_path / TABLE).exists()
        table.merge()
        table.add(row("a", figure=1.0))
        with pytest.raises(RunError, match="another process"), study_table(tmp_path):
            pass
    found = pd.read_parquet(tmp_path / TABLE).set_index("key")
    assert found["outcome"].to_dict() == {"a": "done", "b": "done"} and found["figure"].to_dict() == {
        "a": 1.0,
        "b": 2.0,
    }
    assert [file.name for file in tmp_path.iterdir()] == [TABLE]


def test_what_came_before_a_kill_is_not_lost(tmp_path: Path):
    (tmp_path / ARRIVED).mkdir()
    StudyTable(tmp_path).add(row("a"))  # nobody merges it
    with study_table(tmp_path) as table:
        table.add(row("b"))
    assert set(pd.read_parquet(tmp_path / TABLE)["key"]) == {"a", "b"}


def test_a_damaged_table_is_said(tmp_path: Path):
    (tmp_path / TABLE).write_bytes(b"PAR1 no")
    with pytest.raises(RunError, match="is damaged"):
        read_results(tmp_path)
    pd.DataFrame({"a": [1]}).to_parquet(tmp_path / TABLE)
    with pytest.raises(RunError, match="no table of a study"):
        read_results(tmp_path)


# --- workers ----------------------------------------------------------------------------------------------------------


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


RECIPE = """
import os, signal, time
from pathlib import Path
from steady_ppl import Fit

def fit(program, table, valid=None, *, known_start=False, mark="", deadly=False, seed=0):
    times = Path(mark) / str(seed)
    with times.open("a") as file:
        file.write("1")
    if deadly and (seed == 13 or times.stat().st_size == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 7:
        raise ValueError("seven\\nis not liked")
    return Fit(program, "mine", {{}}, seed=seed, known_start=known_start)
"""


def test_a_worker_that_dies_takes_nothing_with_it_and_a_deadly_job_is_given_up(tmp_path: Path, capsys):
    (tmp_path / "mine.py").write_text(RECIPE.format())
    (tmp_path / "marks").mkdir()
    text = STUDY[: STUDY.index("[[method]]")].replace("[1, 2]", "[1, 7, 13, 4]") + (
        '[[method]]\nname = "mine"\nprogram = "{model}"\nrecipe = "mine.py"\n'
        f'settings = {{{{deadly = true, mark = "{tmp_path / "marks"}"}}}}\n'
    )
    plan, out = read_plan(written(tmp_path, text)), tmp_path / "out"
    assert run_study(plan, out, Local(2, out)) == 2
    found = read_results(out).set_index("seed")
    assert found["outcome"].to_dict() == {1: "done", 4: "done", 7: "failed", 13: "failed"}
    assert (
        found.loc[7, "reason"] == "ValueError: seven"
        and found.loc[13, "reason"] == "its worker died each time that it was tried"
    )
    assert (tmp_path / "marks" / "1").stat().st_size == 2 and (tmp_path / "marks" / "13").stat().st_size == 3
    assert sorted(file.name for file in out.iterdir()) == [TABLE, "study.json"]
    assert run_study(plan, out, Local(2, out)) == 2  # what has failed is left
    assert (tmp_path / "marks" / "7").stat().st_size == 2
    assert run_study(plan, out, Local(2, out), again=True) == 2
    assert (tmp_path / "marks" / "7").stat().st_size == 3


def test_a_picture_needs_its_columns(tmp_path: Path):
    plan = read_plan(written(tmp_path))
    rows = [job.columns | {"outcome": "done", "log_likelihood": 1.0} for job in plan.jobs]
    figure = study_picture(plan, pd.DataFrame(rows))
    (axes,) = figure.axes
    assert axes.get_xlabel() == "settings.validation_particles" and axes.get_ylabel() == "log_likelihood"
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [
        "learned, published",
        "as declared",
        "learned",
    ]
    with pytest.raises(UsageError, match="no job of the study is done"):
        study_picture(plan, pd.DataFrame({"key": []}))
    with pytest.raises(UsageError, match="no column log_likelihood"):
        study_picture(plan, pd.DataFrame(rows).drop(columns="log_likelihood"))
    with pytest.raises(UsageError, match=r"no \[picture\]"):
        study_picture(replace(plan, picture=None), pd.DataFrame(rows))
