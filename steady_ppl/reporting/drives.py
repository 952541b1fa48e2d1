"""What the page shows of drives: maps of misfit, and some drives row by row, packed."""

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from steady_ppl.comparison.evaluate import has_truth
from steady_ppl.criticism.residual_maps import Cell
from steady_ppl.criticism.result import Check, band, measured_values, place, strips, subject
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.model.program import Program, names, units
from steady_ppl.runs.fit import Fit
from steady_ppl.runs.posterior import INTERVAL_QUANTILES, drawn_states
from steady_ppl.utils.angles import nearest_turn

MARGIN_SECONDS = 0.5  # shown before and after a stretch
MAX_CODE, MISSING_CODE = 65534, -32768  # codes of sixteen bits, which are finer than a screen
MAX_PACKED_NUMBERS = 300_000  # of all drives and runs: .8 MB of text
PATHS_SHOWN = 8  # draws in the plane


def _strips(found: Check) -> dict[str, Any] | None:
    """Residual × drive × time."""
    times, z = strips(found)
    if not times:
        return None
    significant = [one.cell for one in found.misfit.significant if one.cell.map == "drive and time"]
    return {
        "edges": [start for start, _ in times] + [times[-1][1]],
        "drives": list(found.data.labels),
        "z": in_sixteen_bits(z),
        "significant": [[one.residual, one.where["drive"], times.index(one.where["time"])] for one in significant],
    }


def _regimes(found: Check) -> dict[str, Any]:
    """The ranges of every variable as columns, and of each residual its mean in them, in simulated standard deviations.

    A cell is: residual, column, mean, whether it stands out, and the place to look at.
    """
    significant = {id(one.cell) for one in found.misfit.significant}
    regimes = found.misfit.of_map("regime")
    keys = [next(iter(cell.where.items())) for cell, _ in regimes]
    variables = list(dict.fromkeys(variable for variable, _ in keys))
    order = sorted(set(keys), key=lambda key: (variables.index(key[0]), key[1]))
    words = {key: place(found, cell).strip() for key, (cell, _) in zip(keys, regimes, strict=True)}
    return {
        "columns": [{"variable": key[0], "where": words[key]} for key in order],
        "cells": [
            [cell.residual, order.index(key), round(z, 2), id(cell) in significant, where_to_look(found, cell)]
            for key, (cell, z) in zip(keys, regimes, strict=True)
        ],
    }


def where_to_look(found: Check, cell: Cell) -> tuple[int, float, float] | None:
    """The drive, and from when to when, s, that adds most to a cell; None where it is of no place."""
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
    return drive, round(max(0.0, start - MARGIN_SECONDS), 3), round(end + MARGIN_SECONDS, 3)


def _rows(found: Check, cell: Cell) -> tuple[np.ndarray, np.ndarray]:
    """Which intervals a cell is an average over, and the residual there, `(T, B)` each."""
    data, residuals = found.data, found.standardised
    variables = {name: values[0] for name, values in residuals.variables.items()}
    for i, name in enumerate(found.program.control_names):
        variables[name] = data.controls[:-1, :, i].double().numpy(force=True)
    there = residuals.there[0, ..., cell.residual].copy()
    variables |= {"time": data.elapsed[:-1].numpy(force=True), "drive": np.arange(there.shape[1])}
    for name, value in cell.where.items():
        low, high = (value, value) if name == "drive" else value
        there &= (variables[name] >= low) & (variables[name] <= high)
    return there, residuals.values[0, ..., cell.residual]


def _longest(there: np.ndarray, found: Check, drive: int) -> tuple[float, float]:
    """Seconds of the longest stretch in which all rows count."""
    edges = np.flatnonzero(np.diff(there.astype(int), prepend=0, append=0))
    starts, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - starts))
    elapsed = found.data.elapsed[:, drive]
    return float(elapsed[starts[longest]]), float(elapsed[min(ends[longest], len(elapsed) - 1)])


