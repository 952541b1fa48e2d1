"""A small table as text and as tensors, and tables equal bit for bit."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path

import torch

from steady_ppl.data.trajectories import Trajectories

SUFFIXES = ("csv", "parquet")
GOOD = """\
trajectory,time,u.left,y.bearing,y.range,x.x
b,0.0,1.0,0.5,,10.0
b,0.1,1.5,,2.0,
b,0.3,,0.7,2.5,
a,5.0,2.0,0.1,3.0,20.0
a,5.5,2.5,0.2,3.5,21.0
"""


def write(folder: Path, text: str, name: str = "drives.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def same(a: Trajectories, b: Trajectories) -> None:
    """Equal bit for bit, names and shapes included."""
    for field in fields(Trajectories):
        left, right = getattr(a, field.name), getattr(b, field.name)
        if not isinstance(left, torch.Tensor):
            assert left == right, field.name
            continue
        assert left.dtype == right.dtype and left.shape == right.shape, field.name
        if left.is_floating_point():
            empty = left.isnan()
            assert torch.equal(empty, right.isnan()), field.name
            left, right = (t.masked_fill(empty, 0.0).contiguous().view(torch.int64) for t in (left, right))
        assert torch.equal(left, right), field.name


def example(truth: bool = True) -> Trajectories:
    """Two trajectories of 3 and 2 rows, as GOOD spells them."""
    return Trajectories(
        time=torch.tensor([[0.0, 5.0], [0.1, 5.5], [0.3, 6.0]], dtype=torch.float64),
        controls=torch.tensor([[[1.0], [2.0]], [[1.5], [2.5]], [[0.0], [0.0]]], dtype=torch.float64),
        measurements=torch.tensor(
            [[[0.5, 0.0], [0.1, 3.0]], [[0.0, 2.0], [0.2, 3.5]], [[0.7, 2.5], [0.0, 0.0]]], dtype=torch.float64
        ),
        observed=torch.tensor([[[1, 0], [1, 1]], [[0, 1], [1, 1]], [[1, 1], [0, 0]]], dtype=torch.bool),
        lengths=torch.tensor([3, 2]),
        states=torch.tensor([[[10.0], [20.0]], [[math.nan], [21.0]], [[math.nan], [math.nan]]], dtype=torch.float64)
        if truth
        else None,
        labels=("b", "a"),
        control_names=("left",),
        measurement_names=("bearing", "range"),
        state_names=("x",) if truth else (),
    )
