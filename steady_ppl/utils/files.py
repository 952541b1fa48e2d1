"""Files: written whole or not at all, refused early, read as JSON or TOML; pictures."""

import json
import os
import tomllib
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from stat import S_ISCHR, S_ISDIR, S_ISFIFO, S_ISREG, S_ISSOCK
from typing import TYPE_CHECKING, Any

from steady_ppl.errors import ComputationError, SteadyError, UsageError
from steady_ppl.utils.text import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@contextmanager
def whole_file(path: Path, refused: type[SteadyError] = UsageError, beside: Path | None = None) -> Iterator[Path]:
    """A file `beside` for the block to write, by itself a hidden one of this process in the same folder. It takes the
    place of `path` if the block succeeds, and is removed if not. An `OSError` on the way is raised as `refused`."""
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
    """Raise UsageError for a file that is a folder or whose folder does not exist; None is no file."""
    if path is not None and not path.parent.is_dir():
        raise UsageError(f"{path} cannot be written: there is no folder {path.parent}")
    if path is not None and path.is_dir():
        raise UsageError(f"{path} cannot be written: it is a folder")


def require_picture(path: Path | None) -> None:
    """Raise UsageError for a picture's place that there is not, or an ending that matplotlib does not write."""
    require_place(path)
    if path is None:
        return
    from matplotlib.figure import Figure

    formats = set(Figure().canvas.get_supported_filetypes()) - {"pgf"}  # which needs TeX
    if path.suffix.lower()[1:] not in formats:
        raise UsageError(f"{path}: expected a picture's name that ends in one of {', '.join(sorted(formats))}")


def write_picture(figure: "Figure", path: Path) -> None:
    """Write a picture whole or not at all; UsageError where it cannot be written."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_text(printable(text.get_text()))  # matplotlib draws no name that is not UTF-8
    with whole_file(path) as beside:
        figure.savefig(beside, format=path.suffix.lower()[1:], dpi=150)


FILE_TYPES = ((S_ISDIR, "a folder"), (S_ISFIFO, "a pipe"), (S_ISCHR, "a device"), (S_ISSOCK, "a socket"))


def require_file(path: Path, refused: type[SteadyError]) -> None:
    """Raise `refused` for a folder and for what may never end: a pipe, a device. A missing file is left to be found."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return
    if not S_ISREG(mode):
        what = next((word for test, word in FILE_TYPES if test(mode)), "no file")
        raise refused(f"{path} is {what}: expected a file")


def finite_json(
    content: Any, place: str, *, indent: int | None = None, separators: tuple[str, str] | None = None
) -> str:
    """JSON, which has no word for a figure that is not finite: a ComputationError says what is not written."""
    try:
        return json.dumps(content, indent=indent, separators=separators, allow_nan=False)
    except ValueError as error:
        raise ComputationError(f"{place} is not written: a figure is not finite, the model diverges") from error


def read_toml(path: Path) -> dict[str, Any]:
    """What a TOML file says; UsageError where it cannot be read."""
    require_file(path, UsageError)
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise UsageError(f"{path} is not TOML: {str(error).partition(chr(10))[0]}") from error
    except RecursionError:
        raise UsageError(f"{path} is not TOML that can be read: it is nested too deeply") from None


def read_json(path: Path, refused: type[SteadyError]) -> Any:
    """What a JSON file says; FileNotFoundError or NotADirectoryError where there is none, else `refused`."""
    require_file(path, refused)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise
    except (OSError, ValueError) as error:
        raise refused(f"{path} is damaged: {error}") from error
    except RecursionError:
        raise refused(f"{path} is damaged: it is nested too deeply") from None