def in_sixteen_bits(values: Any) -> dict[str, Any]:
    """An array of any shape as base64 of little-endian 16-bit integers, `low + step (code + 32767)`.

    A number that is not finite is missing; it has a code of its own.
    """
    values = np.asarray(values, float)
    known = np.isfinite(values)
    low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
    step = (high - low) / MAX_CODE or 1.0
    codes = np.where(known, np.round((np.where(known, values, low) - low) / step) - MAX_CODE // 2, MISSING_CODE)
    text = base64.b64encode(codes.astype("<i2").tobytes()).decode()
    return {"shape": list(values.shape), "low": low, "step": step, "data": text}


@dataclass(frozen=True)
class Shown:
    """Which drives a report has row by row."""

    drives: list[int]  # their numbers, in the table's order
    every: int  # one row of so many
    total: int  # how many drives the table has

    @property
    def note(self) -> str | None:
        """What is left out, in words."""
        said = []
        if len(self.drives) < self.total:
            said.append(f"{len(self.drives)} of {self.total} trajectories, those with the strongest misfits")
        if self.every > 1:
            said.append(f"every {self.every}th row")
        return f"The curves show {' and '.join(said)}; the maps and figures are of all." if said else None

    def of(self, values: Any) -> dict[str, Any]:
        """`(rows, B, ·)` as `(drives, ·, rows)`, packed."""
        return in_sixteen_bits(np.asarray(values)[:: self.every, self.drives].transpose(1, 2, 0))


def chosen_drives(checks: list[Check], numbers: int = MAX_PACKED_NUMBERS) -> Shown:
    """As many drives as there is room for, those whose strips stand out most in any run first."""
    first = checks[0]
    rows, count = first.data.time.shape
    columns = sum(_columns(one) for one in checks) + 1 + len(first.program.control_names)
    every = max(1, -(-rows * columns // numbers))
    room = max(1, numbers // (-(-rows // every) * columns))
    worst = np.max([np.abs(np.nan_to_num(strips(one)[1])).max((0, 2), initial=0.0) for one in checks], 0)
    return Shown(sorted(np.argsort(-worst, kind="stable")[:room].tolist()), every, count)


def _columns(found: Check) -> int:
    """Numbers of a row of a drive that a run adds."""
    horizons, states = min(2, len(found.horizons)), len(found.program.state_names)
    return 2 * horizons * len(found.residuals) + len(found.program.measurement_names) + 4 * states + 2 * PATHS_SHOWN


def common_data(found: Check, shown: Shown) -> dict[str, Any]:
    """What is the same for every run: the time and the controls, of which a drive's last is followed by nothing."""
    data = found.data
    acting = torch.cat([data.transitions, torch.zeros_like(data.transitions[:1])])
    return {
        "labels": [data.labels[i] for i in shown.drives],
        "shown": shown.drives,
        "time": shown.of(_where(data.rows, data.elapsed.unsqueeze(-1))),
        "controls": shown.of(_where(acting, data.controls)),
        "controlNames": _components(found.program.controls),
    }


def data_of_run(found: Check, fit: Fit, table: Trajectories, shown: Shown, *, draws: int, seed: int) -> dict[str, Any]:
    """Measurements, predictions with their bands, quantiles of the posterior of the states given all measurements, the
    truth, where the table has it, and the maps of misfit; a run's components are its program's, in their order."""
    bands = {name: map(shown.of, band(found, name)) for name in ("one step", list(found.horizons)[-1])}
    data = found.data.subset(shown.drives)
    posterior = drawn_states(fit.program, data, draws=draws, known_start=fit.known_start, seed=seed)["posterior"]
    states = found.program.state_names
    by_state = [posterior[name].quantile(INTERVAL_QUANTILES, ("chain", "draw"), skipna=False).values for name in states]
    quantiles = np.stack(by_state, -1).swapaxes(1, 2)  # (3, rows, B, D)
    all_of_them = Shown(list(range(len(data))), shown.every, len(data))
    across = [states[i] for i in plane(found.program)]
    paths = [posterior[name].values[0, draw].T for draw in range(min(PATHS_SHOWN, draws)) for name in across]
    truth = _truth(found.program, table.subset(shown.drives), quantiles[1])
    return {
        "measurements": _components(found.program.measurements),
        "measured": shown.of(measured_values(found)),
        "truth": None if truth is None else all_of_them.of(truth),
        "predictions": [{"ahead": name, "middle": middle, "half": half} for name, (middle, half) in bands.items()],
        "states": _components(found.program.states),
        "posterior": dict(zip(("low", "middle", "high"), map(all_of_them.of, quantiles), strict=True)),
        "plane": plane(found.program),
        "paths": all_of_them.of(np.stack(paths, -1)),
        "residuals": [subject(found, i) for i in range(len(found.residuals))],
        "strips": _strips(found),
        "regimes": _regimes(found),
    }


def plane(program: Program) -> list[int]:
    """Two state components that make a map: a pair that errors are counted together for, else a phase plane."""
    order = program.state_names
    pairs = [tuple(group) for group in program.error_groups.values() if len(group) == 2]
    pairs += [tuple(pair) for pair in program.motion.values()] + [order[:2]]
    return [order.index(name) for name in next(pair for pair in pairs if all(name in order for name in pair))]


def _components(declared: Any) -> list[dict[str, str]]:
    return [{"name": name, "unit": unit} for name, unit in zip(names(declared), units(declared), strict=True)]


def _truth(program: Program, table: Trajectories, middle: np.ndarray) -> np.ndarray | None:
    """The true states `(rows, B, D)`, angles on the turn of the posterior's median; None where there are but starts."""
    data = table.select(program.control_names, program.measurement_names, program.state_names)
    if data.states is None or not has_truth(data):
        return None
    found = data.states.double().numpy(force=True).copy()
    for index in program.angle_indices:
        found[..., index] = nearest_turn(found[..., index], middle[..., index])
    return found


def _where(there: torch.Tensor, values: torch.Tensor) -> np.ndarray:
    return np.where(there.unsqueeze(-1).numpy(force=True), values.numpy(force=True), np.nan)
