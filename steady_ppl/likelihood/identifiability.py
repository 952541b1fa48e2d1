"""Which of a program's learnable numbers, and which combinations of them, drives do not determine, in words."""

from collections.abc import Sequence

import torch
from torch import Tensor

from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.likelihood.maximize import Term, linearised
from steady_ppl.likelihood.parameter_posterior import observed_information
from steady_ppl.likelihood.parameters import Element, values_of
from steady_ppl.model.problem import Problem

MIN_CURVATURE = 1.0  # of log p(y) in a direction's own size, nats: below it a number is open by a factor of e
MIN_DRIVES_OF_NUMBER = 2  # for the cross products of their scores to tell the information
MIN_SHARE, SAME_SHARE = 0.1, 0.1  # of a direction's largest part, for a number to belong to it, or to be as large


@torch.no_grad()
def undetermined(problem: Problem, path: ReferencePath) -> list[str]:
    """Sentences about what drives leave open of a program that was fitted to them, or to others like them.

    Directions are eigenvectors of the information matrix, in logarithms and, of numbers with a unit, in their own size.

    Args:
        problem: its program has some dozens of learnable numbers.
        path: of the drives, near their posterior means.
    """
    term = Term.alone(problem, path)
    if not (parts := term.parts):
        return []
    scores = linearised([term]).scores
    directions = _open_directions(parts, scores.T @ scores)
    if directions or len(scores) < MIN_DRIVES_OF_NUMBER * len(parts):
        directions = _open_directions(parts, observed_information(problem, path, parts))
    return [_sentence(parts, direction) for direction in directions]


def _open_directions(parts: Sequence[Element], information: Tensor) -> list[Tensor]:
    """Directions along which log p(y) hardly bends, each `(P,)` and of few numbers, in the numbers' own sizes."""
    own = information.diagonal().clamp(min=0)
    size = torch.where(own > 0, torch.maximum(values_of(parts).abs(), 3 * own.rsqrt()), 1.0)
    size = torch.where(torch.tensor([part.has_unit for part in parts]), size, 1.0)
    curvature, turn = torch.linalg.eigh(size * information * size[:, None])
    basis = turn[:, curvature < MIN_CURVATURE].T.clone()
    for row in range(len(basis)):  # the same space by directions of few numbers: Gauss and Jordan
        at = divmod(int(basis[row:].abs().argmax()), len(parts))
        basis[[row, row + at[0]]] = basis[[row + at[0], row]]
        basis[row] /= basis[row, at[1]].clone()
        others = torch.arange(len(basis)) != row
        basis[others] -= basis[others][:, at[1], None] * basis[row]
    return list(basis)


def _sentence(parts: Sequence[Element], direction: Tensor) -> str:
    share = direction / direction.abs().max()
    chosen = [index for index in range(len(parts)) if abs(float(share[index])) > MIN_SHARE]
    names = [parts[index].name for index in chosen]
    if len(chosen) == 1:
        return f"these drives do not tell {names[0]}: many values are as likely"
    listed = f"{', '.join(names[:-1])} and {names[-1]}"
    pair = [float(share[index]) for index in chosen]
    equal = len(pair) == 2 and abs(abs(pair[0]) - abs(pair[1])) < SAME_SHARE
    if equal and not any(parts[index].has_unit for index in chosen):
        what = "product" if pair[0] * pair[1] < 0 else "ratio"
        return f"these drives tell only the {what} of {listed}, not each"
    return f"these drives tell {listed} only together, not each"
