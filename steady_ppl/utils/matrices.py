"""Inverses of information matrices, whose numbers have units of their own."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

RIDGE = 1e-10  # beside an information of one


def in_own_sizes(inverse: Callable[[Tensor], Tensor], information: Tensor) -> Tensor:
    """An inverse of a matrix `(N, N)`, taken of the one that has ones on its diagonal: the same in any units."""
    size = information.diagonal().clamp(min=0).sqrt()
    per = torch.where(size > 0, 1 / size, 1.0)
    return per * inverse(per * information * per[:, None]) * per[:, None]


def pseudo_inverse(information: Tensor) -> Tensor:
    """The covariance of what the information tells; zero of what it does not tell. `lstsq` rounds differently from run
    to run."""
    return in_own_sizes(partial(torch.linalg.pinv, hermitian=True), information)


def ridged_inverse(information: Tensor) -> Tensor:
    """The covariance; of what the information does not tell it is huge."""
    ridge = RIDGE * torch.eye(len(information)).to(information)
    return in_own_sizes(lambda matrix: torch.linalg.inv(matrix + ridge), information)
