"""What the operating system and the libraries raise for a reason that the person can mend, as a line to them."""

from __future__ import annotations

import errno

from steady_ppl.errors import ComputationError, SteadyError, UsageError
from steady_ppl.utils.text import shown

FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
MEMORY = ("can't allocate memory", "not enough memory", "out of memory", "Storage size calculation overflowed")


def as_refusal(error: Exception) -> SteadyError | None:
    """A file that the system refuses, or more memory than there is; None for anything else, a defect perhaps.

    Example:
        >>> as_refusal(FileNotFoundError(2, "No such file or directory", "drives.csv"))
        UsageError('drives.csv: No such file or directory')
    """
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return UsageError(f"{shown(str(error.filename), 100)}: {error.strerror}")
    if isinstance(error, OSError) and error.errno in FULL:  # numba says no name of its cache
        return UsageError(f"a file cannot be written: {error.strerror}")
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and any(w in str(error) for w in MEMORY)):
        return ComputationError("this needs more memory than there is: take fewer or shorter drives, or less of each")
    return None
