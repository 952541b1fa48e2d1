"""The text of a program file that derives from another one and adds effects to it."""

from __future__ import annotations

import inspect
import sys
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pyro.distributions as dist
from torch import Tensor

from steady_ppl.effects.attach import added, deviation_names
from steady_ppl.effects.declaration import Variant
from steady_ppl.effects.methods import Layer, fits, imports, layer_of, methods
from steady_ppl.effects.registry import chosen_variant
from steady_ppl.effects.source import WIDTH, broken
from steady_ppl.errors import UsageError
from steady_ppl.model.program import Program, names


def program_text(program: Program, class_name: str, base: type[Program], module: str, values: Sequence[str]) -> str:
    """The file: imports, and a class for as many effects as one can hold."""
    groups: list[list[Layer]] = [[]]
    for variant in added(program):
        _check(program, variant)
        layer = layer_of(variant, len(program.channels))
        if not fits(layer, groups[-1]):
            groups.append([])
        groups[-1].append(layer)
    order = [f"{class_name}{number}" for number in range(1, len(groups))] + [class_name]
    fixed = {
        "constraints": "from pyro.distributions import constraints",
        "PyroParam": "from pyro.nn import PyroParam",
        "dist": "import pyro.distributions as dist",
        "tensor": "from torch import tensor",
        base.__name__: f"from .{module} import {base.__name__}",
    }
    needed = dict(fixed)
    for layers in groups:
        for name, statement in imports(layers).items():
            if needed.setdefault(name, statement) != statement:
                raise UsageError(f"two effects mean different things by {name}: write them to files of their own")
    effects = _listed(variant.name for variant in added(program))
    title = f'"""{base.__name__} with {effects}, as `steady add` wrote it."""'
    lines = [title if len(title) <= WIDTH else f'"""{base.__name__} with effects, as `steady add` wrote it."""', ""]
    lines += _sorted_imports(needed.values())
    above, states = base.__name__, names(base.states)
    for name, layers in zip(order, groups, strict=True):
        first = layers is groups[0]
        lines += ["", "", *_class(program, name, above, layers, states, values if first else [], first and base)]
        states = (*states, *_deviations(program, states, layers))
        above = name
    return "\n".join(lines) + "\n"


def _class(
    program: Program, name: str, above: str, layers: Sequence[Layer], states: Any, values: Sequence[str], base: Any
) -> list[str]:
    lines = [f"class {name}({above}):", *_docstring(above, layers), ""]
    more = [f'"{deviation}"' for deviation in _deviations(program, states, layers)]
    for what in ("states", "resting") if more else ():
        lines += _indented(_entries(f"{what} = ", "()", [f"*{above}.{what}", *more]), 4)
    if base and base.effects:
        lines.append("    effects = ()  # written out here")
    if base and program.substeps != base.substeps:
        lines.append(f"    substeps = {program.substeps}")
    pairs = [f'"{layer.name}": "{layer.variant.written}"' for layer in layers]
    lines += _indented(broken("attached = ", ["{" + ", ".join(pairs) + "}"], 4), 4)
    priors = [f'"{layer.name}": {_prior(program.priors[layer.name])}' for layer in layers]
    lines += _indented(_entries("priors = ", "{}", [f"**{above}.priors", *priors]), 4)
    rates = [f'"{layer.name}": {program.rates[layer.name]:.6g}' for layer in layers if program.rates[layer.name] != 1]
    lines += _indented(_entries("rates = ", "{}", [*rates, f"**{above}.rates"]), 4) if rates else []
    options = len(inspect.signature(base.__init__).parameters) > 1 if base else False
    inner = "**options" if options else ""
    lines += ["", f"    def __init__(self{', ' + inner if inner else ''}):", f"        super().__init__({inner})"]
    lines += _indented([*values, *(_coefficient(program, layer) for layer in layers)], 8)
    return [*lines, *methods(layers)]


