"""Studies: grids from TOML, one table of results, workers that die, and what is drawn."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from small import MODELS, steady

from steady_ppl.errors import RunError, UsageError
from steady_ppl.studies.job import _told_settings, require_runnable, run
from steady_ppl.studies.pictures import study_picture
from steady_ppl.studies.places import Local
from steady_ppl.studies.plan import RECORD, record_plan, recorded_plan
from steady_ppl.studies.runner import run_study
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
        ('simulate = "{model}"', 'simulate = "a\\u0000.py"', "is no path"),
        ('program = "{model}"', 'program = "a\\u0000.py"', "is no path"),
        ("train = 2", "train = 0", "data.train is 0, expected more than 0"),
        ("test = 2", "test = 2\nsigma_deg = -1", "data.sigma_deg is -1, expected more than 0"),
        ("train = 2", f"train = [{', '.join(map(str, range(1, 60_000)))}]", "359,994 jobs; expected at most"),
        ("[50, 60]", "[[[1979-05-27]]]", "validation_particles is .*expected numbers"),
        ("[50, 60]", "[9223372036854775808]", "validation_particles is .*expected numbers"),
        ("[50, 60]", "[1e200]", "validation_particles is 1e.200, expected numbers"),
        ('"settings.validation_particles"', '"method"', "picture: column method is no number"),
        ('"settings.validation_particles"', '"settings.particles"', "there will be no column settings.particles"),
        ("y = [", 'chosen_by = "valid_log_likelihood"\ny = [', "x is settings.validation_particles, expected data"),
        ("published = {{log_likelihood", "published = {{likelihood", "likelihood is no panel; y has log_likelihood"),
        ('["log_likelihood"]', '["log_likelyhood"]', "there will be no column log_likelyhood; .*data.train, .*steps"),
        ('["log_likelihood"]', "[]", "picture.y has 0 columns"),
        ("[60, -4.0]", "[60]", r"learned: \[60\] is no point"),
        ("[60, -4.0]", "[60, 1e200]", "is no point"),
        ('title = "Small"', f'title = "{"x" * 1001}"', "more than 1000 characters"),
        ("train = 2", "train = 9223372036854775807", "at most 1,000,000"),
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
        (
            "{{validation_particles = [50, 60]}}",
            "{{validation_particles = [50, 60], particlez = 1}}",
            "no setting particlez",
        ),
        ('recipe = "hand"', 'recipe = "hands"', "method as declared: no recipe 'hands'"),
        ('program = "{model}"', 'program = "{model}:Nobody"', "Nobody"),
        ("test = 2", "test = 2\nsigma_deg = 3", "no bearing_sd that sigma_deg could set"),
        ("test = 2", 'test = 2\neffect = "zzz"', "zzz"),
        ('simulate = "{model}"', 'simulate = "{model}:Nobody"', "data: linear_gaussian.py has no program Nobody"),
        ('simulate = "{model}"', 'simulate = "nowhere.py"', "nowhere.py cannot be read"),
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


def discover(**settings: object) -> str:
    text = STUDY[: STUDY.index("[[method]]")].replace("test = 2\n", 'effect = ["", "linear_drag=0.5"]\n')
    said = ", ".join(f"{name} = {value}" for name, value in settings.items())
    return f'task = "discover"{text}[[method]]\nname = "it"\nprogram = "{{model}}"\nsettings = {{{{{said}}}}}\n'


@pytest.mark.parametrize("name", ["known_start", "train", "program", "seed", "particles"])
def test_a_search_takes_the_settings_that_are_its_own(tmp_path: Path, name: str):
    require_runnable(read_plan(written(tmp_path, discover(simulations=20, withheld="[['stiffness']]"))))
    with pytest.raises(UsageError, match=f"method it: discover has no setting {name}; there are mix, "):
        require_runnable(read_plan(written(tmp_path, discover(**{name: 1}))))


def keys(file: Path) -> list[str]:
    return [job.key for job in read_plan(file).jobs]


def test_a_key_goes_by_what_a_program_imports_and_by_the_tables_alone(tmp_path: Path):
    for name in ("mine", "gains", "bystander"):
        (tmp_path / f"{name}.py").write_text(f"from .gains import GAIN, {name}\n" if name == "mine" else "GAIN = 1\n")
    tables = tmp_path / "tables"
    tables.mkdir()
    for part in ("train", "valid", "test"):
        (tables / f"{part}.csv").write_text("trajectory,time\n")
    text = STUDY[: STUDY.index("[data]")] + '[data]\ntables = "tables"\n[[method]]\nname = "m"\nprogram = "mine.py"\n'
    before = keys(written(tmp_path, text))
    (tmp_path / "bystander.py").write_text("GAIN = 2\n")
    (tables / "results.parquet").write_text("of a study in this folder")
    assert keys(tmp_path / "study.toml") == before
    for file, content in ((tmp_path / "gains.py", "GAIN = 2\n"), (tables / "valid.csv", "trajectory,time,u.push\n")):
        file.write_text(content)
        assert not set(keys(tmp_path / "study.toml")) & set(before)
        before = keys(tmp_path / "study.toml")


def test_a_pipe_is_no_program(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe.py")
    with pytest.raises(UsageError, match=r"pipe.py is a pipe"):
        read_plan(written(tmp_path, STUDY.replace('program = "{model}"', 'program = "pipe.py"')))


def test_every_program_of_a_job_knows_the_noise_of_the_bearings(tmp_path: Path):
    hovercraft = MODELS / "hovercraft.py"
    text = STUDY[: STUDY.index("[[method]]")].format(model=hovercraft) + "sigma_deg = 20.0\n"
    text += f'[[method]]\nname = "by hand"\nprogram = "{hovercraft}"\nrecipe = "fit-hand"\n'
    text += f'settings = {{hand = "{hovercraft}", lineages = 2}}\n'
    (tmp_path / "study.toml").write_text(text)
    settings = _told_settings(read_plan(tmp_path / "study.toml").jobs[0])
    assert settings["hand"].bearing_sd == pytest.approx(math.radians(20)) and settings["lineages"] == 2


def test_what_was_changed_while_a_study_went_on_is_no_result(tmp_path: Path):
    folder = tmp_path / "a.pyenv"  # a folder may be called so
    folder.mkdir()
    (folder / "mine.py").write_text((MODELS / "linear_gaussian.py").read_text())
    text = STUDY.replace('program = "{model}"', 'program = "a.pyenv/mine.py:LinearGaussian"')
    job = read_plan(written(tmp_path, text)).jobs[0]
    assert run(job)["outcome"] == "done"
    with (folder / "mine.py").open("a") as file:
        file.write("# changed\n")
    assert "is not what it was when the study was begun" in run(job)["reason"]


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


def test_a_column_of_several_kinds_is_text(tmp_path: Path):
    with study_table(tmp_path) as table:
        table.add(row("a", **{"settings.rate": 1, "settings.steps": 3}))
        table.add(row("b", **{"settings.rate": "auto", "settings.steps": 3.5}))
        table.add(row("c", **{"settings.rate": True}))
    found = pd.read_parquet(tmp_path / TABLE).set_index("key")
    assert found["settings.rate"].to_dict() == {"a": "1", "b": "auto", "c": "True"}
    assert found["settings.steps"].tolist()[:2] == [3.0, 3.5] and pd.isna(found.loc["c", "settings.steps"])


@pytest.mark.parametrize(
    "damage",
    [
        {"key": [[1]]},
        {"key": ["a"], "outcome": ["done"], "settings.a": [[1]]},
        {"key": ["a"], "outcome": [1]},
        {"outcome": ["done"]},
    ],
)
def test_a_table_of_other_columns_is_said(tmp_path: Path, damage: dict):
    pd.DataFrame(damage).to_parquet(tmp_path / TABLE)
    with pytest.raises(RunError, match="no table of a study"):
        read_results(tmp_path)


def test_text_that_is_none_and_foreign_metadata_are_said(tmp_path: Path):
    broken = pa.Array.from_buffers(pa.string(), 1, pa.array([b"\xff\xfe"]).buffers())
    pq.write_table(pa.table({"key": broken, "outcome": ["done"]}), tmp_path / TABLE)
    with pytest.raises(RunError, match="is damaged"):
        read_results(tmp_path)
    table = pa.table({"key": ["a"], "outcome": ["done"]}).replace_schema_metadata(
        {"pandas": '{"index_columns": ["z"]}'}
    )
    pq.write_table(table, tmp_path / TABLE)
    assert read_results(tmp_path)["key"].tolist() == ["a"]


def test_a_pipe_and_a_link_to_nothing_are_no_table(tmp_path: Path):
    (tmp_path / TABLE).symlink_to(tmp_path / "nothing")
    with pytest.raises(RunError, match="is damaged"):
        read_results(tmp_path)
    (tmp_path / TABLE).unlink()
    os.mkfifo(tmp_path / TABLE)
    with pytest.raises(RunError, match="is a pipe"):
        read_results(tmp_path)


def test_a_link_is_not_followed_and_what_is_not_the_studys_stays(tmp_path: Path):
    others, out = tmp_path / "others", tmp_path / "out"
    for folder in (others, out):
        folder.mkdir()
    pd.DataFrame([row("z")]).to_parquet(others / "mine.parquet")
    (out / ARRIVED).symlink_to(others)
    with pytest.raises(RunError, match="is a link"), study_table(out):
        pass
    (out / ARRIVED).unlink()
    (out / "begun").symlink_to(others)
    assert run_study(replace(read_plan(written(tmp_path)), jobs=()), out, Local(1)) == 0
    (out / ARRIVED).mkdir()
    (out / ARRIVED / "notes.txt").touch()
    with study_table(out) as table:
        table.add(row("a"))
    assert (out / ARRIVED / "notes.txt").exists() and (others / "mine.parquet").exists()


def test_a_damaged_record_and_one_of_a_newer_version_are_said(tmp_path: Path):
    record_plan(read_plan(written(tmp_path)), tmp_path)
    record = json.loads((tmp_path / RECORD).read_text())
    assert recorded_plan(tmp_path) == read_plan(tmp_path / "study.toml")
    (tmp_path / RECORD).write_text(json.dumps(record | {"picture": record["picture"] | {"y": []}}))
    with pytest.raises(RunError, match="damaged: picture.y has 0 columns"):
        recorded_plan(tmp_path)
    (tmp_path / RECORD).write_text(json.dumps(record | {"format": 99}))
    with pytest.raises(RunError, match="written by a newer steady-ppl: its form is number 99"):
        recorded_plan(tmp_path)


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
    if seed == 4:
        raise SystemExit("four \\udcff")
    return Fit(program, "mine", {{}}, seed=seed, known_start=known_start)
"""


