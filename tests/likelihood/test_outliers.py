"""Readings that no noise of the sensor explains."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import steady_ppl as st
from steady_ppl.gaussian.smoother import find_path
from steady_ppl.likelihood.outliers import AS_TAILS, Outlier, Outliers, find_outliers
from steady_ppl.model.problem import Problem


@pytest.fixture(scope="module")
def boat():
    return st.load_program("models/gps_boat.py:GpsBoatTruth")


@pytest.fixture(scope="module")
def drives(boat):
    return st.for_program(boat, st.simulate(boat, 4, seed=1))


def found_in(program, data):
    problem = Problem(program, data).without_truth()
    return find_outliers(problem, find_path(problem))


def moved(data, *wrong):
    """Drives whose readings (rows, drive, columns) are off by so much."""
    readings = data.measurements.clone()
    for rows, drive, columns, by in wrong:
        readings[rows, drive, columns] += by
    return replace(data, measurements=readings)


@pytest.mark.slow
def test_clean_drives_have_none(boat, drives):
    assert found_in(boat, drives).found == []


@pytest.mark.slow
def test_a_jump_that_lasts_is_found_to_the_row(boat, drives):
    found = found_in(boat, moved(drives, (slice(50, 58), 2, slice(0, 2), 20.0), (30, 3, 2, 1.0)))
    position, compass = found.found
    assert (position.label, position.rows, position.columns) == ("3", (50, 57), ("y.gps_x", "y.gps_y"))
    assert (compass.label, compass.rows, compass.columns) == ("4", (30, 30), ("y.compass",))
    assert position.seconds == pytest.approx((5.0, 5.7)) and position.away > 20
    assert found.cells == 17 and int(found.wrong[50:58, 2, :2].sum()) == 16
    assert str(compass) == f"trajectory 4 at 3.00 s: y.compass {compass.away:.0f} sd away from all else"
    assert int(found.left.observed.sum()) == int(drives.observed.sum()) - 17


@pytest.mark.exhaustive
@pytest.mark.parametrize(("rows", "by"), [(30, 20.0), (60, 5.0), (60, 20.0)])
def test_a_long_jump_goes_and_the_good_readings_stay(boat, rows, by):
    data = st.for_program(boat, st.simulate(boat, 8, seed=1))
    wrong = found_in(boat, moved(data, (slice(50, 50 + rows), 2, 0, by))).wrong[:, 2, 0]
    assert wrong[50 : 50 + rows].all() and int(wrong.sum()) <= rows + 4


@pytest.mark.slow
def test_a_noise_that_is_declared_too_narrow_makes_none(boat, drives):
    narrow = boat.with_effect("measurement_noise:gps", 0.4).with_effect("measurement_noise:compass", 0.4)
    assert found_in(narrow, drives).found == []


@pytest.mark.exhaustive
def test_where_a_sensor_reads_anything_nothing_is_called_an_outlier(boat, drives):
    rows = torch.arange(len(drives.time)) % 60 < 10
    wild = moved(drives, *((rows, drive, 0, by) for drive, by in enumerate((40.0, -40.0, 30.0, -50.0))))
    found = found_in(boat, wild)
    assert found.found == [] and not found.wrong.any()
    assert found.note == AS_TAILS or "too many for outliers" in found.note


@pytest.mark.slow
def test_heavy_tails_are_no_outliers(boat):
    tailed = boat.with_effect("heavy_tails", 0.45)
    found = found_in(boat, st.for_program(boat, st.simulate(tailed, 8, seed=2)))
    assert found.found == [] and found.note == AS_TAILS


@pytest.mark.slow
def test_a_table_with_further_columns_loses_the_same_cells(boat, drives):
    found = found_in(boat, moved(drives, (30, 3, 2, 1.0)))
    names = ("rain", *reversed(drives.measurement_names))
    more = replace(
        drives,
        measurements=torch.cat([drives.measurements[..., :1], drives.measurements.flip(-1)], -1),
        observed=torch.cat([drives.observed[..., :1], drives.observed.flip(-1)], -1),
        measurement_names=names,
    )
    left = found.without(more)
    lost = (more.observed & ~left.observed).nonzero().tolist()
    assert lost == [[30, 3, 1]] and float(left.measurements[30, 3, 1]) == 0


def test_what_two_programs_find_wrong_is_told_as_narrow_as_it_is(drives):
    def wrong(rows: slice, columns: slice) -> Outliers:
        cells = torch.zeros_like(drives.observed)
        cells[rows, 1, columns] = True
        names = tuple(f"y.{name}" for name in drives.measurement_names[columns])
        seconds = (float(drives.elapsed[rows.start, 1]), float(drives.elapsed[rows.stop - 1, 1]))
        run = Outlier(1, drives.labels[1], (rows.start, rows.stop - 1), seconds, names, 9.0, 50.0, 5.0)
        return Outliers(drives, [run], cells)

    shared = wrong(slice(10, 21), slice(0, 3)).shared_with(wrong(slice(12, 14), slice(2, 3)))
    (one,) = shared.found
    assert (one.rows, one.columns, shared.cells) == ((12, 13), (f"y.{drives.measurement_names[2]}",), 2)
    assert one.seconds == pytest.approx((1.2, 1.3))
    assert not wrong(slice(10, 21), slice(0, 2)).shared_with(wrong(slice(12, 14), slice(2, 3))).found
