import math
from dataclasses import replace

import pytest
import torch

from steady_ppl import Trajectories, UsageError
from steady_ppl.data.horizons import named_horizons, time_scale

TWO_PI = 2 * math.pi


def waves(rate: float, step: float, rows: int = 300, *, size: float = 1.0, noise: float = 0.0, turns: bool = False):
    """Drives of sin(rate · t + phase): what is apart by h differs by 2 sin²(rate h / 2) of its variance, 30 % of what
    it ever does at rate · h = .8. One that `turns` is a heading within a turn, which moves as fast."""
    random = torch.Generator().manual_seed(0)
    time = (step * torch.arange(rows).double())[:, None].expand(rows, 8)
    phase = rate * time + TWO_PI * torch.rand(8, generator=random)
    values = torch.remainder(phase + math.pi, TWO_PI) - math.pi if turns else size * phase.sin()
    values = (values + noise * torch.randn(rows, 8, generator=random)).unsqueeze(-1)
    lengths = torch.full((8,), rows)
    return Trajectories(time, torch.zeros(rows, 8, 0), values, torch.ones(rows, 8, 1, dtype=torch.bool), lengths)


@pytest.mark.parametrize("seconds", [1e-3, 0.1, 1.0, 3.0, 1000.0])
def test_the_time_scale_goes_with_the_pace_of_what_is_measured(seconds: float) -> None:
    for step in (0.02, 0.1):
        assert time_scale(waves(0.8 / seconds, step * seconds)) == pytest.approx(seconds)


def test_units_noise_and_gaps_do_not_move_it() -> None:
    plain = waves(0.8, 0.1)
    assert time_scale(waves(0.8, 0.1, size=1e6)) == time_scale(waves(0.8, 0.1, noise=0.3)) == time_scale(plain) == 1.0
    sparse = torch.zeros_like(plain.observed)
    sparse[::3] = True
    some = Trajectories(plain.time, plain.controls, plain.measurements, sparse, plain.lengths)
    assert time_scale(some) == 1.0


def test_a_heading_that_comes_round_moves_no_faster_than_it_turns() -> None:
    assert time_scale(waves(0.8, 0.1, turns=True), torch.tensor([True])) == 1.0
    assert time_scale(waves(0.8, 0.1, turns=True)) < 1.0


def test_one_row_of_a_fast_circuit_is_the_least() -> None:
    assert named_horizons(waves(400.0, 0.0016), 2) == {"one step": 1, "0.003 s": 2, "0.01 s": 6}


def test_drives_that_do_not_move_have_a_tenth_of_their_length() -> None:
    assert time_scale(waves(0.8, 0.1, rows=101, size=0.0, noise=0.1)) == 1.0


def test_times_that_are_asked_for_come_first() -> None:
    assert named_horizons(waves(0.8, 0.1), 2, [2.5, 0.5]) == {"one step": 1, "0.5 s": 5, "2.5 s": 25}
    assert list(named_horizons(waves(0.8, 0.1), 3)) == ["one step", "1 s", "3 s", "10 s"]
    for wrong in (-1.0, math.inf, 0.1, 40.0):
        with pytest.raises(UsageError, match="horizon is"):
            named_horizons(waves(0.8, 0.1), 2, [wrong])
    with pytest.raises(UsageError, match="the same number of rows"):
        named_horizons(waves(0.8, 0.1), 2, [0.5, 0.52])


@pytest.mark.parametrize("every", [1, 3, 10])
def test_a_measurement_that_comes_seldom_moves_no_slower(every: int) -> None:
    slow = waves(0.8 / 3, 0.1, rows=600)
    observed = torch.zeros_like(slow.observed)
    observed[::every] = True
    assert time_scale(replace(slow, observed=observed)) == 3.0


def test_a_column_of_noise_alone_tells_nothing() -> None:
    slow, noisy = waves(0.8 / 3, 0.1, rows=600), waves(0.8, 0.1, rows=600, size=0.0, noise=1.0)
    both = [torch.cat([getattr(one, name) for one in (slow, noisy)], -1) for name in ("measurements", "observed")]
    assert time_scale(replace(slow, measurements=both[0], observed=both[1])) == 3.0


def test_what_forgets_itself_within_two_rows_has_the_shortest_times() -> None:
    random, values = torch.Generator().manual_seed(1), [torch.zeros(8).double()]
    for _ in range(599):
        values.append(0.3 * values[-1] + torch.randn(8, generator=random).double())
    fast = replace(waves(0.8, 0.1, rows=600), measurements=torch.stack(values).unsqueeze(-1))
    assert time_scale(fast) <= 0.3
