"""What a study says in TOML: the grid, and what is wrong with it."""

from __future__ import annotations

import ast
import os
from pathlib import Path

import pytest
from small_studies import CART, STUDY, search_study, written

from steady_ppl.errors import UsageError
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


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('title = "Small"', "", "has no title"),
        ("seeds = [1, 2]", "seeds = [-1]", r"seeds\[0\] is -1"),
        ("seeds = [1, 2]", "seeds = []", "at least one seed"),
        ("known_start", "known_stat", "unknown key known_stat"),
        ("train = 2", "trian = 2", "unknown key data.trian; there are simulate, train"),
        ("simulate", "simulation", "data has no source"),
        ('simulate = "{model}"', 'simulate = "{model}"\ntables = "."', "data has simulate and tables"),
        ("settings =", "setting =", "unknown key method.setting"),
        ("[50, 60]", "[50, 50]", "learned with seed 1 is there twice: .* lists values that differ"),
        ("seeds = [1, 2]", "seeds = [1, 1]", "as declared with seed 1 is there twice: .* seeds"),
        ('"as declared"', '" "', "method.name is ' ', expected a name"),
        ("[50, 60]", "[]", "validation_particles is an axis without a value"),
        ("[50, 60]", "2020-01-01", "validation_particles is .*expected numbers"),
        ("train = 2", "train = []", "train is an axis without a value"),
        ("train = 2", "train = 1.5", r"data.train\[0\] is 1.5, expected a whole number"),
        ("train = 2", "effect = 3", r"data.effect\[0\] is 3, expected text"),
        ("x = ", "z = ", "picture has no x"),
        ("title", "title title", "is not TOML"),
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


def test_a_search_has_no_recipe(tmp_path: Path):
    with pytest.raises(UsageError, match="method it: a search takes no recipe"):
        read_plan(written(tmp_path, search_study() + 'recipe = "hand"\n'))


def test_a_search_has_no_test_drives(tmp_path: Path):
    assert "data.test" not in read_plan(written(tmp_path, search_study())).jobs[0].columns
    with pytest.raises(UsageError, match="unknown key data.test; there are simulate, train, valid, effect, sig"):
        read_plan(written(tmp_path, search_study().replace("valid = 2", "valid = 2\ntest = 2")))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["known_start", "train", "program", "seed", "particles"])
def test_a_search_takes_the_settings_that_are_its_own(tmp_path: Path, name: str):
    require_runnable(read_plan(written(tmp_path, search_study(simulations=20, withheld="[['stiffness']]"))))
    with pytest.raises(UsageError, match=f"method it: discover has no setting {name}; it has mix, "):
        require_runnable(read_plan(written(tmp_path, search_study(**{name: 1}))))


def test_a_pipe_is_no_program(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe.py")
    with pytest.raises(UsageError, match=r"pipe.py is a pipe"):
        read_plan(written(tmp_path, STUDY.replace('program = "{model}"', 'program = "pipe.py"')))


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
