"""Times to rows, without a bag: held against what the definitions say, one by one."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from steady_ppl import BagColumn, DataError
from steady_ppl.data.rosbag.resample import Series, in_rows

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
