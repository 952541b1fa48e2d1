"""The likeliest values of two or three numbers of a fitted program, by a quadratic surface through log p(y).

Where drives leave much of their paths open, EM moves slowly (Dempster, Laird and Rubin 1977): a fit is stopped before
numbers that these paths determine have arrived. The filter's log p(y) knows nothing of paths. A surface of second order
leads to the top of a response that is measured with noise (Box and Wilson 1951). A full grid of three levels a number
shows all curvatures and crossings, and has points left to measure the scatter.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from steady_ppl import FilterError, Trajectories, log_likelihood, seeded

ROUNDS = 6  # grids at most, each around the maximum of the one before


@dataclass(frozen=True)
class Likeliest:
    """Where log p(y) is largest over some numbers, given the others.

    Attributes:
        values: by name.
        conditional_sds: of them, given the others, by the surface's curvature.
        correlation: matrix of them, in the order of the names.
        scatter: standard deviation of log p(y) about the surface, nats.
        rounds: grids that were computed.
    """

    values: dict[str, float]
    conditional_sds: dict[str, float]
    correlation: list[list[float]]
    scatter: float
    rounds: int


@torch.no_grad()
def move_to_likeliest(
    program: Any,
    data: Trajectories,
    spacings: Mapping[str, float],
    *,
    known_start: bool,
    particles: int = 400,
    repeats: int = 3,
    seed: int = 0,
) -> Likeliest:
    """Move some scalar parameters of a program, in place, to where the filter's log p(y) is largest.

    Args:
        program: fitted, with normal noise.
        data: as returned by `for_program`.
        spacings: of the grid, by the parameters' names: about two standard deviations.
        known_start: the first state is certain.
        particles: of the filter that looks ahead, for each drive.
        repeats: filters at each point of the grid.
        seed: of the filters.

    Raises:
        NoTop: no grid had a maximum inside; the program is what it was.
        FilterError: the program cannot be filtered at a point of a grid; it is what it was.
    """
    names, spacing = tuple(spacings), torch.tensor([*spacings.values()], dtype=torch.float64)
    grid = torch.tensor([*itertools.product((-1.0, 0.0, 1.0), repeat=len(names))], dtype=torch.float64)
    centre = torch.tensor([getattr(program, name).item() for name in names], dtype=torch.float64)
    filtering = {"particles": particles, "known_start": known_start, "every": 1, "look_ahead": True}

    def put(values: Tensor) -> None:
        for name, value in zip(names, values.tolist(), strict=True):
            setattr(program, name, torch.full_like(getattr(program, name), value))

    def height(point: Tensor, repeat: int) -> float:
        put(point)
        with seeded(seed, "surface", repeat):
            return float(log_likelihood(program, data, **filtering).sum())

    began, taken, inside = centre, 0, False
    try:
        while not inside:
            if taken == ROUNDS:
                raise NoTop(f"log p(y) has no top in {', '.join(names)} near {began.tolist()} after {taken} grids")
            taken += 1
            heights = [[height(centre + spacing * at, repeat) for repeat in range(repeats)] for at in grid]
            surface = _surface(grid, torch.tensor(heights, dtype=torch.float64).mean(-1))
            inside = surface.has_top and bool((surface.lead.abs() <= 1).all())
            centre = centre + spacing * surface.lead.clamp(-1.5, 1.5)
    except (NoTop, FilterError):
        put(began)
        raise
    put(centre)
    covariance = spacing[:, None] * torch.linalg.inv(-surface.curvature) * spacing
    sds = covariance.diagonal().sqrt()
    return Likeliest(
        values=dict(zip(names, centre.tolist(), strict=True)),
        conditional_sds=dict(zip(names, sds.tolist(), strict=True)),
        correlation=(covariance / sds[:, None] / sds).tolist(),
        scatter=surface.scatter,
        rounds=taken,
    )


class NoTop(Exception):
    """No grid around the numbers has a maximum of log p(y) inside."""


class _Surface(NamedTuple):
    curvature: Tensor
    has_top: bool
    lead: Tensor  # to the top, or past the highest point of the grid where there is none
    scatter: float


def _surface(grid: Tensor, heights: Tensor) -> _Surface:
    """The quadratic surface of least squares through heights on a grid."""
    count = grid.shape[-1]
    pairs = [(i, j) for i in range(count) for j in range(i, count)]
    design = torch.stack([torch.ones(len(grid)), *grid.T, *(grid[:, i] * grid[:, j] for i, j in pairs)], -1)
    found = torch.linalg.lstsq(design, heights[:, None]).solution[:, 0]
    curvature = torch.zeros(count, count, dtype=grid.dtype)
    for (i, j), size in zip(pairs, found[count + 1 :], strict=True):
        curvature[i, j] += size
        curvature[j, i] += size
    has_top = bool((torch.linalg.eigvalsh(curvature) < 0).all())
    lead = -torch.linalg.solve(curvature, found[1 : count + 1]) if has_top else 1.5 * grid[heights.argmax()]
    scatter = (heights - design @ found).square().sum() / max(1, len(grid) - len(found))
    return _Surface(curvature, has_top, lead, float(scatter.sqrt()))
