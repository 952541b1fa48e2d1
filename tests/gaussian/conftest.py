"""A hovercraft that sees landmarks, and drives of it."""

from __future__ import annotations

import pytest
from examples import drives, example


@pytest.fixture(scope="module")
def hovercraft():
    return example("hovercraft:HovercraftTruth").requires_grad_(False)


@pytest.fixture(scope="module")
def bearings(hovercraft):
    return drives(hovercraft, 3, 21, gaps=True)
