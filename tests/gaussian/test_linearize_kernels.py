"""Jacobians by kernels are those of torch, or the reason is said."""

from __future__ import annotations

import pytest
import torch
from examples import drives, example
from kernel_programs import EXAMPLES, Stale, Switching, single

from steady_ppl import GaussianGuide, particle_filter, seeded
from steady_ppl.gaussian.linearize import ReferencePath, linearize
from steady_ppl.guides import linearized
from steady_ppl.kernels import jit, rows as rows_by_kernels
from steady_ppl.model.problem import Problem


@pytest.mark.slow
@pytest.mark.parametrize("name", EXAMPLES)
def test_a_kernels_jacobians_are_those_of_torch(name, monkeypatch):
    program = single(name)
    data = drives(program, 3, 9, gaps=True)
    torch.manual_seed(1)
    states, noise = 2 * torch.randn(9, 3, len(program.states)), torch.randn(8, 3, len(program.channels))
    by_torch = linearize(Problem(program, data), ReferencePath(states, noise))
    monkeypatch.setattr(rows_by_kernels, "ROWS_WORTH_COMPILING", 1)
    by_kernel = linearize(Problem(program, data), ReferencePath(states, noise))
    assert by_kernel.in_plain_torch is None and jit._COMPILED[type(program)]
    for part in ("offset", "state", "noise", "residual", "measurement", "precision", "log_scale"):
        torch.testing.assert_close(getattr(by_kernel, part), getattr(by_torch, part), rtol=1e-4, atol=2e-5)


def test_a_program_has_kernels_for_the_filter_and_for_its_jacobians(monkeypatch):
    monkeypatch.setattr(rows_by_kernels, "ROWS_WORTH_COMPILING", 1)
    program = single("hovercraft")
    data = drives(program, 2, 9)
    path = ReferencePath(torch.randn(9, 2, 6), torch.randn(8, 2, 3))
    for _ in range(2):
        assert linearize(Problem(program, data), path).in_plain_torch is None
        assert particle_filter(program, data, particles=32, kernels=True).in_plain_torch is None


def test_jacobians_that_cannot_be_compiled_come_from_torch_and_the_guide_says_why(monkeypatch):
    monkeypatch.setattr(linearized, "GUIDE_ROWS_WORTH_COMPILING", 1)
    data = drives(example("hovercraft", torch.float32), 2, 12)
    guide = GaussianGuide(Switching(), draws=3, known_start=True)
    with seeded("plain"):
        guide.refresh(data, 1.0)
    assert "reads a number out of a tensor" in guide.in_plain_torch
    other = GaussianGuide(single("hovercraft"), draws=3, known_start=True)
    with seeded("plain"):
        other.refresh(data, 1.0)
    assert other.in_plain_torch is None


def test_jacobians_that_have_fallen_behind_their_program_are_found_out(monkeypatch):
    monkeypatch.setattr(rows_by_kernels, "ROWS_WORTH_COMPILING", 1)
    program = Stale()
    data = drives(example("hovercraft", torch.float32), 2, 31)
    path = ReferencePath(torch.randn(31, 2, 6), torch.randn(30, 2, 3))
    assert linearize(Problem(program, data), path).in_plain_torch is None
    with torch.no_grad():
        for parameter in program.parameters():
            parameter += 0.1
    assert "different numbers" in linearize(Problem(program, data), path).in_plain_torch
