"""Programs and recipes from files, run afresh under private names, so that no file's neighbours are in the way."""

import importlib.util
import inspect
import itertools
import sys
import traceback
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType

from steady_ppl.errors import ProgramError, SteadyError
from steady_ppl.model.program import Program
from steady_ppl.utils.files import require_file
from steady_ppl.utils.text import one_line

_LOADS = itertools.count()


def load_program(source: str | Path) -> Program:
    """Load a program by path: `models/hovercraft.py` (the class named after the file, or its only one), `mine.py:Boat`.

    The file is run afresh under a private module name; `from .sibling import …` finds files of its own folder. A file
    that does not exist or import, or has no such class, is a ProgramError.
    """
    path, class_name = _parted(str(source))
    file = Path(path)
    module = run_file(file)
    own = [c for c in vars(module).values() if inspect.isclass(c) and c.__module__ == module.__name__]
    programs = [c.__name__ for c in own if issubclass(c, Program)]
    if not class_name:
        class_name = programs[0] if len(programs) == 1 else "".join(word.capitalize() for word in file.stem.split("_"))
    program_class = getattr(module, class_name, None)
    if not (inspect.isclass(program_class) and issubclass(program_class, Program)):
        have = ", ".join(programs) or "none"
        if inspect.isclass(program_class):
            have += f"; its class {class_name} derives from no steady_ppl.Program"
        raise ProgramError(f"{file.name} has no model {class_name}; its models: {have} (choose with {path}:NAME)")
    try:
        return program_class()
    except SteadyError:
        raise
    except (Exception, SystemExit) as error:
        raise ProgramError(f"{class_name}() of {file.name} failed: {one_line(error)}") from error


def program_file(source: str | Path) -> Path:
    """The file of `PATH` or `PATH:CLASS`."""
    return Path(_parted(str(source))[0])


def _parted(source: str) -> tuple[str, str]:
    path, _, class_name = source.rpartition(":")
    return (path, class_name) if class_name.isidentifier() and path else (source, "")


class _UncachedLoader(SourceFileLoader):
    """Compiles what the file says now: a cache goes by size and whole seconds, which misses a digit edited quickly."""

    def get_code(self, fullname: str) -> CodeType:
        return self.source_to_code(self.get_data(self.path), self.path)


def run_file(file: Path) -> ModuleType:
    """Run a Python file as a module of a private package that stands for its folder; ProgramError where it fails."""
    require_file(file, ProgramError)
    if not file.is_file():
        raise ProgramError(f"no file {file}")
    if file.suffix != ".py":
        raise ProgramError(f"{file} is not a Python file")
    folder, package = file.resolve().parent, f"_steady_folder_{next(_LOADS)}"
    sys.modules[package] = parent = ModuleType(package)
    parent.__path__ = [str(folder)]
    name = f"{package}.{file.stem}"
    spec = importlib.util.spec_from_file_location(name, file, loader=_UncachedLoader(name, str(file)))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        message = one_line(error).replace(f"{package}.", ".")
        raise ProgramError(f"{file} does not import: {_place(folder, file, error)}: {message}") from error
    return module


def _place(folder: Path, file: Path, error: BaseException) -> str:
    """The last line in one of the folder's files on the way to an error."""
    if isinstance(error, SyntaxError) and error.lineno is not None:
        return f"line {error.lineno} of {Path(error.filename or file).name}"
    place = file.name
    for frame, line in traceback.walk_tb(error.__traceback__):
        passed = Path(frame.f_code.co_filename)
        if passed.resolve().parent == folder:
            place = f"line {line} of {passed.name}"
    return place
