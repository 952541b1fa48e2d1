"""The next run: controls under which the members of a class would differ most."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.discovery.candidates import Candidate
from steady_ppl.discovery.refits import Refit, wide, wide_drives
from steady_ppl.discovery.search import Found
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.predict import simulate_again
from steady_ppl.gaussian.smoother import smooth
from steady_ppl.model.program import Program
from steady_ppl.utils.random import seeded

DRIVES = 24  # simulated for each proposal
TYPES = 3  # of every way of driving


@dataclass(frozen=True)
class NextRun:
    """Controls to drive next.

    Attributes:
        between: the class.
        way: how they are made, in words.
        controls: control → its values, one a row.
        step: s, of a row.
        separation: nats of log p(y) by which one such drive tells the first member of the class from the nearest other.
        usual: the same of the drives that there are.
    """

    between: list[str]
    way: str
    controls: dict[str, list[float]]
    step: float
    separation: float
    usual: float


@torch.no_grad()
def next_run(found: Found, known_start: bool, seed: int) -> NextRun | None:
    """The best of some ways of driving within the limits of the controls that were driven, None where none separates
    the class better than the drives that there are.

    Each is simulated with the best member of the class; the others are judged by how much less likely they find it.

    Args:
        found: an effect whose class has several members.
        known_start: the first states are certain.
        seed: of the ways that are random, and of the simulations.
    """
    members = [c for c in found.alike if isinstance(c.refit, Refit)]
    data = members[0].refit.folds[0].drives  # type: ignore[union-attr]
    usual = _separation(members, data.controls, data, known_start, seed)
    better = []
    for way, controls in _ways(data, seed):
        apart = _separation(members, controls.unsqueeze(1).expand_as(data.controls), data, known_start, seed)
        if math.isfinite(apart) and apart > max(0.0, usual):
            better.append((apart, way, controls))
    if not better:
        return None
    separation, way, controls = max(better, key=lambda one: one[0])
    order = members[0].refit.program.control_names  # type: ignore[union-attr]
    return NextRun(
        between=[member.variant.name for member in members],
        way=way,
        controls={name: [round(v, 4) for v in controls[:, i].tolist()] for i, name in enumerate(order)},
        step=data.median_step,
        separation=separation,
        usual=usual if math.isfinite(usual) else 0.0,
    )


def _separation(members: list[Candidate], controls: Tensor, data: Trajectories, known_start: bool, seed: int) -> float:
    """Nats a drive by which the first member is told from the nearest other."""
    count = min(DRIVES, len(data))
    drives = replace(data.subset(range(count)), controls=controls[:, :count].contiguous())
    first = members[0].refit
    assert isinstance(first, Refit)
    program, path = first.judges.programs[0], first.folds[0].path
    starts = path.states[0, :count].unsqueeze(0)
    with seeded(seed, "next run"):
        again, truth = simulate_again(program, drives, starts, len(program.channels))
    own = _log_likelihood(program, again, truth, known_start)
    apart = []
    for member in members[1:]:
        assert isinstance(member.refit, Refit)
        apart.append(float((own - _log_likelihood(member.refit.judges.programs[0], again, truth, known_start)).mean()))
    return min(apart) if all(map(math.isfinite, apart)) else math.nan


def _log_likelihood(program: Program, drives: Trajectories, path: ReferencePath, known_start: bool) -> Tensor:
    states = path.states[..., : len(program.states)]
    fitting = replace(drives, states=None if drives.states is None else drives.states[..., : len(program.states)])
    near = wide(ReferencePath(states, path.noise), program)
    return smooth(program, wide_drives(fitting, program), near, known_start=known_start, passes=4).log_likelihood


def _ways(data: Trajectories, seed: int) -> Iterator[tuple[str, Tensor]]:
    """Ways of driving: held, stepped and swept between the limits that were driven."""
    driven = data.controls[:-1][data.transitions]
    low, high = driven.amin(0), driven.amax(0)
    rows, count = len(data.controls), driven.shape[-1]
    time = torch.arange(rows).to(driven) / max(1, rows - 1)
    middle = (low + high) / 2
    with seeded(seed, "ways of driving"):
        for index in range(TYPES):
            held = torch.where(torch.rand(count) < 0.5, low, high)
            yield f"hold {index + 1}: one level throughout", held.expand(rows, count).clone()
            push = torch.where(
                (time < (0.2, 0.4, 0.6)[index]).unsqueeze(-1), high, torch.zeros_like(low).clamp(low, high)
            )
            yield f"push and coast: full for {(20, 40, 60)[index]} % of the time, then as little as was driven", push
            levels = low + (high - low) * torch.rand(5, count)
            held = levels[(time * 4.999).long()]
            yield f"steps {index + 1}: five random levels", held
            periods = torch.tensor([2.0, 3.0, 5.0]).to(driven)[(torch.arange(count) + index) % 3]
            swept = middle + (high - low) / 2 * (2 * torch.pi * periods * time.unsqueeze(-1)).sin()
            yield f"swing {index + 1}: sines between the limits", swept
