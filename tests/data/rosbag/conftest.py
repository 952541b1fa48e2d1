"""A bag of a few rows."""

from __future__ import annotations

from pathlib import Path

import pytest
from bag_drives import drive
from bag_writing import write_bag


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / "drive", "mcap", drive(4))
