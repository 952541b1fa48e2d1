"""The time of a measurement: when it arrived, when its header says that it was made, and one clock onto another."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bag_drives import SCAN, U, taken, values
from bag_writing import Said, stamped, write_bag
from hypothesis import given, settings, strategies as st

from steady_ppl import BagColumn, BagMapping, read_bags
from steady_ppl.data.rosbag.resample import align


@settings(max_examples=100, deadline=None)
@given(
    offset=st.floats(-1e5, 1e5),
    drift=st.floats(-2e-4, 2e-4),
    delays=st.lists(st.floats(0, 0.2), min_size=20, max_size=80),
    quick=st.floats(0, 1e-3),
    a=st.integers(0, 4),
    b=st.integers(0, 4),
)
def test_a_clock_is_found_to_what_the_quickest_messages_leave_open(offset, drift, delays, quick, a, b):
    """One message near each end is on its way for at most `quick`, all others for any time.

    The found line minus the true one is linear, at most `quick` at these two messages (it is below every point) and
    not below zero at the mean of the stamps (there it is between two points, which are above the true line). So it
    grows by less than quick / (their least distance from the mean) per second.
    """
    delays[a], delays[-1 - b] = quick, quick / 2
    made = np.arange(len(delays)) * 0.1
    stamps = np.rint((made - offset) / (1 + drift) * 1e9).astype(np.int64)
    seconds = stamps / 1e9
    truth = offset + drift * seconds + seconds  # on the clock of the bag
    received = np.rint((truth + np.array(delays)) * 1e9).astype(np.int64)
    found = align(stamps, received)
    middle = seconds.mean()
    slope = quick / min(middle - seconds[a], seconds[-1 - b] - middle)
    bound = quick + slope * np.abs(seconds - middle) + 1e-8
    error = found.times / 1e9 - truth
    assert (np.abs(error) <= bound).all()
    assert abs(found.drift - drift) <= slope + 1e-8
    assert found.offset == pytest.approx((truth - seconds).mean(), abs=quick + 1e-8)


def test_stamps_that_are_all_alike_have_no_drift():
    found = align(np.array([5, 5, 5]), np.array([40, 20, 30]))
    assert found.times.tolist() == [20, 20, 20] and found.drift == 0.0


def test_one_clock_beside_another_is_left_to_the_nanosecond():
    stamps = 1_700_000_000_000_000_000 + np.arange(1000) * 10_000_019
    assert (align(stamps, stamps).times == stamps).all()
    assert (align(stamps, stamps + 1_600_000_000_123_456_789).times == stamps + 1_600_000_000_123_456_789).all()


def test_header_stamps_order_and_place_measurements(tmp_path: Path) -> None:
    """What arrives late and in another order is where its header says, minus what is known to be late."""
    made, arrived = [0.0, 0.1, 0.2, 0.3], [0.33, 0.31, 0.36, 0.35]
    messages = [("/scan", SCAN, b, stamped(a + 0.02, ranges=[a])) for a, b in zip(made, arrived, strict=True)]
    messages += values([(0.0, 1.0)], "/u")
    bag = write_bag(tmp_path / "d", "mcap", sorted(messages, key=lambda message: message[2]))
    column = BagColumn("y.r", "/scan", "ranges[0]", clock="header", late=0.02)
    data = taken(bag, U, column)
    assert data.measurements[:, 0, 0].tolist() == np.float32(made).tolist()
    assert taken(bag, U, BagColumn("y.r", "/scan", "ranges[0]")).observed.sum() == 2


@pytest.mark.parametrize("kind", ["ros1", "sqlite"])
def test_a_clock_with_offset_and_drift_is_aligned(tmp_path: Path, capsys, kind: str) -> None:
    """Delays between 4 and 30 ms, the least near both ends: found to within a nanosecond or two, late by those 4 ms.

    The least delays are equal, so their line is under every other point and is the hull's edge over the middle.
    """
    delays = np.random.default_rng(0).uniform(0.005, 0.03, 200)
    delays[[3, -5]] = 0.004
    messages: list[Said] = []
    for i, delay in enumerate(delays):
        t = i / 10
        messages.append(("/u", "std_msgs/msg/Float64", t, {"data": 1.0}))
        messages.append(("/scan", SCAN, t + delay, stamped((t - 40.0) / (1 + 5e-5), ranges=[float(i)])))
    bag = write_bag(tmp_path / "d", kind, messages)
    column = BagColumn("y.r", "/scan", "ranges[0]", clock="aligned", late=0.004)
    data = read_bags([bag], BagMapping((U, column), 0.1))
    assert data.measurements[:, 0, 0].tolist() == list(range(200))
    middle = 40 + 0.004 + (19.9 / 2 - 40) * 5e-5 / (1 + 5e-5)
    assert f"/scan: its clock was {middle * 1e3:.3f} ms behind the bag's halfway" in capsys.readouterr().err
    fine = taken(bag, BagColumn("y.u", "/u", "data"), column, step=0.001)  # the first is 4 ms late by `late` alone
    rows = fine.observed[:, 0, 1].nonzero()[:, 0].tolist()
    assert rows == [100 * i for i in range(200)]
