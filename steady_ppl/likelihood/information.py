"""What is kept of a fit's uncertainty: the curvature of log p(y) and the log prior at its end (Laplace).

A program that was fitted to a few drives errs on others even where it is right. Whoever judges it there needs to know
by how much.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import UsageError
from steady_ppl.gaussian.linearize import ReferencePath, why_not_linear
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.likelihood.objective import (
    OBSERVED_SHARES,
    LinearizedObjective,
    Term,
    by_cross_products,
    linearised,
    observed,
    reach,
)
from steady_ppl.likelihood.parameters import MAX_LEARNABLE_NUMBERS, Element, elements, values_of
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.utils.cores import one_thread
from steady_ppl.utils.text import reason_of

NOT_KNOWN = "how well the trajectories determine the parameters is not known: {}"
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
        matrix, gain = tensors["matrix"].double(), float(gain)
        if not (isinstance(names, list) and isinstance(drives, list) and math.isfinite(gain) and gain >= 0):
            raise ValueError("it is no information of parameters")
        symmetric = matrix.shape == (len(names), len(names)) and torch.allclose(matrix, matrix.T, equal_nan=False)
        if not symmetric or not bool(torch.isfinite(matrix).all()):
            raise ValueError("its matrix does not suit its numbers")
        return cls(tuple(map(str, names)), matrix, gain, frozenset(map(str, drives)))

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
        limits, turn, curvature = within_reach(parts, self.matrix)
        root = limits[:, None] * turn * curvature.rsqrt()
        return values_of(parts) + torch.randn(count, len(parts), dtype=torch.float64) @ root.T


@one_thread()
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
    if problem.data.time.is_cuda:
        return None, [NOT_KNOWN.format("it is looked at on the CPU alone")]
    if why_not_linear(problem.program, problem.data, known_start=problem.known_start):
        return None, []
    try:
        near = path or find_and_smooth(problem).linearization.path
        here = linearised([Term.alone(problem, near)])
        parts = here.terms[0].term.parts
        matrix = _observed(here, by_cross_products(here) if known is None else known)
        limits, turn, curvature = within_reach(parts, matrix)
        gain = 0.5 * float(((turn.T @ (limits * here.gradient)).square() / curvature).sum())
    except Exception as error:  # also of the program's own code, at numbers that nobody tried before; the fit stays
        return None, [NOT_KNOWN.format(reason_of(error))]
    if not (math.isfinite(gain) and bool(torch.isfinite(matrix).all())):
        return None, [NOT_KNOWN.format("the model diverges beside them")]
    names = tuple(part.name for part in parts)
    return ParameterInformation(names, (matrix + matrix.T) / 2, gain, frozenset(problem.data.digests)), []


def _observed(here: LinearizedObjective, known: Tensor) -> Tensor:
    """The curvature, observed again while it is near the limits that what was known before sets it; as far as it can
    be observed."""
    term = here.terms[0].term
    for _ in range(MAX_OBSERVATIONS):
        matrix = observed(term, known)
        if matrix is None or _is_believed(term.parts, known, matrix):
            return known if matrix is None else matrix
        known = matrix
    return known


def within_reach(parts: Sequence[Element], matrix: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """What numbers move at once, `(P,)`, the directions `(P, P)` in which these have a curvature each, and these
    `(P,)`, no less than what leaves a direction open by that."""
    limits = reach(parts, matrix)
    curvature, turn = torch.linalg.eigh(limits * matrix * limits[:, None])
    return limits, turn, curvature.clamp(min=1.0)


def _is_believed(parts: Sequence[Element], before: Tensor, matrix: Tensor) -> bool:
    """Whether what was observed is far from the limits that `before` sets it; from the lower one, where the drives tell
    something within reach."""
    least, most = OBSERVED_SHARES
    limits = reach(parts, before)
    told = torch.diag(limits.square().reciprocal())
    shares, told_shares = _shares(before, matrix), _shares(before + told, matrix + told)
    if shares is None or told_shares is None:
        return False
    return bool((shares < 0.5 * most).all() and (told_shares > 2 * least).all())


def _shares(before: Tensor, matrix: Tensor) -> Tensor | None:
    """Eigenvalues of one matrix by another; None where this is not positive."""
    root, failed = torch.linalg.cholesky_ex(before)
    if failed:
        return None
    half = torch.linalg.solve_triangular(root, matrix, upper=False)
    return torch.linalg.eigvalsh(torch.linalg.solve_triangular(root, half.T, upper=False))
