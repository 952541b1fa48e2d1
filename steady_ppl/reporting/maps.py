"""Where, when and in which regime a program fails, with a place to look at for every cell."""

from __future__ import annotations

from typing import Any

import numpy as np

from steady_ppl.check_pictures import subject
from steady_ppl.criticism.residual_maps import Cell
from steady_ppl.criticism.result import Check, place, sentence
from steady_ppl.model.program import names
from steady_ppl.reporting.packing import packed

AROUND = 0.5  # s shown before and after a stretch
Place = tuple[int, float, float]  # drive, and from when to when


def maps(found: Check) -> dict[str, Any]:
    """The strips (residual × drive × time), the regimes (residual × range) and the findings, strongest first."""
    return {
        "residuals": [subject(found, i) for i in range(len(found.residuals))],
        "strips": _strips(found),
        "regimes": _regimes(found),
        "findings": [
            {"text": sentence(found, one), "z": one.z, "place": where_to_look(found, one.cell)}
            for one in found.misfit.significant
        ],
    }


def _strips(found: Check) -> dict[str, Any] | None:
    cells = [(i, cell) for i, cell in enumerate(found.misfit.cells) if cell.map == "drive and time"]
    if not cells:
        return None
    ranges = sorted({cell.where["time"] for _, cell in cells})
    z = np.full((len(found.residuals), len(found.data), len(ranges)), np.nan)
    for i, cell in cells:
        z[cell.residual, cell.where["drive"], ranges.index(cell.where["time"])] = found.misfit.z[i]
    significant = [
        [one.cell.residual, one.cell.where["drive"], ranges.index(one.cell.where["time"])]
        for one in found.misfit.significant
        if one.cell.map == "drive and time"
    ]
    return {
        "edges": [start for start, _ in ranges] + [ranges[-1][1]],
        "drives": list(found.data.labels),
        "z": packed(z),
        "significant": significant,
    }


def _regimes(found: Check) -> dict[str, Any]:
    """The ranges of every variable as columns, and of each residual its mean in them, in simulated standard deviations.

    A cell is: residual, column, mean, whether it stands out, and the place to look at.
    """
    columns: dict[tuple, dict[str, Any]] = {}
    cells: list[list[Any]] = []
    significant = {id(one.cell) for one in found.misfit.significant}
    regimes = [(i, cell) for i, cell in enumerate(found.misfit.cells) if cell.map == "regime"]
    variables = list(dict.fromkeys(variable for _, cell in regimes for variable in cell.where))
    for _, cell in sorted(regimes, key=lambda one: [(variables.index(v), b) for v, b in one[1].where.items()]):
        ((variable, between),) = cell.where.items()
        columns.setdefault((variable, between), {"variable": variable, "where": place(found, cell).strip()})
    order = list(columns)
    for i, cell in regimes:
        ((variable, between),) = cell.where.items()
        z = round(float(found.misfit.z[i]), 2)
        column = order.index((variable, between))
        cells.append([cell.residual, column, z, id(cell) in significant, where_to_look(found, cell)])
    return {"columns": list(columns.values()), "cells": cells}


def where_to_look(found: Check, cell: Cell) -> Place | None:
    """The drive and the seconds that add most to a cell; None where it is of no place."""
    if cell.map in ("lag", "memory"):
        return None
    there, values = _rows(found, cell)
    if not there.any():
        return None
    total = np.where(there, values, 0.0).sum(0)
    pull = total * np.sign(total.sum() or 1.0) / np.sqrt(np.maximum(there.sum(0), 1))
    drive = int(cell.where.get("drive", np.argmax(np.where(there.any(0), pull, -np.inf))))
    start, end = cell.where["time"] if "time" in cell.where else _longest(there[:, drive], found, drive)
    if cell.map in ("all", "drive"):
        start, end = 0.0, float(found.data.elapsed[int(found.data.lengths[drive]) - 1, drive])
    return drive, round(max(0.0, start - AROUND), 3), round(end + AROUND, 3)


def _rows(found: Check, cell: Cell) -> tuple[np.ndarray, np.ndarray]:
    """Which intervals a cell is an average over, and the residual there, `(T, B)` each."""
    residuals = found.standardised
    there = residuals.there[0, ..., cell.residual].copy()
    elapsed = found.data.elapsed[:-1].numpy(force=True)
    for name, value in cell.where.items():
        if name == "drive":
            there &= np.arange(there.shape[1]) == value
        else:
            at = elapsed if name == "time" else _variable(found, name)
            there &= (at >= value[0]) & (at <= value[1])
    return there, residuals.values[0, ..., cell.residual]


def _variable(found: Check, name: str) -> np.ndarray:
    controls = names(found.program.controls)
    if name in controls:
        return found.data.controls[:-1, :, controls.index(name)].double().numpy(force=True)
    return found.standardised.variables[name][0]


def _longest(there: np.ndarray, found: Check, drive: int) -> tuple[float, float]:
    """Seconds of the longest stretch in which all rows count."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(int)))
    starts, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - starts))
    elapsed = found.data.elapsed[:, drive]
    return float(elapsed[starts[longest]]), float(elapsed[min(ends[longest], len(elapsed) - 1)])
