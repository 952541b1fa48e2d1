"""What the page shows of drives: packed numbers, where to look, and as many as there is room for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from report_pages import two_run_report, two_runs, unpacked
from small import simulated

import steady_ppl as st
from steady_ppl.reporting.drives import chosen_drives, in_sixteen_bits, where_to_look


def test_numbers_come_back_as_finely_as_sixteen_bits_are():
    values = np.random.default_rng(0).normal(size=(3, 4, 5)) * 100
    values[1, 2, 3] = np.nan
    back = unpacked(in_sixteen_bits(values))
    np.testing.assert_array_equal(np.isnan(back), np.isnan(values))
    np.testing.assert_allclose(back, values, atol=np.nanmax(values) - np.nanmin(values), rtol=0)
    assert np.nanmax(abs(back - values)) <= 0.5001 * (np.nanmax(values) - np.nanmin(values)) / 65534
    assert unpacked(in_sixteen_bits(np.full((2, 2), np.nan))).shape == (2, 2)
    np.testing.assert_array_equal(unpacked(in_sixteen_bits(np.full(3, 7.0))), 7.0)


@pytest.mark.slow
def test_a_place_to_look_at_is_where_the_misfit_is():
    table = simulated("hovercraft.py:HovercraftTruth", trajectories=6, rows=41)
    measurements = table.measurements.clone()
    measurements[15:25, 4, 1] += 0.4
    check = st.check(two_runs()["after"], replace(table, measurements=measurements), simulations=20)
    (cell,) = (
        one
        for i, one in enumerate(check.misfit.cells)
        if one.map == "drive" and one.residual == 1 and one.where["drive"] == 4
    )
    assert where_to_look(check, cell) == (4, 0.0, 4.5)
    (cell,) = (one for one in check.misfit.cells if one.map == "all" and one.residual == 1)
    place = where_to_look(check, cell)
    assert place is not None and place[0] == 4
    regimes = [one for one in check.misfit.cells if one.map == "regime" and one.residual == 1 and "left" in one.where]
    for cell in regimes:
        drive, start, end = where_to_look(check, cell)
        middle = round(0.5 * (start + end) / 0.1)
        low, high = cell.where["left"]
        near = table.controls[max(0, middle - 6) : middle + 6, drive, 0]
        assert bool(((near >= low - 1e-6) & (near <= high + 1e-6)).any())


@pytest.mark.slow
def test_there_is_room_for_the_strongest_drives():
    checks = list(two_run_report().checks.values())
    assert chosen_drives(checks).note is None
    few = chosen_drives(checks, numbers=3 * 101 * 80)
    assert 1 <= len(few.drives) < 6 and few.every == 1 and "strongest misfits" in few.note
    assert f"{len(few.drives)} of 6 trajectories" in few.note
    tiny = chosen_drives(checks, numbers=500)
    assert len(tiny.drives) == 1 and tiny.every > 1 and "th row" in tiny.note


@pytest.mark.slow
def test_what_is_shown_row_by_row_has_an_upper_bound():
    """A page of three hundred drives is hardly larger than one of thirty."""
    checks = [st.check(one, simulated(trajectories=6, rows=101), simulations=20) for one in two_runs().values()]
    for numbers in (3_000, 30_000):
        shown = chosen_drives(checks, numbers)
        rows = -(-101 // shown.every)
        assert 0.5 * numbers < len(shown.drives) * rows * 100 < 1.5 * numbers
        assert shown.note and "of 6 trajectories" in shown.note
    assert chosen_drives(checks).note is None
