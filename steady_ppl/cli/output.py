"""What commands print and write: text, figures as JSON, refusals of the system."""

import errno
from pathlib import Path
from typing import Any

from steady_ppl.errors import ComputationError, SteadyError, UsageError
from steady_ppl.utils.files import finite_json, whole_file
from steady_ppl.utils.text import shown, tell

NO_SPACE = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
NO_MEMORY = ("can't allocate memory", "not enough memory", "out of memory", "Storage size calculation overflowed")


def write_json(path: Path, content: Any) -> None:
    """Write a file whole or not at all; a figure that is not finite is an error, JSON has no word for it."""
    text = finite_json(content, str(path), indent=1) + "\n"
    with whole_file(path) as beside:
        beside.write_text(text)


def present(text: str, content: Any, json_file: Path | None) -> None:
    """Print the text and write the figures beside it, or print the figures alone if the file is `-`."""
    if json_file is not None and str(json_file) == "-":
        tell(finite_json(content, "the output", indent=1))
        return
    tell(text)
    if json_file is not None:
        write_json(json_file, content)


def as_refusal(error: Exception) -> SteadyError | None:
    """A file that the system refuses, or more memory than there is; None for anything else, a defect perhaps.

    Example:
        >>> as_refusal(FileNotFoundError(2, "No such file or directory", "drives.csv"))
        UsageError('drives.csv: No such file or directory')
    """
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return UsageError(f"{shown(str(error.filename), 100)}: {error.strerror}")
    if isinstance(error, OSError) and error.errno in NO_SPACE:  # numba says no name of its cache
        return UsageError(f"a file cannot be written: {error.strerror}")
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and any(w in str(error) for w in NO_MEMORY)):
        return ComputationError(
            "this needs more memory than there is: take fewer or shorter trajectories, or less of each"
        )
    return None
