"""Several tables as one."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from steady_ppl.data import Trajectories, pad, pad_time
from steady_ppl.errors import DataError


def joined(**tables: Trajectories) -> Trajectories:
    """The trajectories of several tables, one table after another; where two have the same label, every label gets the
    name of its table before it.

    Args:
        tables: by name, with the same controls, measurements and states.

    Raises:
        DataError: their columns differ.
    """
    parts = list(tables.values())
    for name, part in tables.items():
        for what in ("control_names", "measurement_names", "state_names"):
            own, first = getattr(part, what), getattr(parts[0], what)
            if own != first:
                kind = what.removesuffix("_names")
                raise DataError(f"the tables have other {kind}s: {', '.join(first)} and, in {name}, {', '.join(own)}")
    labels = [label for part in parts for label in part.labels]
    if len(set(labels)) < len(labels):
        labels = [f"{name} {label}" for name, part in tables.items() for label in part.labels]
    known = all(part.states is not None for part in parts)
    return replace(
        parts[0],
        time=pad_time([column for part in parts for column in _columns(part, part.time)]),
        controls=_stacked(parts, "controls"),
        measurements=_stacked(parts, "measurements"),
        observed=_stacked(parts, "observed"),
        lengths=torch.cat([part.lengths for part in parts]),
        states=_stacked(parts, "states", torch.nan) if known else None,
        labels=tuple(labels),
    )


def _columns(part: Trajectories, values: Tensor) -> list[Tensor]:
    return [values[: int(length), i] for i, length in enumerate(part.lengths)]


def _stacked(parts: list[Trajectories], name: str, fill: float = 0.0) -> Tensor:
    return pad([column for part in parts for column in _columns(part, getattr(part, name))], fill)