@pytest.mark.parametrize("workers", [1, 2])
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
    assert (tmp_path / "marks" / "1").stat().st_size == 2 and (tmp_path / "marks" / "13").stat().st_size == 3
    assert sorted(file.name for file in out.iterdir()) == [TABLE, "study.json"]
    assert run_study(plan, out, Local(workers)) == 3  # what has failed is left
    assert (tmp_path / "marks" / "7").stat().st_size == 2
    assert run_study(plan, out, Local(workers), again=True) == 3
    assert (tmp_path / "marks" / "7").stat().st_size == 3


def test_what_failed_is_in_the_picture_and_names_are_no_formulas(tmp_path: Path):
    plan = read_plan(written(tmp_path, STUDY.replace('"learned"', r'"\u001b[2J$\\frac{{$"')))
    rows = [job.columns | {"outcome": "done", "log_likelihood": 1e300 if job.seed == 1 else 1.0} for job in plan.jobs]
    failed = [one for one in rows if one.get("settings.validation_particles") == 60]
    for one in failed:
        one |= {"outcome": "failed", "reason": "no", "log_likelihood": None}
    figure = study_picture(plan, pd.DataFrame(rows))
    figure.savefig(tmp_path / "study.png")
    (axes,) = figure.axes
    said = [text.get_text() for text in figure.legends[0].get_texts()]
    assert any("2 of 4 failed" in one for one in said) and not any("\x1b" in one for one in said)
    (crosses,) = [line for line in axes.lines if line.get_marker() == "x"]
    assert crosses.get_xdata().tolist() == [60.0]


