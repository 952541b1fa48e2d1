"""Times to rows, held against what the definitions say, one by one; and one clock onto another."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from bag_drives import SCAN, U, taken, values
from bag_writing import Said, stamped, write_bag
from hypothesis import given, settings, strategies as st

from steady_ppl import BagColumn, BagMapping, DataError, LogColumn, read_bags
from steady_ppl.data.recordings.resample import Series, align, in_rows

MS = 1_000_000
STEP = 0.1


def series(name: str, times: list[int], values: list[float] | None = None, **keys) -> Series:
    """Times in ms."""
    numbers = np.arange(len(times), dtype=float) if values is None else np.array(values, dtype=float)
    return Series(BagColumn(name, "/t", "data", **keys), np.array(times, dtype=np.int64) * MS, numbers)


times = st.lists(st.integers(0, 3000), min_size=1, max_size=40).map(sorted)


@settings(max_examples=200, deadline=None)
@given(control=times, measured=times, state=times, longest=st.none() | st.sampled_from([0.2, 0.3, 1.0]))
def test_rows_say_what_the_definitions_say(control, measured, state, longest):
    pieces = in_rows(
        [series("u.a", control, longest=longest), series("y.b", measured), series("x.c", state)], STEP, "bag"
    )
    claimed: list[int] = []
    for piece in pieces:
        rows = [piece.start // MS + 100 * i for i in range(piece.rows)]
        for at, held, seen, known in zip(rows, *(piece.cells[name] for name in ("u.a", "y.b", "x.c")), strict=True):
            assert held == max(i for i, t in enumerate(control) if t <= at)
            near = [i for i, t in enumerate(measured) if -50 <= t - at < 50]
            claimed += near
            if math.isnan(seen):
                assert not near
            else:
                assert seen == min(near, key=lambda i: (abs(measured[i] - at), i))
            before = [i for i, t in enumerate(state) if t <= at]
            after = [i for i, t in enumerate(state) if t > at]
            if before and state[before[-1]] == at:
                assert known == before[-1]
            elif before and after and state[after[0]] - state[before[-1]] <= 200:
                left, right = before[-1], [i for i in after if state[i] == state[after[0]]][-1]
                share = (at - state[left]) / (state[right] - state[left])
                assert known == pytest.approx(left + share * (right - left), abs=1e-9)
            else:
                assert math.isnan(known)
        if piece.rows:
            assert not math.isnan(piece.cells["y.b"][-1]) and piece.start // MS in control
        if longest is not None:
            inside = [t for t in control if t >= piece.start // MS]
            following = [*inside[1:], max(measured[-1], inside[-1])]
            pauses = [a for a, b in zip(inside, following, strict=True) if b - a > longest * 1000]
            assert not pauses or all(at <= pauses[0] + 50 for at in rows)
    assert len(claimed) == len(set(claimed))
    assert len(claimed) == sum(piece.placed["y.b"] for piece in pieces)
    assert sum(piece.rivals["y.b"] for piece in pieces) == len(claimed) - sum(
        int((~np.isnan(piece.cells["y.b"])).sum()) for piece in pieces
    )


def test_interpolated_angles_take_the_shorter_way_and_come_back_continuous():
    turning = [(3.0 + 0.2 * i + math.pi) % (2 * math.pi) - math.pi for i in range(40)]
    at = [50 + 100 * i for i in range(40)]
    state = series("x.h", at, turning, reading="yaw")
    control = series("u.h", at, turning, reading="angle", between="interpolate")
    degrees = series("x.d", at, turning, reading="angle", scale=180 / math.pi, offset=90.0)
    (piece,) = in_rows([control, state, degrees, series("y.a", [50, 3950])], STEP)
    expected = 3.0 + 0.2 * np.arange(40)
    np.testing.assert_allclose(piece.cells["x.h"], expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(piece.cells["u.h"], expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(piece.cells["x.d"], np.degrees(expected) + 90, rtol=0, atol=1e-9)
    (shifted,) = in_rows([series("u.a", [1000]), state, series("y.a", [1000, 2000])], STEP)
    np.testing.assert_allclose(shifted.cells["x.h"], expected[9:20] + 0.1 - 2 * math.pi, rtol=0, atol=1e-12)


def test_an_interpolated_control_is_between_its_commands_and_then_the_last():
    control = series("u.a", [0, 400], [1.0, 3.0], between="interpolate", scale=2.0, offset=-1.0)
    (piece,) = in_rows([control, series("y.a", [0, 600])], STEP)
    np.testing.assert_allclose(piece.cells["u.a"], [1, 2, 3, 4, 5, 5, 5], rtol=0, atol=1e-12)


def test_rows_begin_where_all_controls_are_known_and_pieces_where_none_pauses():
    a = series("u.a", list(range(100, 1100, 100)) + list(range(2000, 4000, 100)), longest=0.5)
    b = series("u.b", list(range(0, 3000, 100)) + list(range(3500, 5000, 100)), longest=0.4)
    pieces = in_rows([a, b, series("y.a", list(range(0, 6000, 50)))], STEP)
    assert [(piece.start // MS, piece.rows) for piece in pieces] == [(100, 10), (2000, 10), (3500, 5)]


def test_without_controls_rows_begin_at_the_first_measurement():
    (piece,) = in_rows([series("y.a", [130, 330]), series("y.b", [180])], STEP)
    assert piece.start == 130 * MS and piece.rows == 3
    np.testing.assert_array_equal(piece.cells["y.b"], [np.nan, 0, np.nan])


def test_clocks_years_apart_do_not_make_a_billion_rows():
    late = Series(BagColumn("y.a", "/t", "data"), np.array([1_700_000_000 * 10**9]), np.array([1.0]))
    with pytest.raises(DataError, match="drive: 1.7e\\+09 s in steps of 0.1 s are 17000000001 rows, .* same clock"):
        in_rows([series("u.a", [0]), late], STEP, "drive")


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


def test_metres_of_a_log_are_no_angles() -> None:
    way = np.arange(100.0, 150.0, 5.0)  # more than half a turn from message to message
    times = np.arange(len(way), dtype=np.int64) * 100 * MS
    columns = [LogColumn(name, "a", "value") for name in ("u.a", "y.b")]
    columns.append(LogColumn("x.x", "gps", "lat lon", reading="east"))
    (piece,) = in_rows([Series(one, times, way) for one in columns], STEP, "log")
    np.testing.assert_allclose(piece.cells["x.x"][: len(way)], way[: piece.rows])
    assert columns[2].is_angle is False and LogColumn("x.h", "a", "yaw", reading="degrees").is_angle
