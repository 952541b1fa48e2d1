"""A program, its drives and their start, which travel together."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from examples import drives, example

from steady_ppl.errors import DataError
from steady_ppl.model.problem import Problem


def test_a_known_start_must_be_given_for_every_drive() -> None:
    program = example("linear_gaussian")
    data = drives(program, 3, 9)
    states = data.states.clone()
    states[0, 1, 0] = torch.nan
    for lacking, said in ((data.without_truth(), "no x. columns"), (replace(data, states=states), "of trajectory 2")):
        assert Problem(program, lacking).known_start is False
        with pytest.raises(DataError, match=said):
            Problem(program, lacking, known_start=True)


def test_a_table_gives_no_truth_but_the_start() -> None:
    program = example("linear_gaussian")
    table = drives(program, 3, 9)
    assert Problem.of_table(program, table, known_start=False).data.states is None
    known = Problem.of_table(program, table, known_start=True)
    assert torch.equal(known.data.states[0], table.states[0]) and bool(known.data.states[1:].isnan().all())
    assert known.subset([2]).data.labels == (table.labels[2],) and known.subset([2]).known_start
