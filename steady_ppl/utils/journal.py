"""What a long computation has come to, kept piece by piece, so that one that was killed goes on where it was.

The computation must be deterministic: a piece is known by its number alone. The caller sees to it that the one that
goes on has the inputs of the one that was killed.

    with journal(folder):
        tensors, numbers = journaled(compute)     # read from the folder if it is there, else computed and written
"""

import itertools
import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from steady_ppl.errors import FilterError, RunError
from steady_ppl.utils.context import bound
from steady_ppl.utils.cores import Output
from steady_ppl.utils.schema import ANYTHING, TEXT, mismatch
from steady_ppl.utils.tensor_files import read_tensors, write_tensors

RANDOM_STATE = "random state"  # of torch, after the piece
ENTRY_FORM = ({"values": {str: ANYTHING}}, {"failed": TEXT})


@dataclass
class _Journal:
    """The files of a journal's pieces, in order, and whether it is closed."""

    files: Iterator[Path]
    closed: bool = False


_journal: ContextVar[_Journal | None] = ContextVar("the journal of the block", default=None)


@contextmanager
def journal(folder: Path) -> Iterator[None]:
    """Keep the pieces of the block in a folder, and read those that are there. The folder goes when all went well and
    nobody closed the journal. RunError: it cannot be written, or a piece in it is damaged."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"{folder} cannot be written: {error.strerror}") from error
    pieces = _Journal(folder / f"{number:06d}.safetensors" for number in itertools.count(1))
    with bound(_journal, pieces):
        yield
    if not pieces.closed:
        shutil.rmtree(folder)


def close_journal() -> None:
    """Keep the journal of the block, if there is one, as it is: a computation that left its course has other pieces."""
    if (pieces := _journal.get()) is not None:
        pieces.closed = True


def journaled(compute: Callable[[], Output]) -> Output:
    """The next piece: tensors, and what JSON can hold. A `FilterError` is a result like any other. Outside of a journal
    and after it was closed, nothing is kept."""
    if (pieces := _journal.get()) is None or pieces.closed:
        return compute()
    if not (file := next(pieces.files)).is_file():
        _write(file, compute)
    tensors, said = _read(file)
    torch.set_rng_state(tensors.pop(RANDOM_STATE))
    if "failed" in said:
        raise FilterError(said["failed"])
    return tensors, said["values"]


def _read(file: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """A piece, the random state among its tensors; RunError where the file is damaged."""
    tensors, text = read_tensors(file)
    try:
        said = json.loads(text.get("said", "null"))
    except (ValueError, RecursionError):
        said = None
    state, now = tensors.get(RANDOM_STATE), torch.get_rng_state()
    if mismatch(said, ENTRY_FORM) is not None or state is None or (state.shape, state.dtype) != (now.shape, now.dtype):
        raise RunError(f"{file} is corrupt: use --force to restart the search")
    return tensors, said


def _write(file: Path, compute: Callable[[], Output]) -> None:
    tensors: Mapping[str, Tensor] = {}
    try:
        tensors, values = compute()
        said: dict[str, Any] = {"values": dict(values)}
    except FilterError as error:
        said = {"failed": str(error)}
    write_tensors(file, {**tensors, RANDOM_STATE: torch.get_rng_state()}, {"said": json.dumps(said)})
