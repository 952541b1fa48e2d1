"""The next run: controls under which the members of a class would differ most."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.discovery.refits import Refit, wide, wide_drives
from steady_ppl.discovery.search import Found
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.predict import simulate_again
from steady_ppl.likelihood.problem import Problem
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
def next_run(found: Found, seed: int) -> NextRun | None:
    """The best of some ways of driving within the limits of the controls that were driven, None where none separates
    the class better than the drives that there are.

    Each is simulated with the best member of the class; the others are judged by how much less likely they find it.

    Args:
        found: an effect whose class has several members.
        seed: of the ways that are random, and of the simulations.
    """
    members = [(c.variant.name, c.refit) for c in found.alike if isinstance(c.refit, Refit)]
    refits = [refit for _, refit in members]
    data = refits[0].folds[0].drives
    usual = _separation(refits, data.controls, seed)
    better = []
    for way, controls in _ways(data, seed):
        apart = _separation(refits, controls.unsqueeze(1).expand_as(data.controls), seed)
        if math.isfinite(apart) and apart > max(0.0, usual):
            better.append((apart, way, controls))
    if not better:
        return None
    separation, way, controls = max(better, key=lambda one: one[0])
    order = refits[0].program.control_names
    return NextRun(
        between=[name for name, _ in members],
        way=way,
        controls={name: [round(v, 4) for v in controls[:, i].tolist()] for i, name in enumerate(order)},
        step=data.median_step,
        separation=separation,
        usual=usual if math.isfinite(usual) else 0.0,
    )


def _separation(refits: list[Refit], controls: Tensor, seed: int) -> float:
    """Nats a drive by which the first member is told from the nearest other."""
    fold, (program, *others) = refits[0].folds[0], [refit.judges.programs[0] for refit in refits]
    count = min(DRIVES, len(fold.drives))
    drives = replace(fold.drives.subset(range(count)), controls=controls[:, :count].contiguous())
    starts = fold.path.states[0, :count].unsqueeze(0)
    with seeded(seed, "next run"):
        again, truth = simulate_again(program, drives, starts, len(program.channels))
    own = _log_likelihood(Problem(program, again, fold.known_start), truth)
    apart = [float((own - _log_likelihood(Problem(other, again, fold.known_start), truth)).mean()) for other in others]
    return min(apart) if all(map(math.isfinite, apart)) else math.nan


def _log_likelihood(problem: Problem, path: ReferencePath) -> Tensor:
    """Of drives and a path of another program, whose further states are left out."""
    program, drives = problem.program, problem.data
    count = len(program.states)
    fitting = replace(drives, states=None if drives.states is None else drives.states[..., :count])
    near = wide(ReferencePath(path.states[..., :count], path.noise), program)
    return replace(problem, data=wide_drives(fitting, program)).smooth(near, passes=4).log_likelihood


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
