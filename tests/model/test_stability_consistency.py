"""What can be taken in substeps: transitions that are no step in time, and actuators that count rows."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import example

from steady_ppl import (
    ProgramError,
    fit_by_likelihood,
    for_program,
    seeded,
    simulate,
    stack,
    with_substeps,
)
from steady_ppl.criticism.step_size import check_step
from steady_ppl.model.actuation import with_play
from steady_ppl.model.stability import counts_rows, is_step
from steady_ppl.model.substeps import (
    acting_controls,
    row_controls,
)
from steady_ppl.model.validate import probe


class Delayed(type(example("hovercraft"))):
    """Its commands act .05 s late."""

    def actuators(self, control, time):
        from steady_ppl import delayed

        return delayed(control, time, torch.tensor(0.05))


def test_a_delay_ends_inside_a_row() -> None:
    program = with_substeps(Delayed().double(), 4)
    data = for_program(program, simulate(program, 2, seed=1))
    acting = acting_controls(program, data)
    assert acting.shape == (*data.time.shape, 8)
    halves = acting.unflatten(-1, (4, 2))
    before, now = data.controls[:-1], data.controls[1:]
    torch.testing.assert_close(halves[1:, :, :2], before.unsqueeze(2).expand(-1, -1, 2, -1), rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(halves[1:, :, 2:], now.unsqueeze(2).expand(-1, -1, 2, -1), rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(row_controls(program, acting)[1:], (before + now) / 2, rtol=1e-6, atol=1e-8)


class Counting(type(example("linear_gaussian"))):
    """Moves by a row, not by a time."""

    def transition(self, state, control, time, step):
        position, velocity = state.unbind(-1)
        acceleration = pyro.sample("acceleration", dist.Normal(control[..., 0], self.noise))
        return stack(position + velocity, velocity + acceleration)


class Brownian(type(example("linear_gaussian"))):
    """Noise of a random walk, which grows with the root of the step."""

    def transition(self, state, control, time, step):
        position, velocity = state.unbind(-1)
        acceleration = pyro.sample("acceleration", dist.Normal(control[..., 0], self.noise / step.sqrt()))
        return stack(position + velocity * step, velocity + acceleration * step)


class Uniform(type(example("linear_gaussian"))):
    """Noise without location and scale."""

    def transition(self, state, control, time, step):
        position, velocity = state.unbind(-1)
        acceleration = pyro.sample("acceleration", dist.Uniform(control[..., 0] - 1, control[..., 0] + 1))
        return stack(position + velocity * step, velocity + acceleration * step)


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (Counting, "transition is no step in `step`.*position.*goes apart as K grows"),
        (Brownian, "transition is no step in `step`.*velocity.*goes apart as K grows"),
        (Uniform, "'acceleration' is Uniform: substeps need channel noise with a location and a scale"),
    ],
)
def test_what_cannot_be_cut_is_refused_in_one_line(kind, said) -> None:
    probe(kind())
    with pytest.raises(ProgramError, match=said) as caught:
        probe(with_substeps(kind(), 4))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("program", "expected"),
    [
        (example("hovercraft"), True),
        (example("truck"), True),
        (example("pendulum"), True),
        (example("linear_gaussian"), True),
        (example("hovercraft").with_effect("coloured_noise:translation"), True),
        (Counting().double(), False),
        (Brownian().double(), False),
        (example("paper:PaperTruck"), False),
    ],
    ids=lambda value: getattr(type(value), "__name__", ""),
)
def test_a_step_is_told_from_what_is_none(program, expected) -> None:
    data = for_program(program, simulate(program, 2, seed=1, substeps=1))
    assert is_step(program, data) is expected


class RowsLate(type(example("hovercraft"))):
    """Its commands act a row late, however long the row."""

    def actuators(self, control, time):
        return torch.cat([control[:1], control[:-1]])


class Halved(type(example("hovercraft"))):
    """Its commands act by half, at once."""

    def actuators(self, control, time):
        return 0.5 * control


class Loose(type(example("hovercraft"))):
    """Its commands are dragged through a gap, which goes by them alone."""

    def actuators(self, control, time):
        return with_play(control, torch.tensor(0.1))


@pytest.mark.parametrize(("kind", "expected"), [(RowsLate, True), (Delayed, False), (Halved, False), (Loose, False)])
def test_actuators_that_count_rows_are_told_from_others(kind, expected) -> None:
    program = kind().double()
    assert counts_rows(program) is expected
    data = for_program(program, simulate(program, 2, seed=1, substeps=1))
    assert is_step(program, data) is not expected
    if expected:
        with pytest.raises(ProgramError, match="model RowsLate: actuators counts rows and not seconds"):
            probe(with_substeps(program, 2))
        found = check_step(program, data, known_start=True)
        assert len(found.trials) == 1
        assert found.uncompared.startswith("whether the time step suits is not known: `actuators` counts rows")
    else:
        probe(with_substeps(program, 2))


def test_what_is_no_step_is_simulated_row_by_row() -> None:
    program = Counting().double()
    torch.testing.assert_close(simulate(program, 2, seed=1).states, simulate(program, 2, seed=1, substeps=1).states)


class Jumping(type(example("linear_gaussian"))):
    """Counts rows, and bounded: its velocity is what is left of the last one and a jump."""

    def transition(self, state, control, time, step):
        position, velocity = state.unbind(-1)
        jump = pyro.sample("acceleration", dist.Normal(self.gain * control[..., 0], self.noise))
        return stack(position + velocity * step, 0.8 * velocity + jump)


def test_a_model_that_counts_rows_is_not_told_to_take_finer_steps() -> None:
    program = Jumping().double()
    data = for_program(program, simulate(program, 8, seed=1)).without_truth()
    with seeded(0, "paths"):
        found = check_step(program, data, fit_by_likelihood(program, data))
    assert not found.too_coarse and not found.sentence


def test_a_row_that_overflows_is_refused() -> None:
    class Overflowing(type(example("linear_gaussian"))):
        def transition(self, state, control, time, step):
            position, velocity = state.unbind(-1)
            acceleration = pyro.sample("acceleration", dist.Normal(-velocity / step**4, self.noise))
            return stack(position + velocity * step, velocity + acceleration * step)

    with pytest.raises(ProgramError, match="transition is no step"):
        probe(with_substeps(Overflowing(), 4))
