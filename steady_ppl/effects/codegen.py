"""A program with effects as a file of its own: a subclass that fits, simulates and is criticised like any other.

The file lists the effects and says in its docstring what they are; `attach` does the rest.
"""

import inspect
import os
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from steady_ppl.effects.attach import written_class
from steady_ppl.effects.declaration import Variant, attached, coefficient
from steady_ppl.effects.registry import chosen_variant
from steady_ppl.errors import UsageError
from steady_ppl.model.loading import load_program
from steady_ppl.model.program import Program, parameter_name
from steady_ppl.model.validate import probe
from steady_ppl.utils.files import whole_file

CODE_COLUMNS = 120  # characters of a line


def write_program(program: Program, path: str | Path, *, force: bool = False) -> list[str]:
    """Write a program with the effects that were added to it (`program.with_effect(…)`) beside the file of its own, and
    return what could not be carried over, a sentence each.

    Args:
        program: its parameters are carried over as starting values.
        path: the file, after which the class is named: `hovercraft_with_drag.py` holds `HovercraftWithDrag`.
        force: overwrite a file.

    Raises:
        UsageError: nothing was added, an effect cannot be named, or the file cannot be written there.
    """
    path = Path(path)
    base, base_file = _base_of(program)
    class_name = _class_name(path, program, base, base_file, force)
    if not attached(program):
        raise UsageError(f"model {type(program).__name__} has no effect that its file does not have")
    values, notes = _carried_over(program, base)
    text = _program_text(program, class_name, base, base_file.stem, values)
    with whole_file(path, beside=path.with_name(f"partial_{path.name}")) as beside:
        beside.write_text(text, encoding="utf-8")
        probe(load_program(f"{beside}:{class_name}"))
    return notes


def _program_text(program: Program, class_name: str, base: type[Program], module: str, values: Sequence[str]) -> str:
    *most, last = (variant.name for variant in attached(program))
    listed = f"{', '.join(most)} and {last}" if most else last
    title = f'"""{base.__name__} with {listed}, as `steady add` wrote it."""'
    lines = [title if len(title) <= CODE_COLUMNS else title.replace(listed, "effects"), ""]
    lines += ["from torch import tensor", ""] if any("tensor(" in line for line in values) else []
    lines += [f"from .{module} import {base.__name__}", "", "", f"class {class_name}({base.__name__}):"]
    lines += [f"    {line}" if line else "" for line in _docstring(program, base, listed)]
    quoted = [f'"{_named(program, variant)}"' for variant in attached(program)]
    line = f"    effects = ({', '.join(quoted)}{',' if len(quoted) == 1 else ''})"
    long = ["    effects = (", *(f"        {one}," for one in quoted), "    )"]
    lines += ["", *([line] if len(line) <= CODE_COLUMNS else long)]
    if program.substeps != base.substeps:
        lines.append(f"    substeps = {program.substeps}")
    if values:
        options = "**options" if len(inspect.signature(base.__init__).parameters) > 1 else ""
        lines += ["", f"    def __init__({', '.join(filter(None, ['self', options]))}):"]
        lines += [f"        super().__init__({options})", *(f"        {line}" for line in values)]
    return "\n".join(lines) + "\n"


def _docstring(program: Program, base: type[Program], listed: str) -> list[str]:
    lines = []
    for variant in attached(program):
        effect, told = variant.effect, ", ".join(f"{k} {v:.6g}" for k, v in variant.profiled.items())
        lines.append(f"{variant.parameter}: {effect.text}" + (f", {told}" if told else ""))
        lines.append(f"    c in {variant.unit}; {effect.feels}" if variant.unit != "1" else f"    {effect.feels}")
    first = textwrap.wrap(f'"""{base.__name__} with {listed}.', CODE_COLUMNS - 4)
    wrapper = textwrap.TextWrapper(CODE_COLUMNS - 4, subsequent_indent="    ", replace_whitespace=False)
    wrapped = [part for line in lines for part in wrapper.wrap(line)]
    return [*first, "", *(line.replace("\\", "\\\\").replace('"""', "'''") for line in wrapped), '"""']


