"""Lag, delay and rate limit of controls that are held from row to row, against exact and finely stepped solutions."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from steady_ppl import delayed, lagged, rate_limited

ROWS, DRIVES, CONTROLS = 12, 3, 2


def held(even: bool = False) -> tuple[torch.Tensor, torch.Tensor]:
    """Controls and times; the steps are uneven and differ between trajectories unless `even`."""
    control = torch.randn(ROWS, DRIVES, CONTROLS, dtype=torch.float64)
    steps = 0.05 + 0.15 * torch.rand(ROWS, DRIVES, dtype=torch.float64)
    time = (torch.full_like(steps, 0.1) if even else steps).cumsum(0)
    return control, time - time[0]


def edges_of(time: np.ndarray) -> np.ndarray:
    """The ends of a trajectory's intervals; the last one is as long as the one before."""
    return np.append(time, 2 * time[-1] - time[-2])


@pytest.mark.parametrize("constant", [0.03, 0.25, 2.0])
def test_the_lag_is_the_mean_of_the_differential_equations_solution(constant: float) -> None:
    control, time = held()
    fine, got = 500, lagged(control, time, torch.tensor(constant)).numpy()
    for drive in range(DRIVES):
        at = control[0, drive].numpy().copy()
        for row, (begin, end) in enumerate(pairwise(edges_of(time[:, drive].numpy()))):
            share, total = (end - begin) / fine / constant, np.zeros(CONTROLS)
            for _ in range(fine):  # the trapezoidal rule for da/dt = (u − a) / constant
                after = at + share * (control[row, drive].numpy() - at) / (1 + share / 2)
                total, at = total + (at + after) / 2, after
            np.testing.assert_allclose(got[row, drive], total / fine, atol=1e-5 * abs(control).max().item())


@pytest.mark.parametrize("delay", [0.02, 0.1, 0.137, 0.9, 5.0])
def test_the_delay_is_the_mean_of_the_control_some_time_ago(delay: float) -> None:
    control, time = held()
    got = delayed(control, time, torch.tensor(delay, dtype=torch.float64)).numpy()
    for drive in range(DRIVES):
        edges = edges_of(time[:, drive].numpy())
        for row, (begin, end) in enumerate(pairwise(edges)):
            changes = [edge + delay for edge in edges if begin < edge + delay < end]
            parts = []
            for a, b in pairwise([begin, *changes, end]):
                then = max(np.searchsorted(edges, (a + b) / 2 - delay, side="right") - 1, 0)
                parts.append((b - a) * control[then, drive].numpy())
            np.testing.assert_allclose(got[row, drive], sum(parts) / (end - begin), atol=1e-12)


def test_a_delay_of_whole_steps_shifts_and_holds_the_first_control_before() -> None:
    control, time = held(even=True)
    got = delayed(control, time, torch.tensor(0.3, dtype=torch.float64))
    torch.testing.assert_close(got[3:], control[:-3], rtol=0, atol=1e-12)
    torch.testing.assert_close(got[:3], control[:1].expand(3, -1, -1), rtol=0, atol=1e-12)


def test_a_delay_of_two_and_a_half_steps_is_half_of_each_neighbour() -> None:
    control, time = held(even=True)
    got = delayed(control, time, torch.tensor(0.25, dtype=torch.float64))
    torch.testing.assert_close(got[3:], (control[:-3] + control[1:-2]) / 2, rtol=0, atol=1e-12)


@pytest.mark.parametrize("acts", [lagged, delayed])
def test_nothing_happens_at_zero_and_to_a_single_row(acts) -> None:
    control, time = held()
    for value in (0.0, -1.0):
        torch.testing.assert_close(acts(control, time, torch.tensor(value)), control, rtol=0, atol=1e-12)
    assert torch.equal(acts(control[:1], time[:1], torch.tensor(0.5)), control[:1])
    assert torch.equal(lagged(control, time, torch.tensor(0.0)), control)


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
@pytest.mark.parametrize("acts", [lagged, delayed])
def test_the_compiled_loop_is_torchs(kind: torch.dtype, acts) -> None:
    control, time = (part.to(kind) for part in held())
    for seconds in (0.0, 0.1, 0.17, 0.93, 40.0):
        learned = torch.tensor(seconds, dtype=kind, requires_grad=True)
        by_torch = acts(control, time, learned)
        assert by_torch.requires_grad
        assert torch.equal(acts(control, time, learned.detach()), by_torch)


@pytest.mark.parametrize("acts", [lagged, delayed])
def test_a_control_that_never_changes_stays(acts) -> None:
    _, time = held()
    control = torch.ones(ROWS, DRIVES, CONTROLS, dtype=torch.float64)
    torch.testing.assert_close(acts(control, time, torch.tensor(0.37)), control, rtol=0, atol=1e-12)


@pytest.mark.parametrize("acts", [lagged, delayed])
@pytest.mark.parametrize("value", [0.0, 0.07, 0.3])
def test_gradients_are_those_of_small_differences(acts, value: float) -> None:
    control, time = held()
    weights = torch.randn_like(control)

    def total(constant: torch.Tensor) -> torch.Tensor:
        return (weights * acts(control, time, constant)).sum()

    at = torch.tensor(value, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(total(at), at)
    small = 1e-7  # from the right, as nothing lies left of zero
    slope = (total(at.detach() + small) - total(at.detach())) / small
    torch.testing.assert_close(gradient, slope, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("rate", [0.5, 5.0, 40.0])
def test_a_limited_rate_is_the_mean_of_what_moves_so_fast_at_most(rate: float) -> None:
    control, time = held()
    fine, got = 2000, rate_limited(control, time, torch.tensor(rate)).numpy()
    for drive in range(DRIVES):
        at = control[0, drive].numpy().copy()
        for row, (begin, end) in enumerate(pairwise(edges_of(time[:, drive].numpy()))):
            most, total = rate * (end - begin) / fine, np.zeros(CONTROLS)
            for _ in range(fine):
                after = at + np.clip(control[row, drive].numpy() - at, -most, most)
                total, at = total + (at + after) / 2, after
            np.testing.assert_allclose(got[row, drive], total / fine, atol=2e-3)


def test_a_high_rate_limits_nothing_and_each_control_may_have_its_own() -> None:
    control, time = held()
    torch.testing.assert_close(rate_limited(control, time, torch.tensor(1e9)), control, rtol=0, atol=1e-6)
    both = rate_limited(control, time, torch.tensor([0.5, 1e9], dtype=torch.float64))
    torch.testing.assert_close(both[..., 0], rate_limited(control, time, torch.tensor(0.5))[..., 0])
    torch.testing.assert_close(both[..., 1], control[..., 1], rtol=0, atol=1e-6)
    assert torch.equal(rate_limited(control[:1], time[:1], torch.tensor(0.5)), control[:1])
    still = rate_limited(control, time, torch.tensor(0.0))
    torch.testing.assert_close(still, control[:1].expand(ROWS, -1, -1), rtol=0, atol=1e-12)


def test_the_gradient_of_a_limited_rate_is_that_of_small_differences() -> None:
    control, time = held()
    weights = torch.randn_like(control)

    def total(rate: torch.Tensor) -> torch.Tensor:
        return (weights * rate_limited(control, time, rate)).sum()

    rate = torch.tensor(3.0, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(total, rate)
