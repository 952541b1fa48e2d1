"""A search in a run folder, where one that was stopped leaves what it has come to."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.model.program import Program
from steady_ppl.runs.fit import Fit, program_source, versions
from steady_ppl.runs.folder import JOURNAL, require_same, run_folder, write_record
from steady_ppl.runs.recipes import fingerprint
from steady_ppl.utils.journal import journal


@contextmanager
def kept_search(
    folder: Path | None,
    given: Program | Fit,
    train: Trajectories,
    valid: Trajectories | None,
    options: Mapping[str, Any],
    *,
    force: bool,
    resume: bool,
) -> Iterator[None]:
    """The folder of a search for the block that makes it; nothing at all where there is none.

    Args:
        folder: the run.
        given: the program or run that is searched.
        train, valid, options: of `discover`.
        force: overwrite a run.
        resume: go on with the journal that is there; everything must be as it was.

    Raises:
        RunError: as `run_folder`, or what is given is not what the search was begun with.
    """
    if folder is None:
        yield
        return
    program = given.program if isinstance(given, Fit) else given
    begun = {
        "program": program_source(program, folder),
        "begun_substeps": program.substeps,
        "recipe": "discover",
        "status": "searching",
        "known_start": options["known_start"],
        "seed": options["seed"],
        "options": {**options, "parameters": _fingerprint_of(program)},
        "option_files": {},
        "table_sha256": fingerprint(train),
        "valid_sha256": fingerprint(valid) if valid is not None else None,
        "versions": versions(),
    }
    if resume:
        require_same(folder, begun)
    with run_folder(folder, force=force, resume=resume):
        if not resume:
            write_record(folder, begun)
        with journal(folder / JOURNAL):
            yield


def _fingerprint_of(program: Program) -> str:
    digest = hashlib.sha256()
    for name, value in program.state_dict().items():
        digest.update(name.encode())
        digest.update(value.numpy(force=True).tobytes())
    return digest.hexdigest()
