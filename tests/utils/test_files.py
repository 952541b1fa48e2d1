"""Files of another kind, and files that cannot be removed."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from steady_ppl.errors import DataError, UsageError
from steady_ppl.utils.files import read_json, require_file, whole_file


def test_what_may_never_end_is_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(DataError, match="is a pipe"):
        read_json(tmp_path / "pipe.json", DataError)
    require_file(tmp_path / "nothing", DataError)  # is for the reader to find
    with pytest.raises(FileNotFoundError):
        read_json(tmp_path / "nothing", DataError)


def test_what_cannot_be_removed_hides_no_error(tmp_path: Path, monkeypatch) -> None:
    def refuse(*_, **__):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(UsageError, match="a.csv cannot be written: Read-only"), whole_file(tmp_path / "a.csv"):
        pass
