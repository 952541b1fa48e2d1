"""What a trace must not take for constant, and what programs of one class must not take from one another."""

from __future__ import annotations

import copy
import gc
import math
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyro
import pytest
import torch
from examples import example
from pyro.distributions import constraints
from pyro.nn import PyroModule, PyroParam
from torch import Tensor, nn

from steady_ppl.kernels import jit, rows as rows_by_kernels
from steady_ppl.kernels.jit import close
from steady_ppl.kernels.lowering import Tape
from steady_ppl.kernels.rows import Slopes, on_all_rows, slopes_on_all_rows

STATES = torch.linspace(-2.0, 2.0, 90).view(10, 3, 3)
Lines = Callable[[Any, Tensor], Tensor]


@pytest.fixture(autouse=True)
def _compile_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows_by_kernels, "ROWS_WORTH_COMPILING", 1)


@dataclass(frozen=True)
class Number:
    """The first of a parameter."""

    parameter: Tensor
    index: int = 0
    step: float = 0.01


def program() -> Any:
    """Of a class of its own, so that it shares nothing with that of another test."""

    class Program(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.gain, self.rate = nn.Parameter(torch.tensor([0.5, 0.7, 0.9])), nn.Parameter(torch.tensor([1.5]))
            self.register_buffer("order", torch.tensor([0, 2, 1]))
            self.places = torch.tensor([1.0, 2.0, 3.0])
            self.listed = [torch.tensor([1.00001])]

    return Program()


def found(which: nn.Module, lines: Lines) -> Tensor | str:
    """What it comes to by a kernel, or why there is none."""
    result = on_all_rows(which, "lines", lambda state: lines(which, state), {"state": STATES})
    return result.in_plain_torch or result.values


def assert_own(which: nn.Module, lines: Lines) -> None:
    result = found(which, lines)
    assert isinstance(result, Tensor), result
    torch.testing.assert_close(result, lines(which, STATES).detach(), rtol=1e-6, atol=1e-6)


def times(one: Any, state: Tensor) -> Tensor:
    gain = one.gain * 2
    gain *= one.rate
    return state * gain


def through_a_view(one: Any, state: Tensor) -> Tensor:
    gain = one.gain.clone()
    gain[0] = one.rate[0]
    return state * gain


def into_given(one: Any, state: Tensor) -> Tensor:
    return state * torch.mul(one.gain.detach(), one.rate.detach(), out=torch.empty_like(one.gain))


@pytest.mark.parametrize("lines", [times, through_a_view, into_given])
def test_a_tensor_of_parameters_that_is_written_into_is_left_to_torch(lines: Lines) -> None:
    """Differences ran the writing once more on what it had written: slopes were hundreds of times too large."""
    which = program()
    numbers = [Number(which.gain), Number(which.rate)]
    slopes = slopes_on_all_rows(which, "lines", lambda state: lines(which, state), {"state": STATES}, numbers)
    assert isinstance(slopes, str) and "writes into a tensor" in slopes


def test_writing_into_new_tensors_keeps_its_slopes() -> None:
    which = program()

    def lines(state: Tensor) -> Tensor:
        gain = torch.zeros(3)
        gain[0] = which.gain[0]
        gain[1:] = which.rate
        return state * gain

    numbers = [Number(which.gain), Number(which.rate)]
    slopes = slopes_on_all_rows(which, "lines", lines, {"state": STATES}, numbers)
    assert isinstance(slopes, Slopes), slopes
    torch.testing.assert_close(slopes.by_number.sum(0), torch.tensor([1.0, 2.0]).double(), rtol=1e-4, atol=1e-4)


def test_a_copy_does_not_feel_what_is_written_into_anothers_settings() -> None:
    def lines(one: Any, state: Tensor) -> Tensor:
        return state * one.places * one.listed[0]

    first = program()
    second = copy.deepcopy(first)
    for _ in range(5):  # so that the next run is none of those that are compared
        assert_own(first, lines)
        assert_own(second, lines)
    first.places += 1
    first.listed[0] *= 2
    assert_own(second, lines)
    assert_own(first, lines)


def test_listed_tensors_differ_in_all_their_digits() -> None:
    first = program()
    second = copy.deepcopy(first)
    second.listed[0] = torch.tensor([1.00004])  # both are shown as 1.0000
    assert jit.signature(first) != jit.signature(second)
    for one in (first, second):
        assert_own(one, lambda one, state: state * one.listed[0])


def test_whole_numbers_that_change_are_traced_anew() -> None:
    which = program()
    for _ in range(5):
        assert_own(which, lambda one, state: state[..., one.order])
    which.order.copy_(torch.tensor([1, 0, 2]))
    assert_own(which, lambda one, state: state[..., one.order])


def test_places_that_depend_on_parameters_are_left_to_torch() -> None:
    assert "depend on parameters" in str(found(program(), lambda one, state: state[..., one.gain.argsort()]))


def test_a_transposed_view_of_a_parameter_is_not_taken_for_it() -> None:
    which = program()
    which.matrix = nn.Parameter(torch.eye(3))
    which.turned = which.matrix.data.t()
    for _ in range(5):
        assert_own(which, lambda one, state: state @ one.turned)
    which.matrix.data[0, 1] = 5.0
    assert_own(which, lambda one, state: state @ one.turned)


def test_parameters_that_are_one_tensor_have_the_same_slopes() -> None:
    which = program()
    which.other = nn.Parameter(which.gain.data)
    numbers = [Number(which.gain), Number(which.other)]
    slopes = slopes_on_all_rows(which, "lines", lambda state: state * which.gain, {"state": STATES}, numbers)
    assert isinstance(slopes, Slopes), slopes
    assert torch.equal(slopes.by_number[:, 0], slopes.by_number[:, 1])
    apart = copy.deepcopy(which)
    apart.other = nn.Parameter(torch.ones(3))
    assert jit.signature(apart) != jit.signature(which)


def test_a_tape_keeps_no_tensor_of_the_program_that_was_traced() -> None:
    which = program()
    assert_own(which, lambda one, state: state * (one.gain * torch.tensor([1.0, 2.0, 3.0])))
    (method,) = jit._COMPILED[type(which)].values()
    tape: Tape = method.tape
    assert sum(value.numel() for value in tape._values) == 3  # the constant


def test_fewer_rows_than_a_kernel_takes_are_left_to_torch() -> None:
    few = {"state": STATES[:1]}
    assert "fewer than" in str(on_all_rows(program(), "lines", lambda state: state, few, kernels=True).in_plain_torch)


def test_slopes_that_are_no_numbers_are_left_to_torch() -> None:
    which = program()

    def lines(state: Tensor) -> Tensor:
        return (state - which.gain).norm(dim=-1, keepdim=True)

    still = {"state": which.gain.detach().expand(10, 3, 3)}
    assert slopes_on_all_rows(which, "lines", lines, still, [Number(which.gain)]) == rows_by_kernels.NO_SLOPES


def test_a_kernel_is_compared_when_a_program_first_runs_with_it() -> None:
    """Not only when the program's runs of all kernels come to a power of two."""
    which = program()
    which.strength = 1.0

    def lines(one: Any, state: Tensor) -> Tensor:
        return state * one.strength * one.gain.detach().numpy().sum().item()  # of which no trace knows

    for _ in range(4):
        assert_own(which, lines)
    which.strength = 2.0
    assert_own(copy.deepcopy(which), lines)
    which.gain.data += 1.0
    assert found(which, lines) == jit.RESULTS_DIFFER


def test_a_class_goes_when_nobody_has_it() -> None:
    which = program()
    assert_own(which, lambda one, state: state * one.gain * one.places)
    kind = weakref.ref(type(which))
    del which
    gc.collect()
    assert kind() is None


@pytest.mark.parametrize("kind", [dict, list, np.array])
def test_a_limit_that_few_rows_reach_is_told_apart(kind: Callable[[Any], Any]) -> None:
    """Too few for a comparison to find out that the kernel is another program's."""
    first = program()
    second = copy.deepcopy(first)
    for one, limit in ((first, 1.99), (second, 1.9)):
        one.limits = kind({"place": limit}) if kind is dict else kind([limit])

    def lines(one: Any, state: Tensor) -> Tensor:
        return state.clamp(max=float(one.limits["place" if kind is dict else 0]))

    assert_own(first, lines)
    assert_own(second, lines)


def test_parameters_between_other_bounds_have_a_kernel_each() -> None:
    class Bounded(PyroModule):
        def __init__(self, bounds: Any) -> None:
            super().__init__()
            with pyro.settings.context(module_local_params=True):
                self.share = PyroParam(torch.tensor(0.5), bounds)

    for bounds in (constraints.unit_interval, constraints.interval(0.0, 2.0), constraints.unit_interval):
        assert_own(Bounded(bounds), lambda one, state: state * one.share)


def test_numbers_agree_in_the_scale_of_their_component():
    small, other = torch.tensor([[1e-5, 1.0], [2e-5, 2.0]]), torch.tensor([[5e-5, 1.0], [-3e-5, 2.0]])
    assert close(small, small) and close(small * (1 + 1e-5), small) and not close(small, other)
    missing = torch.tensor([[math.nan, 1.0], [2e-5, -math.inf]])
    assert close(missing, missing.clone()) and not close(small, missing)
    impossible = torch.tensor([[1e-5, -math.inf], [2e-5, 2.0]])
    assert not close(small, impossible) and not close(impossible, small)
    large = torch.tensor([[1e34, 1e11]] * 60 + [[1.0, 2.0]] * 8)
    overflown = torch.tensor([[math.nan, 3.0]] * 60 + [[1.0, 2.0]] * 8)
    assert close(overflown, large) and close(large, overflown)
    assert not close(overflown + torch.tensor([0.1, 0.0]), large)  # of eight rows in 68
    rounded = torch.tensor([[0.3, 100.0], [0.3 + 1e-7, 1e-6]])
    assert close(rounded, torch.tensor([[0.3, 100.0], [0.3, 0.0]]))


def test_a_program_is_read_once_while_it_is_unchanged_and_anew_after_it():
    program = example("hovercraft")
    plain = jit.signature(program)

    def read_and_fail():
        with jit.unchanged(program):
            with jit.unchanged(program):
                known = jit.signature(program)
            program.landmarks = ((0.0, 0.0),)
            assert jit.signature(program) is known
            assert known == plain
            raise RuntimeError("in between")

    with pytest.raises(RuntimeError, match="in between"):
        read_and_fail()
    assert jit.signature(program) != plain
