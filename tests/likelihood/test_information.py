"""What is kept of a fit's uncertainty, against second differences of the exact log p(y)."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from examples import drives, example
from oracles import cart_evidence
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import Tensor

from steady_ppl import Trajectories, for_program
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import smooth
from steady_ppl.likelihood.information import ParameterInformation, information_of_fit
from steady_ppl.likelihood.maximize import fit_by_likelihood
from steady_ppl.likelihood.parameters import elements, set_values, values_of
from steady_ppl.model.problem import Problem
from steady_ppl.utils.random import seeded

STEP = 1e-3


def fitted(trajectories: int, rows: int = 81) -> tuple[Problem, ParameterInformation]:
    """The cart at the maximum of drives of its own, and what is kept of it."""
    program = example("linear_gaussian")
    data = drives(program, trajectories, rows, seed=3)
    with seeded(0, "paths"):
        maximum = fit_by_likelihood(program, data)
    found, notes = information_of_fit(Problem(program, data), maximum.path)
    assert found is not None and not notes
    return Problem(program, data), found


def exact(problem: Problem) -> Tensor:
    """Minus the second differences of Kalman's log p(y), `(P, P)`."""
    parts = elements(problem.program)
    begin, found = values_of(parts), torch.zeros(len(parts), len(parts), dtype=torch.float64)
    unit = STEP * torch.eye(len(parts), dtype=torch.float64)

    def likely(by: Tensor) -> float:
        set_values(parts, begin + by)
        return float(cart_evidence(problem.program, problem.data).detach())

    for i in range(len(parts)):
        for j in range(len(parts)):
            corners = likely(unit[i] + unit[j]) - likely(unit[i] - unit[j])
            found[i, j] = -(corners - likely(unit[j] - unit[i]) + likely(-unit[i] - unit[j])) / (4 * STEP**2)
    set_values(parts, begin)
    return found


@pytest.mark.parametrize("trajectories", [1, 6])
def test_it_is_the_curvature_of_kalmans_log_likelihood(trajectories: int) -> None:
    problem, found = fitted(trajectories)
    expected = exact(problem)
    size = expected.diagonal().rsqrt()
    torch.testing.assert_close(size * found.matrix * size[:, None], size * expected * size[:, None], rtol=0, atol=0.05)
    assert found.names == tuple(part.name for part in elements(problem.program))
    assert 0 <= found.gain < 0.1


def test_a_fit_that_has_not_ended_has_something_to_gain() -> None:
    problem, found = fitted(6)
    path = information_path(problem)
    parts = elements(problem.program)
    away = torch.zeros(len(parts), dtype=torch.float64)
    away[0] = float(torch.linalg.inv(found.matrix)[0, 0] ** 0.5)
    set_values(parts, values_of(parts) + away)
    begun, _ = information_of_fit(problem, path)
    assert begun is not None
    assert begun.gain == pytest.approx(0.5 * float(away @ found.matrix @ away), rel=0.5)


def information_path(problem: Problem):
    with seeded(0, "paths"):
        return fit_by_likelihood(problem.program, problem.data).path


def test_draws_have_the_inverse_for_a_covariance() -> None:
    problem, found = fitted(6)
    with seeded(0, "draws"):
        drawn = found.draws(problem.program, 20_000)
    expected = torch.linalg.inv(found.matrix)
    size = expected.diagonal().rsqrt()
    torch.testing.assert_close(size * drawn.T.cov() * size[:, None], size * expected * size[:, None], rtol=0, atol=0.05)
    centre = (drawn.mean(0) - values_of(elements(problem.program))) * size
    assert float(centre.abs().max()) < 4 / 20_000**0.5


def test_what_is_not_told_is_open_by_as_much_as_a_fit_moves_it() -> None:
    problem, found = fitted(6)
    vague = replace(found, matrix=torch.zeros_like(found.matrix))
    with seeded(0, "draws"):
        drawn = vague.draws(problem.program, 1000)
    assert bool((drawn.std(0) > 0.3).all()) and bool((drawn.std(0) < 10).all())


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
@pytest.mark.parametrize("trajectories", [1, 6])
def test_a_number_that_nothing_tells_leaves_a_fit_with_nothing_to_gain(trajectories: int, kind: torch.dtype) -> None:
    class Idle(type(example("linear_gaussian"))):
        def __init__(self) -> None:
            super().__init__()
            self.idle = PyroParam(torch.tensor(1.0), constraints.positive)

    program = Idle().to(kind)
    data = for_program(program, drives(example("linear_gaussian"), trajectories, 81, seed=3))
    with seeded(0, "paths"):
        path = fit_by_likelihood(program, data).path
    found, notes = information_of_fit(Problem(program, data), path)
    assert not notes and found is not None and 0 <= found.gain < 0.5
    with seeded(0, "draws"):
        open_by = found.draws(program, 500).std(0)[found.names.index("idle")]
    assert 0.5 < float(open_by) < 3


