"""Program files: loading by path, siblings, two files of one name, and one clear line for what does not load."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path

import pytest
import torch
from examples import MODELS
from small import HOVERCRAFT

from steady_ppl import ProgramError, load_program, simulate
from steady_ppl.model.validate import probe

BOAT = """\
from steady_ppl import Program

class Boat(Program):
    states = ("x [m]",)
    measurements = ("x [m]",)
    color = "red"

class SmallBoat(Boat):
    color = "blue"
"""


def boat(path: Path, text: str = BOAT) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(textwrap.dedent(text))
    return path


def test_a_file_gives_the_class_that_is_named_after_it(tmp_path: Path) -> None:
    assert type(load_program(boat(tmp_path / "boat.py"))).__name__ == "Boat"
    text = BOAT.replace("SmallBoat", "RowingBoat2").replace("blue", "green")
    assert load_program(boat(tmp_path / "rowing_boat2.py", text)).color == "green"


def test_another_class_of_the_file_is_named_after_a_colon(tmp_path: Path) -> None:
    file = boat(tmp_path / "boat.py")
    assert load_program(f"{file}:SmallBoat").color == "blue"


def test_a_folder_with_a_colon_in_its_name_is_no_obstacle(tmp_path: Path) -> None:
    file = boat(tmp_path / "run 12:30" / "boat.py")
    assert load_program(file).color == "red"
    assert load_program(f"{file}:SmallBoat").color == "blue"


def test_a_relative_path_is_relative_to_the_working_directory(tmp_path: Path, monkeypatch) -> None:
    boat(tmp_path / "models" / "boat.py")
    monkeypatch.chdir(tmp_path)
    assert load_program("models/boat.py").color == "red"
    assert load_program("models/boat.py:SmallBoat").color == "blue"


def test_a_sibling_is_imported_from_the_files_own_folder(tmp_path: Path, monkeypatch) -> None:
    boat(tmp_path / "mine" / "parts.py", "color = 'white'\n")
    boat(tmp_path / "parts.py", "color = 'wrong'\n")
    monkeypatch.chdir(tmp_path)
    text = "from .parts import color as _color\n" + BOAT.replace('color = "red"', "color = _color")
    assert load_program(boat(tmp_path / "mine" / "boat.py", text)).color == "white"


def test_a_program_extends_one_of_another_file(tmp_path: Path) -> None:
    (tmp_path / "hovercraft.py").write_text(HOVERCRAFT.read_text())
    text = "from .hovercraft import Hovercraft\nclass Tug(Hovercraft):\n    duration = 1.0\n"
    program = load_program(boat(tmp_path / "tug.py", text))
    probe(program)
    assert simulate(program, 2).time.shape == (11, 2)


def test_a_package_called_models_where_the_user_works_does_no_harm(tmp_path: Path, monkeypatch) -> None:
    boat(tmp_path / "models" / "__init__.py", "raise RuntimeError('this is not for steady')\n")
    boat(tmp_path / "models" / "hovercraft.py", "color = 'wrong'\n")
    boat(tmp_path / "inference" / "__init__.py", "raise RuntimeError('this is not for steady')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for name in [name for name in sys.modules if name.split(".")[0] in ("models", "inference")]:
        monkeypatch.delitem(sys.modules, name)  # another test's benchmark has imported them
    assert type(load_program(MODELS / "hovercraft.py")).__name__ == "Hovercraft"
    assert not {"models", "inference", "hovercraft"} & sys.modules.keys()
    boat(tmp_path / "models" / "__init__.py", "color = 'theirs'\n")
    import models  # the user's own, which stays what it is

    load_program(MODELS / "pendulum.py")
    assert models.color == "theirs"
    for name in ("models", "models.hovercraft"):
        sys.modules.pop(name, None)


def test_two_files_of_one_name_in_two_folders_are_two_programs(tmp_path: Path) -> None:
    parts = "color = '{}'\n"
    text = "from .parts import color as _color\n" + BOAT.replace('color = "red"', "color = _color")
    programs = []
    for color in ("black", "white"):
        boat(tmp_path / color / "parts.py", parts.format(color))
        programs.append(load_program(boat(tmp_path / color / "boat.py", text)))
    assert [program.color for program in programs] == ["black", "white"]


def test_an_import_that_waits_for_its_call_finds_its_own_sibling_too(tmp_path: Path) -> None:
    programs = []
    for color in ("black", "white"):
        boat(tmp_path / color / "parts.py", f"color = '{color}'\n")
        text = BOAT + "\n    def paint(self):\n        from .parts import color\n        return color\n"
        programs.append(load_program(f"{boat(tmp_path / color / 'boat.py', text)}:SmallBoat"))
    assert [program.paint() for program in programs] == ["black", "white"]


def test_a_file_that_changed_is_read_again(tmp_path: Path) -> None:
    assert load_program(boat(tmp_path / "boat.py")).color == "red"
    assert load_program(boat(tmp_path / "boat.py", BOAT.replace("red", "yellow"))).color == "yellow"


def test_a_copy_with_one_line_changed_is_a_program_of_its_own(tmp_path: Path) -> None:
    text = HOVERCRAFT.read_text()
    line, changed = (f"mean = stack({by}(left + right) / self.mass" for by in ("", "2 * "))
    assert text.count(line) == 1
    copy = tmp_path / "hovercraft.py"
    copy.write_text(text.replace(line, changed))
    programs = [load_program(file) for file in (HOVERCRAFT, copy)]
    ways = []
    for program in programs:
        probe(program)
        program.noise, program.duration = torch.full((3,), 1e-6), 3.0
        data = simulate(program, 4, seed=1)
        forward = program.body_velocity(data.states)[0]
        ways.append((forward[-1] - forward[0]).mean())
    assert ways[1] > ways[0] > 0


def constructed(arguments: str, line: str) -> str:
    return f"from steady_ppl import Program\nclass Boat(Program):\n    def __init__({arguments}):\n        {line}\n"


# --- what does not load -----------------------------------------------------------------------------------------------


BROKEN = [
    pytest.param("x = 1\n\nclass Boat(:\n", "line 3 of boat.py: SyntaxError", id="syntax"),
    pytest.param(
        "x = 1\nimport nowhere\n", "line 2 of boat.py: ModuleNotFoundError: No module named 'nowhere'", id="import"
    ),
    pytest.param("def f():\n    return 1 / 0\n\nf()\n", "line 2 of boat.py: ZeroDivisionError", id="exception"),
    pytest.param("from .parts import x\n", "line 1 of boat.py: ModuleNotFoundError", id="no sibling"),
    pytest.param(
        "x = 1\nraise ValueError('one\\ntwo')\n",
        "line 2 of boat.py: ValueError: one",
        id="two lines",
    ),
    pytest.param(
        "x = 1\nraise SystemExit('enough')\n",
        "line 2 of boat.py: SystemExit: enough",
        id="exit",
    ),
    pytest.param("", "boat.py has no model Boat; its models: none (choose with", id="empty"),
    pytest.param("class Ship: pass\n", "boat.py has no model Boat; its models: none (choose with", id="another class"),
    pytest.param("class Boat: pass\n", "boat.py has no model Boat", id="no subclass"),
    pytest.param("def Boat(): pass\n", "boat.py has no model Boat; its models: none", id="function"),
    pytest.param("from steady_ppl import Program as Boat\n", "declares no states", id="the form itself"),
    pytest.param(
        constructed("self", "raise ValueError('one\\ntwo')"),
        "Boat() of boat.py failed: ValueError: one",
        id="constructor",
    ),
    pytest.param(constructed("self, size", "pass"), "Boat() of boat.py failed: TypeError", id="argument"),
    pytest.param(constructed("self", "self.a = self.b"), "Boat() of boat.py failed: AttributeError", id="attribute"),
]


@pytest.mark.parametrize(("text", "says"), BROKEN)
def test_a_file_that_gives_no_program_is_one_line_with_its_place(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(ProgramError) as caught:
        probe(load_program(boat(tmp_path / "boat.py", text)))
    assert says in str(caught.value) and "\n" not in str(caught.value)


def test_an_error_in_a_sibling_names_the_sibling_and_its_line(tmp_path: Path) -> None:
    for text, says in (("x = 1\ny = (\n", "SyntaxError"), ("x = 1\ny = 1 / 0\n", "ZeroDivisionError")):
        boat(tmp_path / "parts.py", text)
        with pytest.raises(ProgramError, match=r"parts\.py.*line 2|line 2.*parts\.py") as caught:
            load_program(boat(tmp_path / "boat.py", "from .parts import y\n" + BOAT))
        assert says in str(caught.value)


@pytest.mark.parametrize("source", ["nowhere.py", "nowhere.py:Boat", ".", "", "notes.txt"])
def test_what_is_no_program_file_is_named(tmp_path: Path, monkeypatch, source: str) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.txt").write_text("no program")
    with pytest.raises(ProgramError) as caught:
        load_program(source)
    assert (source.partition(":")[0] or ".") in str(caught.value) and "\n" not in str(caught.value)


def test_a_program_that_fails_to_load_leaves_the_next_one_alone(tmp_path: Path) -> None:
    with pytest.raises(ProgramError):
        load_program(boat(tmp_path / "boat.py", "x = 1\nraise RuntimeError\n"))
    assert load_program(boat(tmp_path / "boat.py")).color == "red"


def test_a_digit_edited_within_a_second_counts(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    text = (MODELS / "linear_gaussian.py").read_text().replace("class LinearGaussian", "class Mine")
    for noise in ("0.6", "0.7", "0.8"):
        file.write_text(text.replace("tensor(0.6)", f"tensor({noise})"))
        assert float(load_program(file).noise.detach()) == pytest.approx(float(noise))
    assert not (tmp_path / "__pycache__").exists()