def _docstring(above: str, layers: Sequence[Layer]) -> list[str]:
    lines = []
    for layer in layers:
        effect, told = layer.variant.effect, ", ".join(f"{k} {v:.6g}" for k, v in layer.variant.profiled.items())
        lines.append(f"{layer.name}: {effect.text}" + (f", {told}" if told else ""))
        unit = layer.variant.unit
        lines.append(f"    c in {unit}; {effect.feels}" if unit != "1" else f"    {effect.feels}")
    wrapped = [
        part
        for line in lines
        for part in textwrap.wrap(
            line, WIDTH - 4, subsequent_indent="    ", drop_whitespace=True, replace_whitespace=False
        )
    ]
    first = textwrap.wrap(f'"""{above} with {_listed(layer.variant.name for layer in layers)}.', WIDTH - 4)
    clean = [line.replace("\\", "\\\\").replace('"""', "'''") for line in wrapped]
    return _indented([*first, "", *clean, '"""'], 4)


def _listed(found: Iterable[str]) -> str:
    *most, last = found
    return f"{', '.join(most)} and {last}" if most else last


def _coefficient(program: Program, layer: Layer) -> str:
    constraint = "positive" if layer.variant.effect.null else "real"
    return f"self.{layer.name} = PyroParam({tensor_text(getattr(program, layer.name))}, constraints.{constraint})"


def tensor_text(value: Tensor) -> str:
    """`tensor(0.12)`, in as few digits as give the same number."""

    def said(numbers: Any) -> str:
        if isinstance(numbers, list):
            return f"[{', '.join(map(said, numbers))}]"
        return repr(float(str(number(numbers)))) if np.isfinite(numbers) else f'float("{numbers}")'

    number = np.float32 if value.element_size() == 4 else np.float64
    return f"tensor({said(value.detach().cpu().tolist())})"


def _prior(prior: Any) -> str:
    if type(prior) not in (dist.Normal, dist.Cauchy) or prior.loc.dim():
        raise UsageError(f"a prior that is {prior} cannot be written out: expected a normal or Cauchy of one number")
    return f"dist.{type(prior).__name__}({float(f'{prior.loc:.6g}')}, {float(f'{prior.scale:.6g}')})"


def _deviations(program: Program, states: Sequence[str], layers: Sequence[Layer]) -> tuple[str, ...]:
    """The states that a class adds."""
    coloured = [layer.variant for layer in layers if layer.form == "colour"]
    return deviation_names(names(program.channels), states, coloured[0]) if coloured else ()


def _check(program: Program, variant: Variant) -> None:
    """That what the file says of its effects is what it holds."""
    if dict(chosen_variant(program, variant.written).options) != dict(variant.options):
        raise UsageError(f"effect {variant.name}: the name {variant.written} does not say all that it depends on")
    if not variant.parameter.isidentifier():
        raise UsageError(f"effect {variant.name} cannot be written out: {variant.parameter!r} is no name in Python")


def _sorted_imports(statements: Iterable[str]) -> list[str]:
    """Import statements in the formatter's order: the standard library, packages, steady_ppl, the folder's own."""
    plain = {(_section(line.split()[1]), 0, line.split()[1], line) for line in statements if line.startswith("import ")}
    members: dict[str, list[str]] = {}
    for line in dict.fromkeys(statements):
        if line.startswith("from "):
            _, module, _, member = line.split(maxsplit=3)
            members.setdefault(module, []).append(member)
    rows = sorted(plain)
    for module, listed in members.items():
        listed.sort(key=lambda name: (not name.isupper(), not name[0].isupper(), name))
        rows.append((_section(module), 1, module, f"from {module} import {', '.join(listed)}"))
    lines: list[str] = []
    for number, (section, _, _, line) in enumerate(sorted(rows)):
        if number and section != sorted(rows)[number - 1][0]:
            lines.append("")
        lines.append(line)
    return lines


def _section(module: str) -> int:
    if module.startswith("."):
        return 3
    package = module.partition(".")[0]
    return 2 if package == "steady_ppl" else int(package not in sys.stdlib_module_names)


def _entries(head: str, brackets: str, entries: Sequence[str]) -> list[str]:
    opening, closing = brackets[0], brackets[1]
    line = f"{head}{opening}{', '.join(entries)}{closing}"
    return [line] if len(line) + 4 <= WIDTH else [head + opening, *(f"    {entry}," for entry in entries), closing]


def _indented(lines: Iterable[str], indent: int) -> list[str]:
    return [" " * indent + line if line else "" for line in lines]
