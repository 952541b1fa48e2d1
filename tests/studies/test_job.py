"""One job: its key, what it plants, and what its programs are told."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from small import MODELS
from small_studies import CART, STUDY, search_study, written

from steady_ppl.studies.job import OUTDATED, in_limits, planted_effect, run, settings_with_noise
from steady_ppl.studies.plan import read_plan


def test_a_job_is_known_by_what_it_depends_on_and_not_by_where_it_is(tmp_path: Path):
    keys = {}
    for place in ("here", "there", "changed"):
        (tmp_path / place).mkdir()
        program = tmp_path / place / "cart.py"
        program.write_text(Path(CART).read_text() + ("# changed\n" if place == "changed" else ""))
        keys[place] = [job.key for job in read_plan(written(tmp_path / place, model="cart.py:LinearGaussian")).jobs]
    assert keys["here"] == keys["there"] and not set(keys["here"]) & set(keys["changed"])


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
    text = search_study().replace('["", "linear_drag=0.5"]', f'"{effect}"')
    variant, found = planted_effect(read_plan(written(tmp_path, text)).jobs[0])
    assert (variant.name if variant else "") == name and found == pytest.approx(value)


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


def test_every_program_of_a_job_knows_the_noise_of_the_bearings(tmp_path: Path):
    hovercraft = MODELS / "hovercraft.py"
    text = STUDY[: STUDY.index("[[method]]")].format(model=hovercraft) + "sigma_deg = 20.0\n"
    text += f'[[method]]\nname = "by hand"\nprogram = "{hovercraft}"\nrecipe = "fit-hand"\n'
    text += f'settings = {{hand = "{hovercraft}", lineages = 2}}\n'
    (tmp_path / "study.toml").write_text(text)
    settings = settings_with_noise(read_plan(tmp_path / "study.toml").jobs[0])
    assert settings["hand"].bearing_sd == pytest.approx(math.radians(20)) and settings["lineages"] == 2


@pytest.mark.slow
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
