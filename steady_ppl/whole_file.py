"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from steady_ppl.errors import SteadyError, UsageError


@contextmanager
def whole_file(path: Path, refused: type[SteadyError] = UsageError, beside: Path | None = None) -> Iterator[Path]:
    """A file beside `path` for the block to write; it takes the place of `path` if the block succeeds, and is removed
    if not.

    Args:
        path: the file that is meant.
        refused: what is raised when the block, or the last step, meets an `OSError`.
        beside: where the block writes; a hidden file of this process in the same folder when not given.

    Raises:
        UsageError, or `refused`: it cannot be written.
    """
    beside = beside or hidden_beside(path)
    try:
        beside.unlink(missing_ok=True)  # a link in its place would be written through
        yield beside
        os.replace(beside, path)
    except OSError as error:
        raise refused(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):  # where nothing can be written nothing can be removed, and what went wrong is said
            beside.unlink(missing_ok=True)


def hidden_beside(path: Path) -> Path:
    """This process's hidden file in the folder of `path`. Its name is short: that of `path` may be as long as any."""
    return path.with_name(f".{zlib.crc32(os.fsencode(path.name)):08x}.{os.getpid()}.partial")


def require_place(path: Path | None) -> None:
    """Refuse a file whose folder does not exist, or that is one, before anything is computed; None is no file.

    Raises:
        UsageError: naming the folder.
    """
    if path is not None and not path.parent.is_dir():
        raise UsageError(f"{path} cannot be written: there is no folder {path.parent}")
    if path is not None and path.is_dir():
        raise UsageError(f"{path} cannot be written: it is a folder")
