"""What users edit: programs in `models/`, recipes in `inference/`, tours in `notebooks/`; of the checkout, or as the
wheel has them."""

from __future__ import annotations

import shutil
import sysconfig
from pathlib import Path

from steady_ppl.errors import UsageError

ROOMS = ("models", "inference", "notebooks")
DRIVES = {"train": 16, "valid": 16, "test": 32}
TRUTH = "models/hovercraft.py:HovercraftTruth"


def workbench() -> Path:
    """The folder with the rooms: the checkout, else the copy that the wheel carries.

    Raises:
        UsageError: this installation has neither.
    """
    here = Path(__file__).resolve().parent
    for folder in (here.parent, here / "workbench"):
        if all((folder / room).is_dir() for room in ROOMS) and (folder / "inference" / "steady.py").is_file():
            return folder
    raise UsageError(
        f"models, recipes and notebooks are missing from this installation ({sysconfig.get_path('purelib')})"
    )


def furnish(folder: Path) -> list[Path]:
    """Copy the rooms into a folder and simulate first tables of drives there.

    Args:
        folder: is made; may exist if it is empty.

    Returns:
        The tables, of a hovercraft with drag; of its true states only the test table has more than each first row.

    Raises:
        UsageError: the folder has something in it, or cannot be written.
    """
    from steady_ppl.program_file import load_program
    from steady_ppl.progress import stages
    from steady_ppl.simulation import simulate
    from steady_ppl.table import write_table

    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} exists and is not empty: choose another folder")
    try:
        for room in ROOMS:
            shutil.copytree(
                workbench() / room, folder / room, ignore=shutil.ignore_patterns("__pycache__", ".ipynb_checkpoints")
            )
    except OSError as error:
        raise UsageError(f"{folder} cannot be written: {error.strerror} ({error.filename})") from error
    program = load_program(str(folder / TRUTH))
    tables = []
    with stages(*((f"simulating {name}", count) for name, count in DRIVES.items())) as begin:
        for seed, (name, count) in enumerate(DRIVES.items(), 1):
            begin()
            drives = simulate(program, count, seed=seed)
            tables.append(folder / f"{name}.csv")
            write_table(drives if name == "test" else drives.without_truth(keep_start=True), tables[-1])
    return tables
