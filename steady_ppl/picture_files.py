"""Pictures as files, whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from steady_ppl.errors import UsageError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def require_picture(path: Path | None) -> None:
    """Refuse a name whose ending is no picture's, before anything is computed; None is no picture.

    Raises:
        UsageError: naming the endings that matplotlib writes.
    """
    if path is None:
        return
    from matplotlib.figure import Figure

    formats = Figure().canvas.get_supported_filetypes()
    if path.suffix.lower()[1:] not in formats:
        raise UsageError(f"{path}: expected a picture's name that ends in one of {', '.join(sorted(formats))}")


def write_picture(figure: Figure, path: Path) -> None:
    """Write a picture whole or not at all.

    Raises:
        UsageError: the file cannot be written.
    """
    beside = path.with_name(path.name + ".partial")
    try:
        figure.savefig(beside, format=path.suffix.lower()[1:], dpi=150)
        os.replace(beside, path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise UsageError(f"{path} cannot be written: {error.strerror}") from error
