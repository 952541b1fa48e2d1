"""Refusals of the system are a line, defects are none."""

from __future__ import annotations

import errno

from steady_ppl.cli.output import as_refusal
from steady_ppl.errors import ComputationError, UsageError


def test_another_error_of_a_file_is_a_line_too_and_a_defect_is_none() -> None:
    said = as_refusal(PermissionError(errno.EACCES, "Permission denied", "locked/run"))
    assert isinstance(said, UsageError) and str(said) == "locked/run: Permission denied"
    full = as_refusal(OSError(errno.ENOSPC, "No space left on device"))  # as when numba keeps a compiled kernel
    assert isinstance(full, UsageError) and str(full) == "a file cannot be written: No space left on device"
    assert isinstance(as_refusal(MemoryError()), ComputationError)
    assert as_refusal(OSError("nothing is known of it")) is None and as_refusal(RuntimeError("a defect")) is None
