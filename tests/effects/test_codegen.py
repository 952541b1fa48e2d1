"""Programs with effects written out: the same numbers as `with_effect` gives, in a file that reads like the others."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from examples import MODELS
from small import steady

from steady_ppl import UsageError, load_program, simulate
from steady_ppl.effects import Effect, attached, catalogue, not_applicable, register, registry, write_program
from steady_ppl.model.program import names

SYSTEMS = ("hovercraft", "truck", "pendulum")
ROOT = MODELS.parent


@pytest.fixture(autouse=True)
def _the_same_catalogue_afterwards():
    before = list(registry._EFFECTS)
    yield
    registry._EFFECTS[:] = before


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in SYSTEMS:
        shutil.copy(MODELS / f"{name}.py", tmp_path)
    return tmp_path


def same_drives(a, b, rows: int = 7) -> bool:
    """Whether two programs simulate the very same numbers in double precision."""
    tables = []
    for program in (a, b):
        program.double().duration = (rows - 1) * program.step
        tables.append(simulate(program, 2, seed=3))
    x, y = tables
    return torch.equal(x.states, y.states) and torch.equal(x.measurements, y.measurements)


def is_clean(folder: Path) -> None:
    """As `ruff check` and `ruff format` would have it."""
    for command in (("check",), ("format", "--diff")):
        ruff = [
            sys.executable,
            "-m",
            "ruff",
            *command,
            "--no-cache",
            "--config",
            str(ROOT / "pyproject.toml"),
            str(folder),
        ]
        done = subprocess.run(ruff, capture_output=True, text=True, cwd=ROOT)
        assert done.returncode == 0, done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hovercraft", pytest.param("truck", marks=pytest.mark.exhaustive), "pendulum"])
def test_every_effect_written_out_is_the_effect(folder: Path, name: str) -> None:
    base = load_program(folder / f"{name}.py")
    for number, variant in enumerate(v for effect in catalogue(base) for v in effect.variants(base)):
        program, path = base.with_effect(variant), folder / f"{name}_{number}.py"
        assert write_program(program, path) == []
        again = load_program(path)
        assert [v.written for v in attached(again)] == [variant.written]
        assert again.priors.keys() == program.priors.keys()
        for parameter, prior in again.priors.items():
            assert (prior.loc, prior.scale) == (program.priors[parameter].loc, program.priors[parameter].scale)
        assert same_drives(program, again), variant.label
        with pytest.raises(UsageError, match="already"):
            again.with_effect(variant)
    is_clean(folder)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "effects"),
    [
        ("hovercraft", ("linear_drag", "slope", "landmark_bias:2", "landmark_bias:0", "actuator_lag", "dead_zone")),
        ("hovercraft", ("acceleration_limit", "linear_drag", "speed_dependent_gain", "coloured_noise:yaw")),
        ("hovercraft", ("linear_drag", "acceleration_limit", "sticky_patch:x=-1:y=-2:radius=1", "lever_arm")),
        ("hovercraft", ("clock_offset", "range_dependent_noise", "bearing_bias", "heavy_tails", "sensor_scale")),
        ("hovercraft", ("coloured_noise:yaw", "coloured_noise:translation", "clock_offset", "wind", "slope")),
        (
            "truck",
            ("curvature_steering", "acceleration_limit", "gain_error:turn", "command_noise", "process_noise:yaw"),
        ),
        ("pendulum", ("stiffness", "coulomb_friction", "coloured_noise", "sensor_bias", "actuator_delay")),
    ],
)
def test_several_effects_act_in_their_order(folder: Path, name: str, effects: tuple[str, ...]) -> None:
    program = load_program(folder / f"{name}.py")
    for effect in effects:
        program = program.with_effect(effect)
    write_program(program, folder / "all_of_them.py")
    again = load_program(folder / "all_of_them.py")
    assert [v.name for v in attached(again)] == [v.name for v in attached(program)]
    assert again.state_names == program.state_names and names(again.resting) == names(program.resting)
    assert same_drives(program, again)
    is_clean(folder)


def test_the_file_reads_like_the_others(folder: Path) -> None:
    program = load_program(folder / "hovercraft.py").with_effect("linear_drag", 0.1)
    program.mass = torch.tensor(1.47)
    write_program(program, folder / "hovercraft_with_drag.py")
    assert (
        (folder / "hovercraft_with_drag.py").read_text()
        == '''"""Hovercraft with linear_drag, as `steady add` wrote it."""

from torch import tensor

from .hovercraft import Hovercraft


class HovercraftWithDrag(Hovercraft):
    """Hovercraft with linear_drag.

    linear_drag: a = -c v
        c in 1/s; coasts to rest like in oil: half the speed, half the braking
    """

    effects = ("linear_drag=0.1",)

    def __init__(self):
        super().__init__()
        # where its own parameters begin; they are learned as before
        self.mass = tensor(1.47)
'''
    )


def test_fitted_parameters_are_carried_over(folder: Path) -> None:
    program = load_program(folder / "hovercraft.py").with_effect("slope", (0.12, -0.34))
    program.mass, program.noise = torch.tensor(1.2345678), torch.tensor([0.3, 0.1234567, 1e-3])
    write_program(program, folder / "new.py")
    again = load_program(folder / "new.py")
    for (name, value), (other, found) in zip(program.named_parameters(), again.named_parameters(), strict=True):
        assert name == other
        torch.testing.assert_close(found, value, rtol=1e-6, atol=1e-6)
    assert "inertia" not in (folder / "new.py").read_text()  # as it was


def test_a_written_program_takes_further_effects(folder: Path) -> None:
    write_program(load_program(folder / "hovercraft.py").with_effect("linear_drag"), folder / "dragged.py")
    program = load_program(folder / "dragged.py").with_effect("slope")
    write_program(program, folder / "dragged_on_a_slope.py")
    again = load_program(folder / "dragged_on_a_slope.py")
    assert [v.name for v in attached(again)] == ["linear_drag", "slope"]
    assert "from .dragged import Dragged" in (folder / "dragged_on_a_slope.py").read_text()
    assert same_drives(program, again)


def test_effects_that_a_class_lists_are_written_out(folder: Path) -> None:
    path = folder / "boats.py"
    path.write_text(
        'from .hovercraft import Hovercraft\n\n\nclass Boats(Hovercraft):\n    effects = ("linear_drag=0.1",)\n'
    )
    program = load_program(path).with_effect("acceleration_limit")
    write_program(program, folder / "limited.py")
    again = load_program(folder / "limited.py")
    assert [v.name for v in attached(again)] == ["linear_drag", "acceleration_limit"]
    assert type(again).__name__ == "Limited" and same_drives(program, again)


def test_what_a_network_learned_is_not_written_and_that_is_said(folder: Path) -> None:
    shutil.copy(MODELS / "neural_vehicle.py", folder)
    program = load_program(f"{folder / 'neural_vehicle.py'}:NeuralHovercraft").with_effect("clock_offset")
    (note,) = write_program(program, folder / "late.py")
    assert "hidden_in" in note and "not carried over" in note
    again = load_program(folder / "late.py")
    again.load_state_dict(program.state_dict())
    assert same_drives(program, again)


# --- what cannot be written -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("elsewhere/new.py", "has to lie beside it"),
        ("truck.py", "exists: choose another name"),
        ("hovercraft.py", "give it another name"),
        ("new-one.py", "expected a name such as hovercraft_with_drag.py"),
        ("new.txt", "expected a name such as"),
    ],
)
def test_a_wrong_place_is_refused(folder: Path, path: str, says: str) -> None:
    (folder / "elsewhere").mkdir()
    before = {file: file.read_bytes() for file in folder.rglob("*.py")}
    program = load_program(folder / "hovercraft.py").with_effect("linear_drag")
    with pytest.raises(UsageError, match=says):
        write_program(program, folder / path)
    assert {file: file.read_bytes() for file in folder.rglob("*.py")} == before


def test_force_overwrites_but_never_the_program_itself(folder: Path) -> None:
    program = load_program(folder / "hovercraft.py").with_effect("linear_drag")
    write_program(program, folder / "truck.py", force=True)
    assert "linear_drag" in (folder / "truck.py").read_text()
    with pytest.raises(UsageError, match="give it another name"):
        write_program(program, folder / "hovercraft.py", force=True)


def test_there_must_be_something_to_write_and_a_file_to_derive_from(folder: Path) -> None:
    program = load_program(folder / "hovercraft.py")
    with pytest.raises(UsageError, match="no effect that its file does not have"):
        write_program(program, folder / "new.py")

    class Local(type(program)):
        pass

    with pytest.raises(UsageError, match="came from no file"):
        write_program(Local().with_effect("linear_drag"), folder / "new.py")


# --- effects of one's own ---------------------------------------------------------------------------------------------


def own(function, **more) -> Effect:
    """An effect as if it were of the catalogue."""
    function.__module__ = more.pop("module", "steady_ppl.effects.catalogue.own")
    about = {"equation": "a = c", "text": "a = c", "unit": "1", "feels": "odd", "typical": 0.3, "limit": 1.0, **more}
    return register(Effect(name="own", form="push", function=function, **about))


FACTOR, AXES = 0.7, ("forward", "lateral")


def other_names(vehicle, where, u, now, interval, c, reach):
    """Names of its own, a state that is written over, constants of its module, and comments."""
    # on the left
    where = where[..., :6]
    push = c * FACTOR * reach**2 * where[..., 3]  # σ
    # on the right
    return {
        axis: push * u[..., 0].abs()  # one axis after the other
        for axis in AXES
    }


def test_a_function_may_name_things_as_it_likes(folder: Path) -> None:
    own(other_names, profiled=("reach",), choices=lambda program, data: [{"reach": -2.0}])
    program = load_program(folder / "hovercraft.py").with_effect("own").with_effect("linear_drag")
    write_program(program, folder / "new.py")
    again = load_program(folder / "new.py")
    assert same_drives(program, again)
    assert not same_drives(again, load_program(folder / "hovercraft.py").with_effect("linear_drag"))


def helper(value):
    return value


def with_helper(self, state, control, time, step, c):
    return {"forward": helper(c) * state[..., 3]}


def with_two_ends(self, state, control, time, step, c):
    if self.step > 1:
        return {}
    return {"forward": c * state[..., 3]}


with_no_name = lambda self, state, control, time, step, c: {"forward": c * state[..., 3]}  # noqa: E731


@pytest.mark.parametrize("function", [with_helper, with_two_ends, with_no_name])
def test_a_function_may_be_any(folder: Path, function) -> None:
    own(function)
    program = load_program(folder / "hovercraft.py").with_effect("own")
    write_program(program, folder / "new.py")
    assert same_drives(program, load_program(folder / "new.py"))


def test_an_effect_that_the_new_file_would_not_load_is_refused(folder: Path) -> None:
    def elsewhere(self, state, control, time, step, c):
        return {"forward": c * state[..., 3]}

    own(elsewhere, module="somebody.script")
    program = load_program(folder / "hovercraft.py").with_effect("own")
    with pytest.raises(UsageError, match="registered in somebody.script"):
        write_program(program, folder / "new.py")
    assert not list(folder.glob("*new.py"))


def test_an_effect_whose_name_does_not_say_all_is_refused(folder: Path) -> None:
    own(other_names, choices=lambda program, data: [{"reach": -2.0}])
    program = load_program(folder / "hovercraft.py")
    (effect,) = [one for one in catalogue(program) if one.name == "own"]
    with pytest.raises(UsageError, match="does not say all that it depends on"):
        write_program(program.with_effect(effect.variant(reach=-3.0)), folder / "new.py")
    assert not list(folder.glob("*new.py"))


@pytest.mark.slow
def test_the_example_of_the_page_runs(folder: Path, capsys) -> None:
    """Registered by the program's file: simulated, listed, written out; the lines are the reader's own."""
    text = (ROOT / "docs" / "own-effect.md").read_text()
    ((effect,),) = [re.findall(r"(def tether.*?)```", text, flags=re.DOTALL)]
    code = "from steady_ppl.effects import Effect, register\n\n\n" + effect
    model, table = folder / "hovercraft.py", folder / "drives.csv"
    model.write_text(model.read_text() + "\n\n" + code)
    assert steady("simulate", model, "--trajectories", 1, "--effect", "tether:length=3=0.5", "--out", table) == 0
    assert "tether (length 3) = 0.5 1/s² (as given)" in capsys.readouterr().err
    assert steady("effects", model) == 0
    assert "| `tether` | | a = -c max(d - length, 0) towards the origin" in capsys.readouterr().out
    assert steady("add", model, "tether:length=0.5", "--out", folder / "tethered.py") == 0
    assert "tether (length 0.5): $a = -c\\,\\max(d - l, 0)\\,e_d$" in capsys.readouterr().out
    tethered = load_program(folder / "tethered.py")
    expected = load_program(model).with_effect("tether", length=0.5)
    assert same_drives(expected, tethered) and not same_drives(load_program(model), tethered)
    assert [v.written for v in attached(tethered)] == ["tether:length=0.5"]
    assert not_applicable(load_program(folder / "pendulum.py"))["tether"] == "there is no heading"
    (folder / "hovercraft.py").write_text((MODELS / "hovercraft.py").read_text())
    is_clean(folder / "tethered.py")
