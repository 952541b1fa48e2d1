"""Trajectories from NumPy arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from steady_ppl.data import Trajectories
from steady_ppl.errors import DataError
from steady_ppl.table import from_frame


def from_arrays(drives: Sequence[Mapping[str, Any]], labels: Sequence[str] | None = None) -> Trajectories:
    """The trajectories of arrays: for each drive its columns `time`, `u.…`, `y.…` and, where known, `x.…`.

    Args:
        drives: column → `(rows,)`, or `(rows, K)` for the columns `…_0` to `…_K-1`; NaN is an empty cell.
        labels: the drives' names, 1, 2, … when not given.

    Raises:
        DataError: naming the column, the trajectory and the row.

    Example:
        >>> import numpy as np
        >>> time = np.arange(3) / 10
        >>> from_arrays([{"time": time, "u.left": 0 * time, "y.bearing": np.zeros((3, 2))}]).measurement_names
        ('bearing_0', 'bearing_1')
    """
    labels = [str(i + 1) for i in range(len(drives))] if labels is None else list(labels)
    if not drives or len(labels) != len(drives):
        raise DataError(f"arrays: got {len(drives)} drives and {len(labels)} labels")
    repeated = sorted({label for label in labels if labels.count(label) > 1})
    if repeated:
        raise DataError(f"arrays: {len(drives)} drives need {len(drives)} labels, and {repeated[0]} is there twice")
    frames = []
    for label, drive in zip(labels, drives, strict=True):
        columns: dict[str, np.ndarray] = {}
        for name, values in drive.items():
            values = np.asarray(values)
            parts = {name: values} if values.ndim < 2 else {f"{name}_{i}": part for i, part in enumerate(values.T)}
            twice = sorted(parts.keys() & columns.keys() | ({name} & {"trajectory"}))
            if twice:
                why = "is what the labels are called" if name == "trajectory" else "is there twice"
                raise DataError(f"arrays: column {twice[0]} of trajectory {label} {why}", column=twice[0])
            columns |= parts
        shapes = {name: values.shape for name, values in columns.items()}
        if len(set(shapes.values())) > 1 or any(len(shape) != 1 for shape in shapes.values()):
            told = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
            raise DataError(f"arrays: the columns of trajectory {label} differ in shape: {told}", trajectory=label)
        frames.append(pd.DataFrame({"trajectory": label} | columns))
        if set(columns) != set(frames[0].columns) - {"trajectory"}:
            raise DataError(f"arrays: trajectory {label} has other columns than {labels[0]}", trajectory=label)
    return from_frame(pd.concat(frames), name="arrays")
