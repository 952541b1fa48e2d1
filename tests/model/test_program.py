"""Program files: loading by path, siblings, two files of one name, and one clear line for what does not load."""

from __future__ import annotations

import doctest
import math
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from examples import MODELS, drives, example
from pyro.nn import PyroParam
from small import HOVERCRAFT

from steady_ppl import DataError, Program, ProgramError, load_program, simulate
from steady_ppl.model import program as form
from steady_ppl.model.program import error_groups, for_program, names, units
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


# --- loading ----------------------------------------------------------------------------------------------------------


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


# --- what does not load -----------------------------------------------------------------------------------------------


def constructed(arguments: str, line: str) -> str:
    return f"from steady_ppl import Program\nclass Boat(Program):\n    def __init__({arguments}):\n        {line}\n"


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
    pytest.param("", "boat.py has no program Boat; its programs: none (choose with", id="empty"),
    pytest.param(
        "class Ship: pass\n", "boat.py has no program Boat; its programs: none (choose with", id="another class"
    ),
    pytest.param("class Boat: pass\n", "boat.py has no program Boat", id="no subclass"),
    pytest.param("def Boat(): pass\n", "boat.py has no program Boat; its programs: none", id="function"),
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


# --- declarations -----------------------------------------------------------------------------------------------------


def test_names_and_units_come_apart() -> None:
    declared = ("left [N]", "push [m/s²]", "torque [N m]", "ratio", "gap []")
    assert names(declared) == ("left", "push", "torque", "ratio", "gap")
    assert units(declared) == ("N", "m/s²", "N m", "", "")


def test_names_say_of_what_they_are_and_cannot_be_written() -> None:
    program = example("hovercraft")
    assert "`channels`" in type(program).channel_units.__doc__
    with pytest.raises(AttributeError, match="no setter"):
        program.state_names = ("x",)


def test_an_earlier_state_lies_back_at_its_velocity_however_many_channels_move_it() -> None:
    program = example("pendulum")
    position, velocity = program.motion[next(iter(program.motion))]
    program.motion = {"push": (position, velocity), "pull": (position, velocity)}
    state = torch.tensor([1.0, 2.0])
    moved = program.earlier(state, torch.tensor(0.1))
    at, rate = (program.state_names.index(name) for name in (position, velocity))
    assert moved[at] == pytest.approx(float(state[at] - 0.1 * state[rate])) and moved[rate] == state[rate]


def test_errors_are_reported_for_the_programs_groups_or_for_each_component() -> None:
    assert error_groups(example("hovercraft")) == {
        "location": (0, 1),
        "angle": (2,),
        "velocity": (3, 4),
        "yaw_rate": (5,),
    }
    assert error_groups(example("pendulum")) == {"angle": (0,), "rate": (1,)}


def test_a_program_prints_the_values_of_its_parameters() -> None:
    program = example("hovercraft", torch.float32)
    program.mass = torch.tensor(1.23456)
    assert repr(program) == "Hovercraft(mass=1.235, inertia=1.5, noise=[0.2, 0.2, 0.1])"


# --- the columns that a program reads ---------------------------------------------------------------------------------


def test_columns_are_read_by_name_in_the_programs_order() -> None:
    program = example("hovercraft")
    data = drives(program, 2, 5)
    back = replace(
        data,
        controls=data.controls.flip(-1),
        control_names=data.control_names[::-1],
        measurements=torch.cat([data.measurements[..., :1] * 0, data.measurements.flip(-1)], -1),
        observed=torch.cat([~data.observed[..., :1], data.observed.flip(-1)], -1),
        measurement_names=("range", *data.measurement_names[::-1]),
        states=data.states.flip(-1),
        state_names=data.state_names[::-1],
    )
    chosen = for_program(program, back)
    for field in ("controls", "measurements", "observed", "states"):
        assert torch.equal(getattr(chosen, field), getattr(data, field)), field
    assert chosen.control_names == ("left", "right") and chosen.state_names == program.state_names


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_columns_come_in_the_programs_precision_with_time_from_zero(dtype: torch.dtype) -> None:
    program = example("hovercraft")
    data = drives(program, 2, 5)
    chosen = for_program(program.to(dtype), replace(data, time=data.time + 1.7e9))
    tensors = (chosen.steps, chosen.elapsed, chosen.controls, chosen.measurements, chosen.states)
    assert {tensor.dtype for tensor in tensors} == {dtype} and chosen.observed.dtype == torch.bool
    assert chosen.time.dtype == torch.float64
    assert torch.allclose(chosen.time, data.time, atol=1e-6)  # a clock stamp of 1.7e9 s has steps of 2.4e-7


