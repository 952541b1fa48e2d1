"""What is kept of a fit's uncertainty: the curvature of log p(y) and the log prior at its end (Laplace).

A program that was fitted to a few drives errs on others even where it is right. Whoever judges it there needs to know
by how much.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import FilterError, UsageError
from steady_ppl.gaussian.linearize import ReferencePath, why_not_linear
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.likelihood.objective import (
    MAX_MOVE,
    OBSERVED_SHARES,
    LinearizedObjective,
    Term,
    by_cross_products,
    linearised,
    observed,
)
from steady_ppl.likelihood.parameters import MAX_LEARNABLE_NUMBERS, elements, values_of
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program

MAX_OBSERVATIONS = 6  # times that the curvature is observed, each with the sizes of the one before


@dataclass(frozen=True)
class ParameterInformation:
    """How well drives determine a fitted program's learnable numbers."""

    names: tuple[str, ...]  # of the P numbers
    matrix: Tensor  # (P, P), nats, in the space in which they are learned
    gain: float  # nats by which a longer fit would be likelier
    drives: frozenset[str]  # the digests of these drives

    def as_tensors(self) -> tuple[dict[str, Tensor], dict[str, str]]:
        """Tensors and text, for a file."""
        text = {"names": list(self.names), "gain": self.gain, "drives": sorted(self.drives)}
        return {"matrix": self.matrix}, {name: json.dumps(value) for name, value in text.items()}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor], text: Mapping[str, str]) -> ParameterInformation:
        """Of what `as_tensors` returns; KeyError, ValueError or TypeError where it is something else."""
        names, gain, drives = (json.loads(text[name]) for name in ("names", "gain", "drives"))
        matrix = tensors["matrix"].double()
        if matrix.shape != (len(names), len(names)) or not bool(torch.isfinite(matrix).all()):
            raise ValueError("its matrix does not suit its numbers")
        return cls(tuple(map(str, names)), matrix, float(gain), frozenset(map(str, drives)))

    def has_seen(self, data: Trajectories) -> bool:
        """Whether the program was fitted to each of these drives, as it reads them."""
        return self.drives.issuperset(data.digests)

    def suits(self, program: Program) -> bool:
        """Whether it is about the numbers that this program has."""
        try:
            return self.names == tuple(part.name for part in elements(program))
        except UsageError:  # a network
            return False

    def draws(self, program: Program, count: int) -> Tensor:
        """Values of the program's numbers, `(count, P)`, normal about where they are.

        What the drives do not tell is open by as much as a fit moves it at once.
        """
        parts = elements(program)
        reach = torch.tensor([MAX_MOVE * part.step for part in parts], dtype=torch.float64)
        curvature, turn = torch.linalg.eigh(reach * self.matrix * reach[:, None])
        root = reach[:, None] * turn * curvature.clamp(min=1.0).rsqrt()
        return values_of(parts) + torch.randn(count, len(parts), dtype=torch.float64) @ root.T


@torch.no_grad()
def information_of_fit(
    problem: Problem, path: ReferencePath | None = None, known: Tensor | None = None
) -> tuple[ParameterInformation | None, list[str]]:
    """How well drives determine a program that was fitted to them, and a note where that cannot be told.

    Paths that are not given are found by random starts: run it in a `seeded` block then. A program that cannot be
    linearised, learns nothing, or learns a network has none.

    Args:
        problem: the fitted program and its drives.
        path: near the posterior means of the drives.
        known: about what the matrix is, if somebody knows.
    """
    count = sum(value.numel() for value in problem.program.parameters() if value.requires_grad)
    if not 0 < count <= MAX_LEARNABLE_NUMBERS:
        return None, []
    if why_not_linear(problem.program, problem.data, known_start=problem.known_start):
        return None, []
    try:
        near = path or find_and_smooth(problem).linearization.path
        here = linearised([Term.alone(problem, near)])
        matrix = _observed(here, by_cross_products(here) if known is None else known)
    except FilterError as error:
        return None, [f"how well the drives determine the parameters is not known: {error}"]
    if matrix is None:
        return None, ["how well the drives determine the parameters is not known: the program diverges beside them"]
    gain = 0.5 * float(here.gradient @ torch.linalg.solve(matrix, here.gradient))
    names = tuple(part.name for part in here.terms[0].term.parts)
    return ParameterInformation(names, matrix, gain, frozenset(problem.data.digests)), []


def _observed(here: LinearizedObjective, known: Tensor) -> Tensor | None:
    """The curvature, observed again while it is near the limits that what was known before sets it."""
    for _ in range(MAX_OBSERVATIONS):
        matrix = observed(here.terms[0].term, known)
        if matrix is None or _is_believed(known, matrix):
            return matrix
        known = matrix
    return known


def _is_believed(before: Tensor, matrix: Tensor) -> bool:
    """Whether what was observed is far from the limits that `before` sets it."""
    least, most = OBSERVED_SHARES
    root = torch.linalg.cholesky(before)
    half = torch.linalg.solve_triangular(root, matrix, upper=False)
    shares = torch.linalg.eigvalsh(torch.linalg.solve_triangular(root, half.T, upper=False))
    return bool((shares > 2 * least).all() and (shares < 0.5 * most).all())
