"""What `discover` is given and refuses, tables that it mixes, and faults and interrupts on its way."""

from __future__ import annotations

import pytest
import torch
from examples import drives, example
from planted_drives import SETS, tables

import steady_ppl as st
from steady_ppl.discovery import discover as module
from steady_ppl.discovery.curves import knots_of
from steady_ppl.discovery.discover import COMPARING, _afterwards, _searched
from steady_ppl.discovery.search import Search


def test_a_sensor_that_failed_on_all_training_drives_is_no_obstacle():
    program = example("pendulum", torch.float32)
    train, valid = tables(program)
    train.observed[:] = False
    train.observed[0] = True
    with pytest.raises(st.DataError, match="no measurements after their first rows"):
        st.discover(program, train, valid, simulations=SETS)
    assert knots_of(torch.zeros(0), circular=False) is None


@pytest.mark.slow
@pytest.mark.parametrize(("withheld", "says"), [(["linaer_drag"], "did you mean linear_drag"), ("wind", "a list of")])
def test_what_is_withheld_is_an_effect(withheld, says):
    program = example("hovercraft")
    with pytest.raises(st.UsageError, match=says):
        st.discover(program, st.simulate(program, 10), withheld=withheld)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("only", "says"), [(["physics"], "there are dynamics, actuator, sensor, noise"), ("noise", "list")]
)
def test_what_is_looked_for_is_a_kind(only, says):
    program = example("hovercraft")
    with pytest.raises(st.UsageError, match=says):
        st.discover(program, st.simulate(program, 10), only=only)


@pytest.mark.slow
def test_mixed_tables_are_one_and_every_second_drive_chooses() -> None:
    program = example("hovercraft", torch.float32)
    train, valid = drives(program, 6, 21, seed=1), drives(program, 5, 21, seed=2)
    found = st.discover(program, train, valid, known_start=True, mix=True, simulations=50)
    first, second = found.search.base.folds
    assert first.drives.labels == ("train 1", "train 3", "train 5", "valid 1", "valid 3", "valid 5")
    assert second.drives.labels == ("train 2", "train 4", "train 6", "valid 2", "valid 4")
    assert "the tables were mixed: 5 of the 11 trajectories were kept to choose by" in found.notes
    with pytest.raises(st.UsageError, match="mix puts two tables together"):
        st.discover(program, train, known_start=True, mix=True)


def test_an_interrupt_after_the_search_leaves_it_complete():
    def interrupted():
        raise KeyboardInterrupt

    search, notes = Search(None, base=None, final=None, step=None, gained=0.0), []
    assert _afterwards(lambda: 3, search, COMPARING, notes) == 3 and not search.interrupted
    assert _afterwards(interrupted, search, COMPARING, notes) is None
    assert search.interrupted == COMPARING and not search.cut_short
    assert _afterwards(interrupted, search, "a later part", notes) is None and notes == []
    assert search.interrupted == COMPARING


@pytest.mark.parametrize(
    ("error", "raised"),
    [
        (ZeroDivisionError("by the tide"), st.FilterError),
        (st.DataError("no tide"), st.DataError),
        (KeyError(1), KeyError),
    ],
)
def test_a_fault_of_numbers_before_the_first_tests_is_a_line(monkeypatch, error, raised):
    def fails(*_):
        raise error

    monkeypatch.setattr(module, "search", fails)
    with pytest.raises(raised) as caught:
        _searched(None, None, None)
    if isinstance(error, ZeroDivisionError):
        assert str(caught.value) == "the model cannot be searched on these trajectories: ZeroDivisionError: by the tide"
