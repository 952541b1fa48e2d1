"""What hand-written tests of odd files share."""

from __future__ import annotations

from pathlib import Path

import pytest
from examples import MODELS
from small import simulated, steady, written


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """Drives of a cart."""
    return written(tmp_path / "t.csv", simulated("linear_gaussian", 5, 9))


@pytest.fixture(scope="session")
def cart_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of a cart on its own drives."""
    folder = tmp_path_factory.mktemp("cart")
    table = written(folder / "t.csv", simulated("linear_gaussian", 5, 9))
    assert steady("fit", MODELS / "linear_gaussian.py", table, "--recipe", "hand", "--out", folder / "run") == 0
    return folder / "run"
