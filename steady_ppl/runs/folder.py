"""The folder of a run: its files, its record, and how one is overwritten without losing it to a failed fit."""

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from steady_ppl.errors import RunError
from steady_ppl.utils.context import COMMAND
from steady_ppl.utils.files import read_json, require_file, whole_file
from steady_ppl.utils.schema import ANYTHING, BOOL, LINES, TEXT, WHOLE, mismatch
from steady_ppl.utils.tensor_files import read_tensors

PARAMETERS, RUN_RECORD, POSTERIOR = "parameters.safetensors", "run.json", "posterior.nc"
INFORMATION = "information.safetensors"
CHECKPOINT, DISCOVERY = "checkpoint.safetensors", "discovery.json"
FILES = (PARAMETERS, INFORMATION, RUN_RECORD, POSTERIOR, CHECKPOINT, DISCOVERY)
BACKUP, LOCK, JOURNAL = "previous", ".lock", "journal"

RUN_FORMAT = 1  # number of the record's format
FINISHED = ("finished", "interrupted")  # what the record of a run that can be used says
BEGUN_RECORD_FORM = {
    "format": WHOLE,
    "program": ({"class": TEXT, "file": TEXT, "sha256": TEXT}, None),
    "recipe": TEXT,
    "status": TEXT,
    "command?": (TEXT, None),
}
FINISHED_RECORD_FORM = {
    "effects": LINES,
    "substeps": WHOLE,
    "known_start": BOOL,
    "seed": WHOLE,
    "settings": {str: ANYTHING},
    "kept_step": (WHOLE, None),
    "history": [{str: ANYTHING}],
    "notes": LINES,
}


@contextmanager
def run_folder(folder: str | Path, *, force: bool = False, resume: bool = False) -> Iterator[Path]:
    """Make a run folder for the block that fills it.

    With `force` the files of the old run are put aside in the folder `previous` of the run; a block that fails gets
    them back, one that succeeds removes them. Without an old run a failure leaves nothing but a checkpoint, or the
    journal of a search, that is worth resuming.

    Raises:
        RunError: it exists and neither `force` nor `resume` is given, it cannot be made, has nothing to resume, or
            another process writes to it.
    """
    folder = Path(folder)
    if folder.exists() and not (force or resume):
        raise RunError(f"{folder} exists: choose another folder, or --force to overwrite, or --resume to go on")
    if resume and not ((folder / CHECKPOINT).is_file() or (folder / JOURNAL).is_dir()):
        raise RunError(f"{folder} has no {CHECKPOINT} to resume from, nor the {JOURNAL} of a search")
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        with exclusive_writer(folder):
            for name in (BACKUP, JOURNAL):
                if (folder / name).is_symlink():  # out of the run, to files that are somebody else's to remove
                    raise RunError(f"{folder}: {name} in it is a link: remove the link, or choose another folder")
            if not resume:
                _back_up(folder)
            try:
                yield folder
            except BaseException:
                if not resume:
                    _roll_back(folder)
                raise
            if (folder / BACKUP).is_dir():
                _remove(folder / BACKUP)
                (folder / BACKUP).rmdir()
    finally:
        for place in made:
            if place.is_dir() and not any(place.iterdir()):
                place.rmdir()


@contextmanager
def exclusive_writer(folder: Path) -> Iterator[None]:
    """Make a folder and keep other processes from writing to it. The lock is the process's own: it ends with it,
    however it ends."""
    lock = FileLock(folder / LOCK)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(blocking=False)
    except Timeout as error:
        raise RunError(f"{folder}: another process writes to it: wait for its end, or choose another folder") from error
    except OSError as error:
        raise RunError(f"{folder} cannot be written: {error.strerror}") from error
    try:
        yield
    finally:
        (folder / LOCK).unlink(missing_ok=True)
        lock.release()