def _named(program: Program, variant: Variant) -> str:
    """An effect with its coefficient, as a class lists it; UsageError unless its text and the file say all of it."""
    if dict(chosen_variant(program, variant.written).options) != dict(variant.options):
        raise UsageError(f"effect {variant.name}: the name {variant.written} does not say all that it depends on")
    known = {"steady_ppl", *(one.__module__ for one in type(program).__mro__)}
    home = variant.effect.function.__module__ or ""
    if home not in known and home.partition(".")[0] not in known:
        raise UsageError(
            f"effect {variant.name} is registered in {home}, which the new file would not load: register it in the "
            "model's own file"
        )
    return f"{variant.written}={','.join(_numbers(coefficient(program, variant).detach().flatten()))}"


def _numbers(value: Tensor) -> Any:
    """Each number in as few digits as give it again, in lists as the tensor has them."""
    number = np.float32 if value.element_size() == 4 else np.float64

    def said(numbers: Any) -> Any:
        return [said(one) for one in numbers] if isinstance(numbers, list) else repr(float(str(number(numbers))))

    return said(value.cpu().tolist())


def _carried_over(program: Program, base: type[Program]) -> tuple[list[str], list[str]]:
    """Lines that set the parameters that are not as the file has them, and what is too much for a file."""
    with torch.random.fork_rng():
        fresh = base()
    coefficients, lines, notes = {variant.parameter for variant in attached(program)}, [], []
    for name in program._pyro_params:
        value = getattr(program, name).detach()
        if name in coefficients or (hasattr(fresh, name) and torch.equal(value, getattr(fresh, name).to(value))):
            continue
        text = str(_numbers(value)).replace("'", "").replace("inf", 'float("inf")')
        line = f"self.{name} = tensor({text})"
        lines.append(line if len(line) <= CODE_COLUMNS - 8 else f"{line}  # fmt: skip  # noqa: E501")
    if lines:
        lines.insert(0, "# where its own parameters begin; they are learned as before")
    before = fresh.state_dict()
    others = {k: value for k, value in program.state_dict().items() if parameter_name(k) not in program._pyro_params}
    changed = [k for k, value in others.items() if k not in before or not torch.equal(value, before[k].to(value))]
    if modules := dict.fromkeys(name.partition(".")[0] for name in changed):
        notes.append(f"not carried over, being too much for a model file: {', '.join(modules)}; fit them again")
    return lines, notes


def _base_of(program: Program) -> tuple[type[Program], Path]:
    base = written_class(program)
    try:
        file = Path(inspect.getsourcefile(base) or "")
    except (TypeError, OSError):
        file = Path()
    if not file.is_file() or "." in base.__qualname__:
        raise UsageError(f"model {base.__name__} came from no file, so that no other file can derive from it")
    if not file.stem.isidentifier():
        raise UsageError(f"{file.name} cannot be imported by another file: name it in letters, digits and underscores")
    return base, file


def _class_name(path: Path, program: Program, base: type, base_file: Path, force: bool) -> str:
    name = "".join(word.capitalize() for word in path.stem.split("_"))
    if path.suffix != ".py" or not path.stem.isidentifier() or not name.isidentifier():
        raise UsageError(f"{path}: expected a name such as {base_file.stem}_with_drag.py")
    if path.resolve().parent != base_file.resolve().parent:
        raise UsageError(
            f"{path}: the new model imports {base.__name__} from {base_file.name} and has to lie beside it: "
            f"{os.path.relpath(base_file.parent / path.name)}"
        )
    files = {Path(inspect.getsourcefile(one) or "") for one in type(program).__mro__ if issubclass(one, Program)}
    if path.resolve() in {file.resolve() for file in files} or name == base.__name__:
        raise UsageError(f"{path}: the new model derives from {base.__name__}: give it another name")
    if path.exists() and not force:
        raise UsageError(f"{path} exists: choose another name, or --force to overwrite")
    return name
