"""Several tables as one."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from examples import example

import steady_ppl as st
from steady_ppl.data.trajectories import concatenated


def table(drives: int, rows: int, seed: int) -> st.Trajectories:
    program = example("hovercraft")
    program.duration = (rows - 1) * program.step
    return st.simulate(program, drives, seed=seed)


def test_every_drive_is_as_it_was() -> None:
    short, long = table(2, 11, 1), table(3, 21, 2)
    both = concatenated(train=short, valid=long)
    assert len(both) == 5 and both.lengths.tolist() == [11, 11, 21, 21, 21]
    assert both.labels == ("train 1", "train 2", "valid 1", "valid 2", "valid 3")
    for i, (part, drive) in enumerate([(short, 0), (short, 1), (long, 0), (long, 1), (long, 2)]):
        rows = int(part.lengths[drive])
        for name in ("controls", "measurements", "observed", "states"):
            assert torch.equal(getattr(both, name)[:rows, i], getattr(part, name)[:rows, drive]), name
        assert torch.equal(both.time[:rows, i], part.time[:rows, drive])
    assert not both.observed[11:, :2].any() and both.states[11:, :2].isnan().all()
    assert (both.time.diff(dim=0) > 0).all()


def test_labels_stay_where_they_differ() -> None:
    one, other = table(1, 5, 1), replace(table(1, 5, 2), labels=("b",))
    assert concatenated(train=one, valid=other).labels == ("1", "b")


def test_states_are_known_where_all_tables_know_them() -> None:
    assert concatenated(train=table(1, 5, 1), valid=table(1, 5, 2).without_truth()).states is None


def test_tables_of_other_columns_are_refused() -> None:
    other = replace(table(1, 5, 2), control_names=("speed", "turn"))
    with pytest.raises(st.DataError, match="other controls: left, right and, in valid, speed, turn"):
        concatenated(train=table(1, 5, 1), valid=other)
