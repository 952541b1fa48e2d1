"""Which of the validated parameters are kept."""

import pytest
import torch
from examples import HeavyTailed, example
from small import simulated

from steady_ppl import Validation, for_program, log_likelihood, seeded, simulate
from steady_ppl.training.loop import within_one_standard_error


def test_better_is_as_good() -> None:
    assert within_one_standard_error([2.0, 3.0, 4.0], [1.0, 2.0, 3.0])


def test_within_one_standard_error_of_the_paired_difference_is_as_good() -> None:
    best = [10.0, 20.0, 30.0, 40.0]
    loss = [1.0, -0.5, 0.5, 0.0]  # mean .25, standard error .323
    assert within_one_standard_error([b - difference for b, difference in zip(best, loss, strict=True)], best)


def test_a_consistent_loss_is_worse_however_small() -> None:
    assert not within_one_standard_error([9.99, 19.98, 29.99, 39.98], [10.0, 20.0, 30.0, 40.0])


def test_a_single_held_out_drive_is_compared_directly() -> None:
    assert within_one_standard_error([1.0], [1.0])
    assert not within_one_standard_error([0.9], [1.0])


def test_without_held_out_drives_the_last_is_kept() -> None:
    assert within_one_standard_error([], [])


def test_validation_repeats_its_random_numbers_and_averages_at_the_stated_rate() -> None:
    program = example("linear_gaussian")
    data = for_program(program, simulate(program, 3, seed=4))
    validation = Validation(data, particles=50, every=5)
    first = validation(program, seed=7)
    torch.rand(3)
    assert validation(program, seed=7) == first
    with seeded(7, "validate"):
        expected = log_likelihood(program, data, particles=50, known_start=False, every=5)
    assert first == pytest.approx(expected.tolist())


def test_the_filter_suits_the_programs_noise():
    """Looking ahead wherever the noise is normal, and a note where it is not."""
    program = example("hovercraft", torch.float32)
    ahead = Validation.suited(program, simulated(rows=6), known_start=True)
    assert (ahead.look_ahead, ahead.every, ahead.particles, ahead.notes) == (True, 1, 100, [])
    blind = Validation.suited(HeavyTailed(), simulated(rows=6), known_start=True, particles=70)
    assert (blind.look_ahead, blind.every, blind.particles) == (False, 10, 70)
    assert "bootstrap filter at every tenth row: site 'acceleration' is StudentT" in blind.notes[0]
    assert Validation.suited(program, None).data is None
