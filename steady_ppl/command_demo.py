"""`steady demo`: the whole loop on drives with hidden effects."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from steady_ppl.utils.text import tell


def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder to write.")] = Path("out/demo"),
    force: Annotated[bool, typer.Option("--force", help="Write into a folder that is no demo's.")] = False,
) -> None:
    """Show the whole loop: check, discover, add, fit again, prove, on a hovercraft whose program has no drag.

    It prints the commands that it runs, with what they found, and keeps drives, programs, runs and pictures.
    """
    from steady_ppl.demonstration import demonstrate

    demonstrate(out, force=force, say=tell)
