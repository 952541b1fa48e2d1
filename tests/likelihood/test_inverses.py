"""Inverses of information matrices do not depend on units."""

from __future__ import annotations

import pytest
import torch

from steady_ppl.likelihood.parameter_posterior import pseudo_inverse, ridged_inverse

SIZES = torch.tensor([1e-9, 1.0, 1e7], dtype=torch.float64)


def information() -> torch.Tensor:
    root = torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return root @ root.T


@pytest.mark.parametrize("inverse", [pseudo_inverse, ridged_inverse])
def test_a_covariance_goes_with_the_units(inverse):
    found, scaled = inverse(information()), inverse(SIZES * information() * SIZES[:, None])
    torch.testing.assert_close(SIZES * scaled * SIZES[:, None], found)
    torch.testing.assert_close(found, torch.linalg.inv(information()), rtol=1e-6, atol=0)


def test_what_is_not_told_is_nothing_or_huge():
    told = torch.tensor([[4.0, 0.0], [0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(pseudo_inverse(told).diagonal(), torch.tensor([0.25, 0.0]).double())
    assert float(ridged_inverse(told)[1, 1]) > 1e9
    torch.testing.assert_close(ridged_inverse(told)[0, 0], torch.tensor(0.25).double())
