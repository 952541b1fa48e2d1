"""What users edit: programs in `models/`, recipes in `inference/`, tours in `notebooks/`, grids of fits in `studies/`;
of the checkout, or as the wheel has them."""

import shutil
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from steady_ppl.errors import UsageError
from steady_ppl.utils.progress import stages

FOLDERS = ("models", "inference", "notebooks", "studies")
LEFT_OUT = {"__pycache__", ".ipynb_checkpoints"}
DRIVES_OF_TABLE = {"train": 16, "valid": 16, "test": 32}
TRUE_PROGRAM = "models/hovercraft.py:HovercraftTruth"


def workbench() -> Path:
    """The checkout, else the copy of models, recipes and notebooks in the wheel; UsageError: there is neither."""
    here = Path(__file__).resolve().parents[1]  # the package
    for folder in (here.parent, here / "workbench"):
        if all((folder / room).is_dir() for room in FOLDERS) and (folder / "inference" / "steady.py").is_file():
            return folder
    where = sysconfig.get_path("purelib")
    raise UsageError(f"models, recipes, notebooks and studies are missing from this installation ({where})")


def make_workbench(folder: Path) -> list[Path]:
    """Copy models, recipes and notebooks into a folder, made or empty, and simulate first tables of drives there.

    Returns:
        The tables, of a hovercraft with drag; of its true states only the test table has more than each first row.

    Raises:
        UsageError: the folder has something in it, or cannot be written. What was made by then is removed.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} exists and is not empty: choose another folder")
    from steady_ppl.data.table import write_table  # here, for it loads torch
    from steady_ppl.model.loading import load_program
    from steady_ppl.smc.simulate import simulate

    bench = workbench()
    with cleared_on_failure(folder):
        for file in sorted(file for room in FOLDERS for file in (bench / room).rglob("*") if file.is_file()):
            place = file.relative_to(bench)
            if not LEFT_OUT & {*place.parts}:
                (folder / place).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, folder / place)
        program = load_program(str(folder / TRUE_PROGRAM))
        tables = []
        with stages(*((f"simulating {name}", count) for name, count in DRIVES_OF_TABLE.items())) as begin:
            for seed, (name, count) in enumerate(DRIVES_OF_TABLE.items(), 1):
                begin()
                drives = simulate(program, count, seed=seed)
                tables.append(folder / f"{name}.csv")
                write_table(drives if name == "test" else drives.without_truth(keep_start=True), tables[-1])
        return tables


@contextmanager
def cleared_on_failure(folder: Path) -> Iterator[None]:
    """Make a folder for the block that fills it. If it fails, what is in the folder is removed where that was missing
    or empty before, with the folders that were made for it. UsageError: something in it cannot be written."""
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    fresh = bool(made) or not any(folder.iterdir())
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException as error:
        with suppress(OSError):  # where nothing can be written nothing can be removed
            for place in folder.iterdir() if fresh else ():
                if place.is_dir() and not place.is_symlink():
                    shutil.rmtree(place)
                else:
                    place.unlink()
            for place in made:
                place.rmdir()
        if isinstance(error, OSError):
            raise UsageError(f"{folder} cannot be written: {error.strerror or error}") from error
        raise