def _back_up(folder: Path) -> None:
    aside = folder / BACKUP
    if aside.is_dir():  # of an overwriting fit that was killed: it, not what that fit left, is the finished run
        _remove(folder)
        return
    present = [name for name in FILES if (folder / name).exists()]
    for name in present:
        require_file(folder / name, RunError)
    try:
        _remove(folder, ())
        if present:
            aside.mkdir()
        for name in present:
            os.replace(folder / name, aside / name)
    except OSError as error:
        raise RunError(f"{folder} cannot be written: {error.strerror}") from error


def _roll_back(folder: Path) -> None:
    """Undo what a failed block wrote."""
    aside, checkpoint = folder / BACKUP, folder / CHECKPOINT
    if not aside.is_dir():
        begun = checkpoint.is_file() and json.loads(read_tensors(checkpoint)[1]["step"]) > 0
        if not begun and not any((folder / JOURNAL).glob("*")):
            _remove(folder)
        return
    _remove(folder)
    for name in FILES:
        if (aside / name).exists():
            os.replace(aside / name, folder / name)
    aside.rmdir()


def _remove(folder: Path, files: Sequence[str] = FILES) -> None:
    """Remove files of a run, and the journal of a search."""
    for name in files:
        (folder / name).unlink(missing_ok=True)
    if (folder / JOURNAL).is_dir():
        shutil.rmtree(folder / JOURNAL)


def write_record(folder: Path, record: dict[str, Any]) -> None:
    """Write `run.json`, whole or not at all."""
    with whole_file(folder / RUN_RECORD, RunError) as beside:
        beside.write_text(json.dumps({"format": RUN_FORMAT, "command": COMMAND.get(), **record}, indent=1) + "\n")


def require_same(folder: Path, begun: Mapping[str, Any]) -> None:
    """Refuse to go on with a run whose inputs were others; the RunError names the first that was."""
    before = read_record(folder)
    inputs = {"program": "model", "table_sha256": "training table", "valid_sha256": "--valid table"}
    for key, what in inputs.items():
        if before.get(key) != begun[key]:
            raise RunError(f"{folder}: --resume needs the same {what}; it is another or has changed")
    if before.get("option_files") != begun["option_files"]:
        same = " and ".join(begun["option_files"])
        raise RunError(f"{folder}: --resume needs the same {same}; a file has changed")
    for key in ("recipe", "known_start", "seed", "options", "begun_substeps"):
        if before.get(key) != begun[key]:
            name, then = key.removeprefix("begun_"), before.get(key)
            raise RunError(f"{folder}: --resume needs the same {name}: {then} then, {begun[key]} now")


def read_versioned(file: Path, form: Any, known: int, what: str) -> Any:
    """Read JSON of a form, whose `format` is a number up to the one that is known. RunError: it is damaged, a newer
    steady-ppl wrote it, or there is none, so that its folder is not `what`."""
    try:
        record = read_json(file, RunError)
    except (FileNotFoundError, NotADirectoryError):
        raise RunError(f"{file.parent} is not {what}: it has no {file.name}") from None
    number = record.get("format") if isinstance(record, dict) else None
    if isinstance(number, int) and number > known:
        numbers = f"its form is number {number}, this one reads up to {known}"
        how = "install that version or a later one to read it"
        raise RunError(f"{file.parent} was written by a newer steady-ppl: {numbers}; {how}")
    if problem := mismatch(record, form):
        raise RunError(f"{file} is damaged: {problem}")
    return record


def read_record(folder: Path) -> dict[str, Any]:
    """Read `run.json`; RunError where there is none, it is damaged, or a newer steady-ppl wrote it."""
    record = read_versioned(folder / RUN_RECORD, BEGUN_RECORD_FORM, RUN_FORMAT, "a run")
    if record["status"] in FINISHED and (problem := mismatch(record, FINISHED_RECORD_FORM)):
        raise RunError(f"{folder / RUN_RECORD} is damaged: {problem}")
    return record
