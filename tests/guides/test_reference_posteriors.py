"""Every engine draws from the posterior that a long NUTS has stored, and each of several mistakes is noticed.

The limit is 4 standard errors on the mean and the standard deviation of every state at every row, 84 to 192 numbers a
problem. A correct engine exceeds it somewhere with one to four of a hundred seeds (counted on 40 runs drawn again from
2,000: the error that so few runs give has wide tails), so the seed is fixed. What weights estimate is also biased by
the inverse number of particles: there are enough of them for that to drown in the scatter of 40 runs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import pytest
import torch
from references import PROBLEMS, Reference, errors_off, reference, rolled_out, runs
from torch import Tensor

from steady_ppl import Constant, GaussianGuide, LookaheadGuide, PathGuide, Program, SMCGuide, Trajectories, seeded
from steady_ppl.smc.genealogy import History

RUNS, LIMIT = 40, 4.0
NOTICED = 2 * LIMIT


def bootstrap(program: Program, weight: float = 1.0) -> PathGuide:
    return SMCGuide(program, particles=4000, draws=200, tempering=Constant(weight))


def lookahead(program: Program, weight: float = 1.0) -> PathGuide:
    return LookaheadGuide(program, particles=2000, draws=400, tempering=Constant(weight))


def gaussian(program: Program, weight: float = 1.0) -> PathGuide:
    return GaussianGuide(program, draws=400, tempering=Constant(weight))


ENGINES = (bootstrap, lookahead, gaussian)
EXACT = [(engine, name) for engine in (bootstrap, lookahead) for name in PROBLEMS]


def drawn(guide: PathGuide, data: Trajectories, count: int = 15) -> Tensor:
    """Draws of independent runs, `(M, T + 1, R, D)`; some few suffice to notice a mistake."""
    with seeded("reference"):
        guide.refresh(runs(data, count), 1.0)
    return guide.paths.states


@cache
def states(engine: Callable, name: str) -> Tensor:
    """Draws of an engine on a stored problem."""
    problem = reference(name)
    return drawn(engine(problem.program), problem.data, RUNS)


def worst(problem: Reference, states: Tensor) -> float:
    """How many standard errors the worst of all rows, states and moments is off."""
    return float(errors_off(problem, states).abs().max())


# --- agreement --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("engine", "name"), [*EXACT, (gaussian, "hovercraft")])
def test_draws_have_the_moments_that_nuts_found(engine, name):
    assert worst(reference(name), states(engine, name)) < LIMIT


@pytest.mark.parametrize(("name", "sds"), [("network", 0.15), ("pendulum", 0.07)])
def test_the_gaussian_guide_is_off_where_the_posterior_is_not_normal(name, sds):
    problem, found = reference(name), states(gaussian, name)
    assert worst(problem, found) > NOTICED
    assert ((found.mean((0, 2)) - problem.mean) / problem.sd).abs().max() > sds


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_program_is_the_one_that_nuts_ran(name):
    problem = reference(name)
    path, log_likelihood = rolled_out(problem.program, problem.data, problem.a_draw["start"], problem.a_draw["noise"])
    torch.testing.assert_close(path, problem.a_draw["states"], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(log_likelihood, problem.a_draw["log_likelihood"], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_stored_moments_are_known_to_a_fiftieth_of_a_standard_deviation(name):
    problem = reference(name)
    for error in (problem.mean_error, problem.sd_error):
        assert (error > 0).all() and (error < 0.02 * problem.sd).all()


# --- mistakes that must be noticed ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_a_wrong_landmark_is_noticed(engine):
    problem = reference("hovercraft")

    class Wrong(type(problem.program)):
        landmarks = ((12.0, -3.0), *problem.program.landmarks[1:])

    wrong = Wrong().double().requires_grad_(False)
    wrong.load_state_dict(problem.program.state_dict())
    assert worst(problem, drawn(engine(wrong), problem.data)) > NOTICED


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_measurements_in_another_order_are_noticed(engine):
    problem = reference("hovercraft")
    measured = problem.data.observed[:, 0].any(-1).nonzero().flatten()
    with seeded("shuffled"):
        shuffled = measured[torch.randperm(len(measured))]
    measurements = problem.data.measurements.clone()
    measurements[measured] = problem.data.measurements[shuffled]
    data = replace(problem.data, measurements=measurements)
    assert worst(problem, drawn(engine(problem.program), data)) > NOTICED


@pytest.mark.parametrize("name", PROBLEMS)
def test_ancestors_applied_twice_are_noticed(name, monkeypatch):
    trace = History.trace

    def twice(history: History, index: Tensor) -> tuple[Tensor, dict[str, Tensor], Tensor]:
        parents = [None if own is None else own.gather(1, own) for own in history.parents]
        return trace(replace(history, parents=parents), index)

    monkeypatch.setattr(History, "trace", twice)
    problem = reference(name)
    assert worst(problem, drawn(bootstrap(problem.program), problem.data)) > NOTICED


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_half_the_weight_of_the_observations_is_noticed(engine):
    problem = reference("hovercraft")
    assert worst(problem, drawn(engine(problem.program, 0.5), problem.data)) > NOTICED
