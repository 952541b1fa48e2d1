"""Trajectories: measurements, controls and, where known, the true states, padded and time-first.

Tensors are `(rows, trajectories, components)`. Lengths differ, so every tensor is padded to the longest trajectory:
time goes on at the last step, controls and measurements are zero, nothing is observed, states are NaN.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from steady_ppl.errors import DataError
from steady_ppl.utils.context import Displayed

DIGITS_OF_DIGEST = 16  # hexadecimal: two of a million trajectories are alike by chance once in ten million tables
MAX_STEP_RATIO = 1.25  # ratio of the drives' steps up to which they count as one


@dataclass(frozen=True, eq=False)
class Trajectories(Displayed):
    """`B` trajectories of at most `T + 1` rows, with `U` controls, `K` measurements and `D` state components.

    Attributes:
        time: `(T + 1, B)`, s, strictly increasing.
        controls: `(T + 1, B, U)`; row t acts from t to t + 1, so a trajectory's last row acts on nothing.
        measurements: `(T + 1, B, K)`, zero where missing.
        observed: `(T + 1, B, K)` bool, where a measurement exists.
        lengths: `(B,)` number of rows of each trajectory.
        states: `(T + 1, B, D)` the true states, NaN where unknown; None when nothing is known.
        labels: the trajectories' names, 1, 2, … where none are given.
        control_names, measurement_names, state_names: the components' names, without units.
    """

    time: Tensor
    controls: Tensor
    measurements: Tensor
    observed: Tensor
    lengths: Tensor
    states: Tensor | None = None
    labels: tuple[str, ...] = ()
    control_names: tuple[str, ...] = ()
    measurement_names: tuple[str, ...] = ()
    state_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.labels:
            object.__setattr__(self, "labels", tuple(str(i + 1) for i in range(self.time.shape[1])))

    def __len__(self) -> int:
        return self.time.shape[1]

    def __repr__(self) -> str:
        return (
            f"Trajectories({len(self)} of {int(self.lengths.min())}–{int(self.lengths.max())} rows, "
            f"controls {list(self.control_names)}, measurements {list(self.measurement_names)} "
            f"({int((~self.observed[self.rows]).sum())} missing), "
            f"states {list(self.state_names) if self.states is not None else 'unknown'})"
        )

    @property
    def digests(self) -> tuple[str, ...]:
        """A hash of what was measured on each trajectory and under which controls, the same in any table."""
        found = []
        for index, length in enumerate(self.lengths.tolist()):
            acting = self.controls[: length - 1, index].float()
            parts = [acting, self.measurements[:length, index].float(), self.observed[:length, index]]
            content = b"".join(part.numpy(force=True).tobytes() for part in parts)
            found.append(hashlib.sha256(content).hexdigest()[:DIGITS_OF_DIGEST])
        return tuple(found)

    @property
    def rows(self) -> Tensor:
        """`(T + 1, B)` bool: the rows that belong to a trajectory, not to its padding."""
        return torch.arange(self.time.shape[0], device=self.time.device)[:, None] < self.lengths

    @property
    def transitions(self) -> Tensor:
        """`(T, B)` bool: the intervals that belong to a trajectory."""
        return self.rows[1:]

    @property
    def steps(self) -> Tensor:
        """`(T, B)` the length of each interval, s; the difference is taken in double precision."""
        return self.time.diff(dim=0).to(self.controls.dtype)

    @property
    def median_step(self) -> float:
        """Of all intervals, s; in double precision."""
        return float(self.time.diff(dim=0)[self.transitions].median())

    def rows_ahead(self, seconds: float) -> int:
        """How many rows make up a time, at the median step of all trajectories."""
        return round(seconds / self.median_step)

    @property
    def uneven_steps(self) -> list[str]:
        """What to say of times ahead where trajectories are sampled at different rates; they are counted in rows."""
        steps = torch.where(self.transitions, self.time.diff(dim=0), torch.nan).nanmedian(0).values
        least, most = float(steps.min()), float(steps.max())
        if most < MAX_STEP_RATIO * least:
            return []
        return [
            f"the trajectories' steps differ, {least:.3g} to {most:.3g} s: a time ahead is so many rows of "
            f"{self.median_step:.3g} s in each of them; bring the table to one step, or judge its parts by themselves"
        ]

    @property
    def elapsed(self) -> Tensor:
        """`(T + 1, B)` seconds since each trajectory's first row."""
        return (self.time - self.time[0]).to(self.controls.dtype)

    @property
    def known_start(self) -> Tensor:
        """See `require_known_start`."""
        return self.require_known_start()

    def require_known_start(self) -> Tensor:
        """The true first states, `(B, D)`; DataError where they are not all known."""
        if self.states is None:
            wanted = "the true states of every trajectory's first row"
            raise DataError(f"a known start needs {wanted}: the table has no x. columns")
        for trajectory, component in (~torch.isfinite(self.states[0])).nonzero()[:1].tolist():
            column, label = f"x.{self.state_names[component]}", self.labels[trajectory]
            problem = f"a known start needs every trajectory's first state: {column} of trajectory {label} is empty"
            raise DataError(problem, column=column, trajectory=label, row=1)
        return self.states[0]

    def subset(self, index: Sequence[int] | Tensor) -> Trajectories:
        """The trajectories at `index`, still padded to the same number of rows."""
        index = torch.as_tensor(index, dtype=torch.long, device=self.time.device)
        chosen = self.with_rows(lambda rows: rows[:, index])
        return replace(chosen, lengths=self.lengths[index], labels=tuple(self.labels[int(i)] for i in index))

    def with_rows(self, change: Callable[[Tensor], Tensor]) -> Trajectories:
        """The same with every tensor of rows changed."""
        names = ("time", "controls", "measurements", "observed", "states")
        rows = {name: getattr(self, name) for name in names}
        changed: dict[str, Any] = {name: change(values) for name, values in rows.items() if values is not None}
        return replace(self, **changed)

    def observed_every(self, stride: int) -> Trajectories:
        """Keep the measurements of rows 1, 1 + stride, … only; every row stays (10 turns 10 Hz into 1 Hz)."""
        keep = (torch.arange(self.time.shape[0], device=self.time.device) % stride == 0)[:, None, None]
        return replace(self, observed=self.observed & keep)

    def without(self, cells: Tensor) -> Trajectories:
        """The same without some measured cells, `(T + 1, B, K)` bool."""
        observed = self.observed & ~cells
        return replace(self, observed=observed, measurements=torch.where(observed, self.measurements, 0.0))

    def continued(self, controls: Tensor, step: float | None = None) -> Trajectories:
        """The trajectories with rows after their ends in which nothing is measured: what is planned, to be forecast.

        Args:
            controls: `(H, U)` for all trajectories, or `(H, B, U)`; the first acts from each trajectory's last row on.
            step: s between the new rows; the median step when None.

        Raises:
            DataError: other numbers of trajectories or controls than the table has, or no step forward in time.
        """
        step = self.median_step if step is None else step
        plan = torch.as_tensor(controls).to(self.controls)
        plan = plan.unsqueeze(1).expand(-1, len(self), -1) if plan.dim() == 2 else plan
        if plan.dim() != 3 or not len(plan) or plan.shape[1:] != self.controls.shape[1:]:
            width, names = self.controls.shape[-1], ", ".join(self.control_names) or "no control"
            wanted = f"expected (rows, {width}) or (rows, {len(self)}, {width}), for {names}"
            raise DataError(f"planned controls of shape {tuple(controls.shape)}: {wanted}")
        if not 0 < step < math.inf:
            raise DataError(f"step must be positive, got {step} s")
        later = step * torch.arange(1, len(plan) + 1, dtype=self.time.dtype, device=self.time.device)
        ends = self.lengths.tolist()

        def continued(values: Tensor, fill: float = 0.0) -> Tensor:
            rest = values.new_full((len(plan), *values.shape[2:]), fill)
            return pad([torch.cat([values[:end, b], rest]) for b, end in enumerate(ends)], fill)

        last = plan.new_zeros(1, plan.shape[-1])
        acting = [torch.cat([self.controls[: end - 1, b], plan[:, b], last]) for b, end in enumerate(ends)]
        times = [torch.cat([self.time[:end, b], self.time[end - 1, b] + later]) for b, end in enumerate(ends)]
        return replace(
            self,
            time=pad_time(times),
            controls=pad(acting),
            measurements=continued(self.measurements),
            observed=continued(self.observed, False),
            lengths=self.lengths + len(plan),
            states=None if self.states is None else continued(self.states, torch.nan),
        )

    def without_truth(self, *, keep_start: bool = False) -> Trajectories:
        """Forget the true states, or all but each trajectory's first."""
        if not keep_start or self.states is None:
            return replace(self, states=None)
        states = torch.full_like(self.states, torch.nan)
        states[0] = self.states[0]
        return replace(self, states=states)

    def to(self, like: torch.dtype | None = None, device: torch.device | str | None = None) -> Trajectories:
        """Cast to a floating dtype and move to a device; `time`, from zero, stays in double precision."""

        def cast(tensor: Tensor) -> Tensor:
            return tensor.to(device=device, dtype=like if tensor.is_floating_point() else None)

        time = (self.time - self.time[0]).to(device=device)
        return replace(self.with_rows(cast), time=time, lengths=cast(self.lengths))

    def select(self, controls: Sequence[str], measurements: Sequence[str], states: Sequence[str]) -> Trajectories:
        """The named columns in order, unknown states NaN; DataError names missing controls or measurements."""
        columns = (("u", controls, self.control_names), ("y", measurements, self.measurement_names))
        said, missing = [], list[str]()
        for prefix, wanted, have in columns:
            lacking = [f"{prefix}.{name}" for name in wanted if name not in have]
            there = ", ".join(f"{prefix}.{name}" for name in have) or f"no {prefix}. column"
            said += [f"no column {', '.join(lacking)}; it has {there}"] if lacking else []
            missing += lacking
        if missing:
            raise DataError(f"the table has {', and '.join(said)}", column=missing[0])
        chosen_controls, chosen = ([have.index(name) for name in wanted] for _, wanted, have in columns)
        truth = None
        if self.states is not None and any(name in self.state_names for name in states):
            known = dict(zip(self.state_names, self.states.unbind(-1), strict=True))
            unknown = torch.full_like(self.states[..., 0], torch.nan)
            truth = torch.stack([known.get(name, unknown) for name in states], -1)
        return replace(
            self,
            controls=self.controls[..., chosen_controls],
            measurements=self.measurements[..., chosen],
            observed=self.observed[..., chosen],
            states=truth,
            control_names=tuple(controls),
            measurement_names=tuple(measurements),
            state_names=tuple(states),
        )


