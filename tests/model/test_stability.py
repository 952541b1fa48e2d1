"""Steps that are unstable, that cannot be cut, and what is said of them."""

from __future__ import annotations

import math

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import example

from steady_ppl import (
    FilterError,
    ProgramError,
    fit_by_likelihood,
    for_program,
    particle_filter,
    seeded,
    simulate,
    stack,
    with_substeps,
)
from steady_ppl.criticism.step_size import check_step
from steady_ppl.model.stability import counts_rows, divergence
from steady_ppl.model.validate import probe
from steady_ppl.smc.simulate import simulated_in

Cart = type(example("linear_gaussian"))


class Stiff(Cart):
    """Damping of 30 1/s, explicit."""

    def transition(self, state, control, time, step):
        position, velocity = state.unbind(-1)
        acceleration = pyro.sample("acceleration", dist.Normal(control[..., 0] - 30.0 * velocity, self.noise))
        return stack(position + velocity * step, velocity + acceleration * step)


@pytest.mark.slow
def test_a_step_that_is_unstable_is_told_by_its_number() -> None:
    stiff = Stiff().double()
    data = for_program(stiff, simulate(stiff, 2, seed=1))
    said = divergence(stiff, data)
    assert said == (
        "the model itself diverges at this step: damping · step = 3, with 1 substep a row; "
        "take more (fit with --substeps 8)"
    )
    assert divergence(with_substeps(stiff, 8), data) is None
    assert divergence(example("pendulum"), for_program(example("pendulum"), simulate(example("pendulum"), 2))) is None


class Dragged(Cart):
    """At rest to begin with; its drag is too stiff for a row at speed alone."""

    def initial(self):
        return pyro.sample("start", dist.Normal(torch.zeros(2).double(), 1e-3).to_event(1))

    def transition(self, state, control, time, step):
        position, velocity = state.unbind(-1)
        mean = control[..., 0] - 400.0 * velocity * velocity.abs()
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise))
        return stack(position + velocity * step, velocity + acceleration * step)


def test_a_step_that_is_unstable_at_speed_alone_is_told_too() -> None:
    """Damping 2 · 400 · v at v = √(1 / 400) under a push of 1 N: 40 1/s, 4 in a row of .1 s."""
    dragged = Dragged().double()
    data = for_program(dragged, simulate(dragged, 2, seed=1, substeps=32))
    said = divergence(dragged, data)
    assert said is not None and 3 < float(said.partition("damping · step = ")[2].partition(",")[0]) < 5
    assert divergence(with_substeps(dragged, 16), data) is None


@pytest.mark.parametrize(
    ("row", "said"), [(3, "the measurement is impossible"), (30, "in a row of 5 s: damping · step = 4")]
)
def test_a_pause_is_blamed_for_what_comes_after_it_alone(row, said) -> None:
    """Damping .8 1/s, rows of .1 s and one of 5 s after 20 of them; a position of 1e200 m in the second trajectory."""
    cart = Cart().double()
    data = for_program(cart, simulate(cart, 2, seed=1))
    data.time[21:] += 4.9
    data = for_program(cart, data)
    data.measurements[row, 1] = 1e200
    with pytest.raises(FilterError) as error:
        particle_filter(cart, data, particles=50)
    assert said in str(error.value) and str(error.value).startswith("trajectory 2 at ")


class RowsLate(Cart):
    """Its push acts so many rows late, however long the rows."""

    rows = 3

    def actuators(self, control, time):
        return torch.cat([torch.zeros_like(control[: self.rows]), control[: -self.rows]])


class ManyRowsLate(RowsLate):
    rows = 40


@pytest.mark.parametrize("kind", [RowsLate, ManyRowsLate])
@pytest.mark.parametrize("effect", [None, "actuator_lag", "actuator_delay"])
def test_a_delay_in_rows_is_seen_through_what_is_added_to_it(kind, effect) -> None:
    program = kind() if effect is None else kind().with_effect(effect, 0.05)
    assert counts_rows(program)
    with pytest.raises(ProgramError, match="actuators counts rows and not seconds"):
        probe(with_substeps(program, 4))


def test_rows_that_cannot_be_cut_are_told_by_their_reason() -> None:
    program = RowsLate()
    assert simulated_in(program, simulate(program, 2, seed=1)).startswith("simulated row by row: actuators counts rows")


class QuietAtRest(Cart):
    """Its noise grows with the push and is none without."""

    def transition(self, state, control, time, step):
        position, velocity = state.unbind(-1)
        push = control[..., 0]
        acceleration = pyro.sample("acceleration", dist.Normal(push - 0.8 * velocity, self.noise * push.abs()))
        return stack(position + velocity * step, velocity + acceleration * step)

    def example_controls(self, time):
        return torch.where((time > 2).unsqueeze(-1), 1.0, 0.0).to(time)


@pytest.mark.exhaustive
def test_a_channel_without_noise_in_some_rows_is_simulated_in_substeps() -> None:
    program = QuietAtRest().double()
    fine = simulate(program, 2, seed=1)
    assert bool(fine.states.isfinite().all())
    rest = simulate(program, 2, seed=1, substeps=320).states[:20]
    torch.testing.assert_close(fine.states[:20], rest, atol=0.02, rtol=0.02)


class PerSquareRoot(Cart):
    """White noise that is scaled by the step: its rows go apart as they are cut."""

    def transition(self, state, control, time, step):
        position, velocity = state.unbind(-1)
        mean = control[..., 0] - self.damping * velocity
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise / step))
        return stack(position + velocity * step, velocity + acceleration * step)


def test_no_finer_step_is_advised_that_the_next_command_refuses() -> None:
    program = PerSquareRoot().double()
    data = for_program(program, simulate(Cart().double(), 6, seed=1)).without_truth()
    with pytest.raises(ProgramError, match="transition is no step in `step`"):
        probe(with_substeps(program, 2))
    with seeded(0, "paths"):
        assert not check_step(program, data, fit_by_likelihood(program, data)).too_coarse


@pytest.mark.parametrize("value", [0, -1.0, math.nan, "x", None])
def test_a_simulated_step_is_seconds(value) -> None:
    program = Cart()
    program.simulated_step = value
    with pytest.raises(ProgramError, match="simulated_step is .*; expected seconds above 0, or infinity"):
        probe(program)


def test_a_number_of_substeps_may_be_numpys() -> None:
    changed = with_substeps(Cart(), np.int64(4))
    assert changed.substeps == 4 and type(changed.substeps) is int
