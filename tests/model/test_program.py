"""The form of a program: what it declares, the columns that it reads, its parameters."""

from __future__ import annotations

import doctest
import math
from dataclasses import replace

import pytest
import torch
from examples import MODELS, drives, example
from pyro.nn import PyroParam

from steady_ppl import DataError, Program, ProgramError, load_program
from steady_ppl.model import program as form
from steady_ppl.model.program import error_indices, for_program, names, units

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
    assert error_indices(example("hovercraft")) == {
        "location": (0, 1),
        "angle": (2,),
        "velocity": (3, 4),
        "yaw_rate": (5,),
    }
    assert error_indices(example("pendulum")) == {"angle": (0,), "rate": (1,)}


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
