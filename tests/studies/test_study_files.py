"""What a study says in TOML: the grid, the keys, and what is wrong with it."""

from __future__ import annotations

import ast
import math
import os
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
from steady_ppl.studies.job import OUTDATED, in_limits, planted_effect, run, settings_with_noise
from steady_ppl.studies.plan import read_plan
from steady_ppl.studies.runner import require_runnable


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
        ("[50, 60]", "[50, 50]", "learned with seed 1 is there twice: .* lists values that differ"),
        ("seeds = [1, 2]", "seeds = [1, 1]", "as declared with seed 1 is there twice: .* seeds"),
        ('"as declared"', '" "', "method.name is ' ', expected a name"),
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
        (
            '["log_likelihood"]',
            '["log_likelyhood"]',
            "no column log_likelyhood; .*data.train, .*forward.…, .*steps",
        ),
        ('["log_likelihood"]', "[]", "picture.y has 0 columns"),
        ("y = [", 'chosen_by = "forward.total"\ny = [', "chosen_by is forward.total, expected valid_log_likelihood"),
        ("x = ", 'leave_out = ["learnt"]\nx = ', "leave_out: learnt is no method; there are as declared, learned"),
        (
            "x = ",
            'labels = {{learnt = "a"}}\nx = ',
            "labels: learnt is not in the picture; there are settings.*, learned",
        ),
        ("[60, -4.0]", "[60]", r"learned\[1\] is \[60\], expected a list of 2"),
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


def discover(**settings: object) -> str:
    text = STUDY[: STUDY.index("[[method]]")].replace("test = 2\n", 'effect = ["", "linear_drag=0.5"]\n')
    said = ", ".join(f"{name} = {value}" for name, value in settings.items())
    return f'task = "discover"{text}[[method]]\nname = "it"\nprogram = "{{model}}"\nsettings = {{{{{said}}}}}\n'


@pytest.mark.parametrize(
    ("effect", "name", "value"),
    [
        ("", "", []),
        ("linear_drag=0.5", "linear_drag", [0.5]),
        ("measurement_noise=1.5", "measurement_noise", [0.5]),
        ("measurement_noise", "measurement_noise", [0.5]),
    ],
)
def test_what_is_planted_is_told_from_where_it_is_absent(tmp_path: Path, effect: str, name: str, value: list):
    text = discover().replace('["", "linear_drag=0.5"]', f'"{effect}"')
    variant, found = planted_effect(read_plan(written(tmp_path, text)).jobs[0])
    assert (variant.name if variant else "") == name and found == pytest.approx(value)


def test_a_search_has_no_recipe(tmp_path: Path):
    with pytest.raises(UsageError, match="method it: a recipe means nothing to a search"):
        read_plan(written(tmp_path, discover() + 'recipe = "hand"\n'))


def test_a_search_has_no_test_drives(tmp_path: Path):
    assert "data.test" not in read_plan(written(tmp_path, discover())).jobs[0].columns
    with pytest.raises(UsageError, match="data.test means nothing beside simulate; there is train, valid, effect, sig"):
        read_plan(written(tmp_path, discover().replace("valid = 2", "valid = 2\ntest = 2")))


@pytest.mark.parametrize("name", ["known_start", "train", "program", "seed", "particles"])
def test_a_search_takes_the_settings_that_are_its_own(tmp_path: Path, name: str):
    require_runnable(read_plan(written(tmp_path, discover(simulations=20, withheld="[['stiffness']]"))))
    with pytest.raises(UsageError, match=f"method it: discover has no setting {name}; it has mix, "):
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


def test_a_key_goes_by_packages_in_the_folder(tmp_path: Path):
    files = {"pkg/__init__.py": "", "pkg/gains.py": "from ..shared import ONE\nfrom . import more\n", "pkg/more.py": ""}
    files |= {"shared.py": "ONE = 1\n", "mine.py": "from .pkg.gains import ONE\n"}
    (tmp_path / "pkg").mkdir()
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    seen = {tuple(keys(written(tmp_path, STUDY.replace('program = "{model}"', 'program = "mine.py"'))))}
    for many, name in enumerate(files, 2):
        (tmp_path / name).write_text(files[name] + "# changed\n")
        seen.add(tuple(keys(tmp_path / "study.toml")))
        assert len(seen) == many, name


def test_a_list_among_settings_does_not_tie_a_key_to_its_folder(tmp_path: Path):
    found = set()
    for place in ("here", "there"):
        (tmp_path / place).mkdir()
        (tmp_path / place / "mine.py").write_text("")
        text = STUDY.replace("[50, 60]", '[["mine.py", "mine.py"]]')
        found.add(
            tuple(keys(written(tmp_path / place, text.replace('x = "settings.validation_particles"', 'x = "seed"'))))
        )
    assert len(found) == 1


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
    settings = settings_with_noise(read_plan(tmp_path / "study.toml").jobs[0])
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
    assert run(job)["reason"] == OUTDATED
    (folder / "mine.py").unlink()
    assert run(job)["reason"] == OUTDATED


def test_a_wave_is_the_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "cart.py").write_text(Path(CART).read_text())
    job = read_plan(written(tmp_path, model="~/cart.py:LinearGaussian")).jobs[0]
    assert job.program == job.data["simulate"] == f"{tmp_path / 'cart.py'}:LinearGaussian"


def test_each_program_is_parsed_once_for_all_jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    parsed = []
    monkeypatch.setattr("ast.parse", lambda text, parse=ast.parse: parsed.append(text) or parse(text))
    assert len(read_plan(written(tmp_path)).jobs) == 6
    assert 3 <= len(parsed) == len(set(parsed))


@pytest.mark.parametrize(
    ("value", "limit", "expected"),
    [
        ([], None, 0.0),
        ([0.0], [0.3], 0.0),
        ([0.3, -0.6], [0.3, 0.3], 2.0),
        ([0.6, 0.0], [0.1, 0.3], 6.0),
        ([0.5], None, math.nan),
    ],
)
def test_how_large_an_effect_is_in_detection_limits(value: list, limit: list | None, expected: float):
    assert in_limits(value, limit) == pytest.approx(expected, nan_ok=True)
