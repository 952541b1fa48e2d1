"""`steady discover`: which effect is missing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from steady_ppl.counted import count, random_seed
from steady_ppl.errors import RunError, UsageError


def discover(
    source: Annotated[str, typer.Argument(metavar="RUN|MODEL", help="A run folder, or a program to fit first.")],
    table: Annotated[Path, typer.Argument(help="Drives to test and fit.")],
    valid: Annotated[
        Path | None, typer.Option(help="Drives to choose by; every second drive of TABLE when not given.")
    ] = None,
    known_start: Annotated[
        bool | None,
        typer.Option(help="Give the first row's x. columns as the exact start; a RUN's own setting when not given."),
    ] = None,
    substeps: Annotated[
        int | None, typer.Option(help="Steps of the program in each row; as its class says when not given.")
    ] = None,
    mix: Annotated[
        bool, typer.Option("--mix", help="Put both tables together and keep every second drive to choose by.")
    ] = False,
    out: Annotated[Path | None, typer.Option("--out", help="Run folder for the improved fit.")] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file; - prints them instead of the text.")
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Draw what was found into this file, for example .png.")] = None,
    simulations: Annotated[int, count("Simulated sets for the calibration.", least=50)] = 200,
    program: Annotated[str | None, typer.Option(help="The run's program, if its file moved or changed.")] = None,
    seed: Annotated[int, random_seed()] = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a search that was stopped.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing run.")] = False,
) -> None:
    """Learn which physical effect a program lacks: none, one by name, several, or a curve that has no name."""
    from steady_ppl.command_parts import present, program_from, write_json
    from steady_ppl.data.table import read_table
    from steady_ppl.discovery.discover import discover as search
    from steady_ppl.discovery.resume import kept_search
    from steady_ppl.model.substeps import with_substeps
    from steady_ppl.model.validate import probe
    from steady_ppl.runs.fit import Fit
    from steady_ppl.runs.folder import DISCOVERY
    from steady_ppl.runs.recipes import fingerprint
    from steady_ppl.utils.files import require_picture, require_place, write_picture
    from steady_ppl.utils.text import say

    is_run = Path(source).is_dir()
    if program and not is_run:
        raise UsageError("--program names the program of a RUN: leave it out")
    if out is None and resume:
        raise UsageError("--resume goes on with a search in its run folder: name it (--out)")
    if out is not None and out.exists() and not (force or resume):
        raise RunError(f"{out} exists: choose another folder, or --force to overwrite, or --resume to go on")
    require_picture(picture)
    require_place(json_file)
    given: Any = Fit.load(source, program) if is_run else program_from(source, seed, substeps)
    if is_run and substeps is not None:
        given.program = with_substeps(given.program, substeps)
        probe(given.program)
    drives, judges = read_table(table), read_table(valid) if valid else None
    options: dict[str, Any] = {"known_start": known_start, "mix": mix, "simulations": simulations, "seed": seed}
    with kept_search(out, given, drives, judges, options, force=force, resume=resume):
        found = search(given, drives, judges, **options)
        figures = {"source": source, **found.figures}
        present(str(found), figures, json_file)
        if out is not None:
            used = {"table_sha256": fingerprint(drives), "valid_sha256": fingerprint(judges) if judges else None}
            found.after.save_into(out, begun=used)
            write_json(out / DISCOVERY, figures)
    if out is not None:
        for note in found.after.notes:
            say(note)
        say(f"{out}: {found.after.program}")
    if picture is not None:
        from steady_ppl.plotting.discovery import discovery_picture

        write_picture(discovery_picture(found), picture)
