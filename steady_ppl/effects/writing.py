"""A program with effects as a file of its own: a subclass that fits, simulates and is criticised like any other."""

from __future__ import annotations

import inspect
import os
from pathlib import Path

import torch

from steady_ppl.effects.attach import added, written_class
from steady_ppl.effects.program_text import program_text, tensor_text
from steady_ppl.effects.source import broken
from steady_ppl.errors import UsageError
from steady_ppl.model.loading import load_program
from steady_ppl.model.program import Program
from steady_ppl.model.validate import probe
from steady_ppl.utils.files import whole_file


def write_program(program: Program, path: str | Path, *, force: bool = False) -> list[str]:
    """Write a program with the effects that were added to it (`program.with_effect(…)`) beside the file of its own.

    Args:
        program: its parameters are carried over as starting values.
        path: the file, after which the class is named: `hovercraft_with_drag.py` holds `HovercraftWithDrag`.
        force: overwrite a file.

    Returns:
        What could not be carried over, a sentence each.

    Raises:
        UsageError: nothing was added, an effect cannot be written out, or the file cannot be written there.
    """
    path = Path(path)
    base, base_file = _base_of(program)
    class_name = _class_name(path, program, base, base_file, force)
    if not added(program):
        raise UsageError(f"program {type(program).__name__} has no effect that its file does not have")
    fresh = _fresh(base)
    values, notes = _carried_over(program, fresh)
    text = program_text(program, class_name, base, base_file.stem, values)
    with whole_file(path, beside=path.with_name(f"partial_{path.name}")) as beside:
        beside.write_text(text, encoding="utf-8")
        probe(load_program(f"{beside}:{class_name}"))
    return notes


def _carried_over(program: Program, fresh: Program) -> tuple[list[str], list[str]]:
    """Lines that set the parameters that are not as the file has them, and what is too much for a file."""
    coefficients, lines, notes = {variant.parameter for variant in added(program)}, [], []
    for name in program._pyro_params:
        value = getattr(program, name).detach()
        if name in coefficients or (hasattr(fresh, name) and torch.equal(value, getattr(fresh, name).to(value))):
            continue
        lines += broken(f"self.{name} = ", [tensor_text(value)], 8)
    if lines:
        lines.insert(0, "# where its own parameters begin; they are learned as before")
    before = fresh.state_dict()
    own = {f"{name}_unconstrained" for name in program._pyro_params}
    weights = [
        name
        for name, value in program.state_dict().items()
        if name not in own and not (name in before and torch.equal(value, before[name].to(value)))
    ]
    if weights:
        modules = ", ".join(dict.fromkeys(name.partition(".")[0] for name in weights))
        notes.append(f"not carried over, being too much for a program file: {modules}; fit them again")
    return lines, notes


def _fresh(base: type[Program]) -> Program:
    with torch.random.fork_rng():
        return base()


def _base_of(program: Program) -> tuple[type[Program], Path]:
    base = written_class(program)
    try:
        file = Path(inspect.getsourcefile(base) or "")
    except (TypeError, OSError):
        file = Path()
    if not file.is_file() or "." in base.__qualname__:
        raise UsageError(f"program {base.__name__} came from no file, so that no other file can derive from it")
    if not file.stem.isidentifier():
        raise UsageError(f"{file.name} cannot be imported by another file: name it in letters, digits and underscores")
    return base, file


def _class_name(path: Path, program: Program, base: type, base_file: Path, force: bool) -> str:
    name = "".join(word.capitalize() for word in path.stem.split("_"))
    if path.suffix != ".py" or not path.stem.isidentifier() or not name.isidentifier():
        raise UsageError(f"{path}: expected a name such as {base_file.stem}_with_drag.py")
    if path.resolve().parent != base_file.resolve().parent:
        raise UsageError(
            f"{path}: the new program imports {base.__name__} from {base_file.name} and has to lie beside it: "
            f"{os.path.relpath(base_file.parent / path.name)}"
        )
    files = {Path(inspect.getsourcefile(one) or "") for one in type(program).__mro__ if issubclass(one, Program)}
    if path.resolve() in {file.resolve() for file in files} or name == base.__name__:
        raise UsageError(f"{path}: the new program derives from {base.__name__}: give it another name")
    if path.exists() and not force:
        raise UsageError(f"{path} exists: choose another name, or --force to overwrite")
    return name