def pad(columns: Sequence[Tensor], fill: float = 0.0) -> Tensor:
    """Stack `B` tensors of shapes `(rows_b, ·)` into `(T + 1, B, ·)`, filled up with `fill`."""
    return pad_sequence(list(columns), padding_value=fill)


def pad_time(times: Sequence[Tensor]) -> Tensor:
    """Stack `B` vectors of times into `(T + 1, B)`, going on at each one's last step."""
    longest = max(len(time) for time in times)
    out = times[0].new_empty((longest, len(times)))
    for i, time in enumerate(times):
        extra = torch.arange(1, longest - len(time) + 1, dtype=time.dtype, device=time.device)
        out[:, i] = torch.cat([time, time[-1] + extra * (time[-1] - time[-2])])
    return out


def concatenated(**tables: Trajectories) -> Trajectories:
    """The trajectories of several tables by name, one after another; DataError where their columns differ.

    Where two trajectories have the same label, every label gets the name of its table before it.
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

    def drives(name: str) -> list[Tensor]:
        """What each trajectory of each table has there, without padding."""
        return [getattr(part, name)[:rows, i] for part in parts for i, rows in enumerate(part.lengths.tolist())]

    return replace(
        parts[0],
        time=pad_time(drives("time")),
        controls=pad(drives("controls")),
        measurements=pad(drives("measurements")),
        observed=pad(drives("observed"), False),
        lengths=torch.cat([part.lengths for part in parts]),
        states=pad(drives("states"), torch.nan) if all(part.states is not None for part in parts) else None,
        labels=tuple(labels),
    )
