"""On a CUDA device, where there is one: the same filters, without waiting for the device inside the time loop."""

from __future__ import annotations

import warnings

import pytest
import torch
from examples import copies, drives, example
from oracles import assert_mean

from steady_ppl import particle_filter, seeded
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.gaussian.twisted_proposal import Twist
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import for_program

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


def problem(rows: int, device: str):
    program = example("neural_vehicle.py:NeuralHovercraft", torch.float32)
    data = drives(example("hovercraft.py:HovercraftTruth", torch.float32), 2, rows)
    program.to(device)
    return program, for_program(program, copies(data, 100))


def filtered(rows: int, device: str, look_ahead: bool = False):
    program, data = problem(rows, device)
    proposal = Twist(find_and_smooth(Problem(program, data, True))) if look_ahead else None
    with seeded("device", device):
        return particle_filter(program, data, particles=500, known_start=True, proposal=proposal)


@pytest.mark.parametrize("look_ahead", [False, True])
def test_a_device_estimates_what_the_processor_does(look_ahead):
    both = [filtered(9, device, look_ahead).log_likelihood.cpu().view(2, 100) for device in ("cuda", "cpu")]
    level = both[1].mean(1, keepdim=True)
    assert_mean(((both[0] - level).exp() - (both[1] - level).exp()).t(), 0.0)


@pytest.mark.parametrize("look_ahead", [False, True])
def test_a_filter_waits_for_the_device_no_more_often_on_a_longer_drive(look_ahead):
    waits = []
    for rows in (9, 33):
        filtered(rows, "cuda", look_ahead)
        program, data = problem(rows, "cuda")
        proposal = Twist(find_and_smooth(Problem(program, data, True))) if look_ahead else None
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            torch.cuda.set_sync_debug_mode("warn")
            try:
                particle_filter(program, data, particles=500, known_start=True, proposal=proposal)
            finally:
                torch.cuda.set_sync_debug_mode("default")
        waits.append(sum("synchroniz" in str(warning.message) for warning in caught))
    assert waits[0] == waits[1]