def test_a_program_without_parameters_reads_the_default_precision() -> None:
    program = Program()
    program.measurements = ("bearing_0",)
    assert for_program(program, drives(example("hovercraft"), 1, 3)).measurements.dtype == torch.get_default_dtype()


def test_a_missing_column_is_named_with_those_that_exist() -> None:
    data = drives(example("hovercraft"), 1, 3)
    with pytest.raises(DataError, match=r"no column u\.torque; it has u\.left, u\.right") as caught:
        for_program(example("pendulum"), data)
    assert caught.value.column == "u.torque"
    with pytest.raises(DataError, match=r"no column u\.left, u\.right; it has no u\. column"):
        for_program(example("hovercraft"), replace(data, controls=data.controls[..., :0], control_names=()))


def test_unknown_state_components_are_nan_and_foreign_ones_are_left_out() -> None:
    program = example("hovercraft")
    data = drives(program, 1, 3)
    chosen = for_program(program, replace(data, states=data.states[..., :2], state_names=("y", "battery")))
    assert torch.equal(chosen.states[..., 1], data.states[..., 0])
    assert chosen.states[..., [0, 2, 3, 4, 5]].isnan().all()
    assert for_program(program, replace(data, states=data.states[..., :1], state_names=("battery",))).states is None


def test_steps_late_in_a_long_log_keep_their_length() -> None:
    program = example("hovercraft").to(torch.float32)
    data = drives(example("hovercraft"), 1, 3)
    time = torch.tensor([[0.0], [3600.0], [3600.01]], dtype=torch.float64)
    steps = for_program(program, replace(data, time=time)).steps
    assert steps.dtype == torch.float32
    assert float(steps[1, 0]) == pytest.approx(0.01, rel=1e-6)


def test_a_digit_edited_within_a_second_counts(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    text = (MODELS / "linear_gaussian.py").read_text().replace("class LinearGaussian", "class Mine")
    for noise in ("0.6", "0.7", "0.8"):
        file.write_text(text.replace("tensor(0.6)", f"tensor({noise})"))
        assert float(load_program(file).noise.detach()) == pytest.approx(float(noise))
    assert not (tmp_path / "__pycache__").exists()


def test_a_parameter_that_a_constant_of_the_class_would_hide_is_refused() -> None:
    class Mapped(type(load_program(MODELS / "hovercraft.py"))):  # type: ignore[misc]
        """Learns where the landmarks are."""

        def __init__(self):
            super().__init__()
            self.landmarks = PyroParam(torch.zeros(4, 2))

    with pytest.raises(ProgramError, match="landmarks is a constant of its class"):
        Mapped()


def test_the_bearings_noise_can_be_learned_and_can_be_a_constant_of_the_class() -> None:
    hovercraft = type(load_program(MODELS / "hovercraft.py"))
    program = hovercraft()
    assert program.bearing_sd == pytest.approx(math.radians(5))
    program.bearing_sd = PyroParam(torch.tensor(0.1), torch.distributions.constraints.positive)
    assert program.bearing_sd.item() == pytest.approx(0.1) and "bearing_sd_unconstrained" in dict(
        program.named_parameters()
    )

    class Sharp(hovercraft):  # type: ignore[misc]
        """Sees better."""

        bearing_sd = math.radians(1)

    assert Sharp().bearing_sd == math.radians(1)


def test_the_example_of_the_class_runs() -> None:
    assert doctest.testmod(form).attempted > 5 and not doctest.testmod(form).failed