def test_draws_of_a_number_with_a_unit_do_not_depend_on_the_unit() -> None:
    """A bias that is open by ten metres, or by a hundredth of a kilometre."""

    class Biased(type(example("linear_gaussian"))):
        def __init__(self) -> None:
            super().__init__()
            self.bias = PyroParam(torch.tensor(0.0))

    program = Biased()
    for sd in (1e-3, 1.0, 10.0, 1e4):
        known = ParameterInformation(("bias",), torch.tensor([[sd**-2]]).double(), 0.0, frozenset())
        for name, parameter in program.named_parameters():
            parameter.requires_grad_(name.startswith("bias"))
        with seeded(0, "draws"):
            assert float(known.draws(program, 4000).std()) == pytest.approx(sd, rel=0.05)


def test_a_program_that_fails_beside_its_fit_keeps_the_fit() -> None:
    class Brittle(type(example("linear_gaussian"))):
        def transition(self, state, control, time, step):
            if abs(float(self.gain.detach()) - 1.0) > 1e-3:
                raise ValueError("no gain but one")
            return super().transition(state, control, time, step)

    program = Brittle()
    data = for_program(program, drives(example("linear_gaussian"), 6, 81, seed=3))
    with torch.no_grad():
        program.gain = torch.tensor(1.0)
    path = smooth(Problem(program, data), known_path(data)).linearization.path
    found, notes = information_of_fit(Problem(program, data), path)
    assert found is None and "no gain but one" in notes[0]


def known_path(data: Trajectories) -> ReferencePath:
    return ReferencePath(data.states, torch.zeros_like(data.states[1:, :, :1]))


def test_it_knows_the_drives_that_it_has_seen() -> None:
    problem, found = fitted(6)
    data = problem.data
    assert found.has_seen(data) and found.has_seen(data.subset([4, 1])) and found.has_seen(data.without_truth())
    assert not found.has_seen(drives(problem.program, 6, 81, seed=4))
    measurements = data.measurements.clone()
    measurements[7, 2, 0] += 1e-3
    assert not found.has_seen(replace(data, measurements=measurements))
    assert found.has_seen(replace(data, labels=tuple("abcdef"), time=data.time + 5.0))


def test_a_program_of_other_numbers_is_told() -> None:
    problem, found = fitted(2)
    assert found.suits(problem.program)
    assert not found.suits(problem.program.with_effect("quadratic_drag", 0.1))
    assert not found.suits(example("neural_vehicle.py:NeuralHovercraft"))


def test_a_file_of_it_is_read_as_it_was_and_another_is_refused() -> None:
    _, found = fitted(2)
    tensors, text = found.as_tensors()
    again = ParameterInformation.from_tensors(tensors, text)
    assert torch.equal(again.matrix, found.matrix)
    assert (again.names, again.gain, again.drives) == (found.names, found.gain, found.drives)
    for spoilt in (text | {"names": '["mass"]'}, text | {"gain": "[]"}, text | {"drives": "3"}, {}):
        with pytest.raises((KeyError, ValueError, TypeError)):
            ParameterInformation.from_tensors(tensors, spoilt)
    with pytest.raises(ValueError, match="matrix"):
        ParameterInformation.from_tensors({"matrix": torch.full_like(found.matrix, torch.nan)}, text)


@pytest.mark.parametrize("name", ["neural_vehicle.py:NeuralHovercraft", "frozen"])
def test_a_network_and_a_program_that_learns_nothing_have_none(name: str) -> None:
    program = example("linear_gaussian" if name == "frozen" else name)
    program = program.requires_grad_(False) if name == "frozen" else program
    assert information_of_fit(Problem(program, some(program))) == (None, [])


def some(program) -> Trajectories:
    return drives(program, 2, 11, seed=0)
