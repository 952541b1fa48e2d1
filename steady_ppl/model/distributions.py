"""Distributions of angles."""

import math
from collections.abc import Sequence

import pyro.distributions as dist
import torch
from torch import Tensor

from steady_ppl.utils.angles import wrap


class _Wrapped:
    """A density of the difference of two angles, wrapped to [−π, π]."""

    loc: Tensor

    def residual(self, value: Tensor) -> Tensor:
        """`value − loc`, wrapped."""
        return wrap(value - self.loc)

    def rsample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        return wrap(super().rsample(torch.Size(sample_shape)))  # type: ignore[misc]

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        with torch.no_grad():
            return self.rsample(sample_shape)


class WrappedNormal(_Wrapped, dist.Normal):
    """Normal(0, scale) on the difference of two angles, wrapped to [−π, π].

    The neglected windings hold less than 10⁻¹⁸ of the mass at a scale of 20°, 3 · 10⁻⁴ at 50°.
    """

    def log_prob(self, value: Tensor) -> Tensor:
        return -0.5 * (self.residual(value) / self.scale) ** 2 - self.scale.log() - 0.5 * math.log(2 * math.pi)


class WrappedStudentT(_Wrapped, dist.StudentT):  # type: ignore[misc]
    """Student t on the difference of two angles, wrapped to [−π, π]; its mass beyond half a turn is neglected."""

    def log_prob(self, value: Tensor) -> Tensor:
        return dist.StudentT(self.df, torch.zeros_like(self.loc), self.scale).log_prob(self.residual(value))
