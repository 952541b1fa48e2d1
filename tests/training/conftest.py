"""Drives of a cart."""

from __future__ import annotations

import pytest
from examples import drives
from training_runs import Cart


@pytest.fixture(scope="module")
def data():
    return drives(Cart(), 4, 12, gaps=True)
