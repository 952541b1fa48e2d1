"""Kernels that programs share, and their derivatives in learnable numbers."""

from __future__ import annotations

import copy
from types import SimpleNamespace

import pytest
import torch
from examples import drives, example
from torch import nn

from steady_ppl import seeded
from steady_ppl.gaussian.linearize import ReferencePath, linearize
from steady_ppl.kernels import jit, rows as rows_by_kernels
from steady_ppl.kernels.rows import Slopes, fallback_notes, kernel_failures, on_all_rows, slopes_on_all_rows
from steady_ppl.likelihood.parameters import elements, on_both_sides
from steady_ppl.model.handlers import Standardised, running
from steady_ppl.model.problem import Problem
from steady_ppl.model.substeps import acting_controls, advance, with_substeps

PROGRAMS = ["hovercraft.py:HovercraftTruth", "truck", "pendulum", "linear_gaussian"]


@pytest.fixture(autouse=True)
def compile_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows_by_kernels, "ROWS_WORTH_COMPILING", 1)


def ends(program):
    """Where rows end."""

    def function(state, noise, control, time, step):
        with running(*state.shape[:-1]), Standardised(noise):
            return advance(program, state, control, time, step)

    return function


def arguments(program, data):
    rows, count = data.steps.shape
    with seeded(1, "states"):
        states = torch.randn(rows, count, len(program.states))
        noise = torch.randn(rows, count, len(program.channels))
    controls = acting_controls(program, data)[:-1]
    return {"state": states, "noise": noise, "control": controls, "time": data.elapsed[:-1], "step": data.steps}


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [1, 2])
@pytest.mark.parametrize("name", PROGRAMS)
def test_slopes_are_the_differences_of_the_programs_own_lines(name: str, substeps: int):
    program = with_substeps(example(name, torch.float32), substeps)
    data = drives(program, 2, 9)
    given = arguments(program, data)
    parts = elements(program)
    found = slopes_on_all_rows(program, "ends", ends(program), given, parts)
    assert isinstance(found, Slopes), found
    double = copy.deepcopy(program).double()
    exact = [value.double() for value in given.values()]
    for index, part in enumerate(elements(double)):
        up, down = on_both_sides(part, lambda: ends(double)(*exact))
        expected = (up - down) / (2 * part.step)
        slope = torch.zeros_like(expected)
        for component, values, by_number in zip(found.components, found.values, found.by_number, strict=True):
            slope[..., component] += values.double() * by_number[index]
        apart = (slope - expected).abs() > 1e-3 * expected.abs().max() + 1e-6
        assert apart.double().mean() < 0.03, part.name  # a few rows stand at a limit, which differences step over


def test_copies_share_a_kernel_and_have_their_own_numbers():
    program = example("hovercraft.py:HovercraftTruth", torch.float32).with_effect("wind", (0.1, 0.2))
    data = drives(program, 2, 9)
    other = copy.deepcopy(program)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter += 0.1
    path = ReferencePath(torch.randn(9, 2, 6), torch.randn(8, 2, 3))
    for which in (program, other):
        by_kernel, by_torch = (linearize(Problem(which, data), path, kernels=kernels) for kernels in (True, False))
        assert by_kernel.in_plain_torch is None
        torch.testing.assert_close(by_kernel.state, by_torch.state, rtol=1e-4, atol=2e-5)
        torch.testing.assert_close(by_kernel.offset, by_torch.offset, rtol=1e-4, atol=2e-5)
    kept = [name for name, _ in jit._COMPILED[type(program)]]
    assert sorted(kept) == ["measure on all rows", "step on all rows"]


class Hidden(type(example("hovercraft"))):
    """What it does depends on a number that no signature tells."""

    def __init__(self):
        super().__init__()
        self.hidden = SimpleNamespace(drag=0.0)

    def transition(self, state, control, time, step):
        return super().transition(state * (1 - self.hidden.drag), control, time, step)


def test_a_program_that_differs_in_what_nothing_tells_is_not_run_by_the_others_kernel():
    program = Hidden()
    data = drives(program, 2, 9)
    other = copy.deepcopy(program)
    other.hidden.drag = 0.5
    path = ReferencePath(torch.randn(9, 2, 6), torch.randn(8, 2, 3))
    assert linearize(Problem(program, data), path).in_plain_torch is None
    found, expected = linearize(Problem(other, data), path), linearize(Problem(other, data), path, kernels=False)
    assert found.in_plain_torch == jit.RESULTS_DIFFER and torch.equal(found.state, expected.state)


class InPlace(type(example("hovercraft"))):
    """Writes into a tensor of its own, as torch allows."""

    def transition(self, state, control, time, step):
        moved = torch.zeros_like(state)
        moved[..., :2] = state[..., :2]
        moved[..., 2:] += state[..., 2:]
        moved[..., 4].mul_(0.5)
        return super().transition(moved, control, time, step)


def test_a_program_that_writes_into_its_tensors_is_compiled():
    program = InPlace()
    data = drives(program, 2, 9)
    path = ReferencePath(torch.randn(9, 2, 6), torch.randn(8, 2, 3))
    found, expected = linearize(Problem(program, data), path), linearize(Problem(program, data), path, kernels=False)
    assert found.in_plain_torch is None
    torch.testing.assert_close(found.state, expected.state, rtol=1e-4, atol=2e-5)


def test_weighted_slopes_are_the_derivatives_of_weighted_sums():
    program = example("hovercraft.py:HovercraftTruth", torch.float32)
    data = drives(program, 4, 30)
    given, parts = arguments(program, data), elements(program)
    slopes = slopes_on_all_rows(program, "ends", ends(program), given, parts)
    assert isinstance(slopes, Slopes)
    weights = torch.randn(*slopes.function.shape, generator=torch.Generator().manual_seed(1)).double()
    for part, found in zip(parts, slopes.weighted(weights).unbind(-1), strict=True):
        with torch.no_grad():
            up, down = on_both_sides(part, lambda: (weights * ends(program)(*given.values())).sum((0, -1)))
        by = (up - down) / (2 * part.step)
        torch.testing.assert_close(found, by, rtol=0.02, atol=0.02 * float(by.abs().max()) + 1e-4)


def test_why_there_is_no_kernel_is_noted_once_a_function():
    class Sorting(nn.Module):
        pass

    program, given = Sorting(), {"state": torch.randn(4, 5, 3)}
    with kernel_failures() as why:
        for _ in range(2):
            assert on_all_rows(program, "sorted", lambda state: state.sort(-1).values, given).in_plain_torch
        with kernel_failures() as inner:
            on_all_rows(program, "sorted twice", lambda state: state.sort(-1).values, given)
    assert list(why) == ["sorted"] and list(inner) == ["sorted twice"]
    (note,) = fallback_notes({"one": "a", "two": "b", "three": "a"})
    assert note == "computed in plain torch, without compiled kernels: one, three: a; two: b"
    assert fallback_notes({}) == []