def test_of_settings_that_were_tried_the_best_on_held_out_drives_is_drawn(tmp_path: Path):
    text = STUDY.replace("train = 2", "train = [2, 4]").replace("settings.validation_particles", "data.train", 1)
    text = text.replace("y = [", 'chosen_by = "valid_log_likelihood"\ny = [')
    plan = read_plan(written(tmp_path, text[: text.index("published")]))
    rows = []
    for job in plan.jobs:
        more, tried = job.data["train"] == 4, job.settings.get("validation_particles", 0)
        held_out = tried if more else -tried
        rows.append(job.columns | {"outcome": "done", "valid_log_likelihood": held_out, "log_likelihood": float(tried)})
        if tried == 60 and not more:
            rows[-1] |= {"valid_log_likelihood": 99.0}
            if job.seed == 2:  # better where it did not fail
                rows[-1] |= {"outcome": "failed", "valid_log_likelihood": None, "log_likelihood": None}
        if tried == 50 and more and job.seed == 2:  # a seed that only these settings have come to, and a large one
            rows[-1] |= {"valid_log_likelihood": 1000.0}
    rows = [
        one
        for one in rows
        if not (one.get("settings.validation_particles") == 60 and one["data.train"] == 4 and one["seed"] == 2)
    ]
    (axes,) = study_picture(plan, pd.DataFrame(rows)).axes
    found = {str(bars.get_label()): bars.lines[0].get_ydata().tolist() for bars in axes.containers}
    assert found == {"as declared": [0.0, 0.0], "learned": [50.0, 60.0]}


def test_a_picture_needs_its_columns(tmp_path: Path):
    plan = read_plan(written(tmp_path))
    rows = [job.columns | {"outcome": "done", "log_likelihood": 1.0} for job in plan.jobs]
    figure = study_picture(plan, pd.DataFrame(rows))
    (axes,) = figure.axes
    assert axes.get_xlabel() == "settings.validation_particles" and axes.get_ylabel() == "log_likelihood"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["as declared", "published", "learned"]
    with pytest.raises(UsageError, match="no job of the study is done"):
        study_picture(plan, pd.DataFrame({"key": []}))
    with pytest.raises(UsageError, match="no column log_likelihood"):
        study_picture(plan, pd.DataFrame(rows).drop(columns="log_likelihood"))
    with pytest.raises(UsageError, match="column log_likelihood of the table holds no numbers"):
        study_picture(plan, pd.DataFrame(rows).assign(log_likelihood="much"))
    with pytest.raises(UsageError, match=r"no \[picture\]"):
        study_picture(replace(plan, picture=None), pd.DataFrame(rows))
