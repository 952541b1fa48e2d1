"""A function in steps has the values and derivatives of the whole."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from examples import drives, example
from paths import near_the_truth

from steady_ppl.gaussian.linearize import ReferencePath, linearize
from steady_ppl.gaussian.smoother import smooth
from steady_ppl.kernels import graph
from steady_ppl.kernels.chains import run_chain
from steady_ppl.kernels.graph import NotCompilable
from steady_ppl.kernels.rows import derivatives, kernel_failures
from steady_ppl.likelihood.parameters import elements
from steady_ppl.likelihood.scores import parameter_scores, smoothed
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import noisy_step, row_chain, row_inputs, with_substeps

EFFECTS = [(), ("linear_drag", "magnus", "actuator_lag"), ("coloured_noise:yaw",)]


def program_with(effects: tuple[str, ...], substeps: int) -> Program:
    program = example("hovercraft", torch.float32)
    for name in effects:
        program = program.with_effect(name)
    return with_substeps(program, substeps)


def path_of(program: Program, count: int = 4, rows: int = 12) -> tuple[Problem, ReferencePath]:
    data = drives(program, count, rows)
    path = near_the_truth(program, data)
    return Problem(program, data), ReferencePath(path.states.float(), 0.3 * torch.randn_like(path.noise.float()))


@pytest.mark.parametrize("effects", EFFECTS)
@pytest.mark.parametrize("substeps", [2, 5])
def test_a_row_in_substeps_is_the_row(effects: tuple[str, ...], substeps: int) -> None:
    program = program_with(effects, substeps)
    problem, path = path_of(program)
    given = {"state": path.states[:-1], "noise": path.noise} | row_inputs(program, problem.data)._asdict()
    found = run_chain(program, "step", row_chain(program, **given), differentiate=True)
    assert not isinstance(found, str), found
    rest = [value.double() for value in list(given.values())[2:]]
    program.double()
    whole = partial(noisy_step, program)
    values, by = derivatives(lambda *at: whole(*at, *rest), path.states[:-1].double(), path.noise.double())
    size = values.shape[-1]
    torch.testing.assert_close(found.values.t().view(values.shape).double(), values, rtol=1e-5, atol=1e-6)
    slopes = found.slopes.permute(2, 0, 1).view(*values.shape, -1)
    torch.testing.assert_close(slopes[..., :size], by[0], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(slopes[..., size:], by[1], rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("effects", EFFECTS[1:])
def test_a_row_too_long_for_a_kernel_is_run_in_substeps(effects: tuple[str, ...], monkeypatch) -> None:
    """What the whole row comes to by its own kernels, or in plain torch."""
    program = program_with(effects, 4)
    problem, path = path_of(program, 12, 30)
    numbers = elements(program)
    whole = linearize(problem, path, kernels=True)
    ahead = smooth(problem, path, passes=2, kernels=True)
    at = smoothed(ahead, problem.data)
    scores = parameter_scores(program, problem.data, at, numbers)
    again = program_with(effects, 4)
    again.load_state_dict(program.state_dict())
    refuse_whole_rows(monkeypatch)
    with kernel_failures() as why:
        stepped = linearize(Problem(again, problem.data), path, kernels=True)
        in_steps = parameter_scores(again, problem.data, at, elements(again))
    assert stepped.in_plain_torch is None and not why
    for name in ("offset", "state", "noise"):
        torch.testing.assert_close(getattr(stepped, name), getattr(whole, name), rtol=1e-4, atol=1e-5)
    apart = (in_steps - scores).abs().amax(0) / scores.abs().amax(0).clamp(min=1e-3)
    assert float(apart.max()) < 2e-3, dict(zip([one.name for one in numbers], apart.tolist(), strict=True))


def refuse_whole_rows(monkeypatch) -> None:
    """Let whole rows in substeps be too long to be compiled."""
    from steady_ppl.kernels import rows

    compiled = rows.compiled

    def refused(program, name, build):
        if name in ("step on all rows", "ends by parameters"):
            return f"more than {graph.MAX_OPERATIONS} operations a particle"
        return compiled(program, name, build)

    monkeypatch.setattr(rows, "compiled", refused)


def test_a_step_that_has_no_kernel_says_why(monkeypatch) -> None:
    program = program_with((), 3)
    problem, path = path_of(program)
    given = {"state": path.states[:-1], "noise": path.noise} | row_inputs(program, problem.data)._asdict()

    def nothing(*_, **__):
        raise NotCompilable("no kernels here")

    monkeypatch.setattr("steady_ppl.kernels.chains.Method", nothing)
    assert run_chain(program, "step anew", row_chain(program, **given)) == "no kernels here"
