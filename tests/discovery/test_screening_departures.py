"""What counts as noise that is not the declared: what the program's own parameters became, not what an effect does."""

from __future__ import annotations

import math

import pytest
import torch
from examples import drives, example

from steady_ppl.discovery.fitting import Judges
from steady_ppl.discovery.refits import BY_LIKELIHOOD, Fold, Refit
from steady_ppl.discovery.screening import departures
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.likelihood.parameters import elements


def fitted(*programs) -> Refit:
    """As if each had been fitted to a fold of its own, of 4 and of 2 drives."""
    folds = []
    for program, count in zip(programs, (4, 2), strict=True):
        data = drives(program, count, 9)
        path = ReferencePath(data.states, torch.zeros(8, count, 3).double())
        folds.append(Fold(data, path, data, path))
    return Refit(list(programs), [], folds, BY_LIKELIHOOD, Judges(list(programs), []), torch.zeros(6), torch.zeros(6))


@pytest.mark.parametrize("effect", ["range_dependent_noise", "coloured_noise:yaw"])
def test_what_an_effect_does_to_the_noise_is_no_departure(effect):
    declared = example("hovercraft")
    declared.guesses = ()
    program = declared.with_effect(effect, 0.3)
    now = fitted(program, program)
    found = departures(declared, now, elements(program))
    assert {one.variant.name for one in found} == {"process_noise:translation", "process_noise:yaw"}
    assert all(one.away == pytest.approx(0.0, abs=1e-9) for one in found)


def test_a_departure_is_the_mean_of_all_folds_and_its_test_is_of_the_first():
    declared, one, other = (example("hovercraft") for _ in range(3))
    declared.guesses = one.guesses = other.guesses = ()
    one.noise = torch.tensor([0.4, 0.4, 0.1]).double()
    other.noise = torch.tensor([0.8, 0.8, 0.1]).double()
    found = {d.variant.name: d for d in departures(declared, fitted(one, other), elements(one))}
    translation = found["process_noise:translation"]
    assert translation.away == pytest.approx(math.log(2)) and translation.share == pytest.approx(4 / 6)
    assert translation.on_all == pytest.approx((4 * math.log(2) + 2 * math.log(4)) / 6)
    assert found["process_noise:yaw"].on_all == pytest.approx(0.0, abs=1e-6)
