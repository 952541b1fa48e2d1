"""The program of a run as a reader wants it: its equation, its parameters, its text."""

from __future__ import annotations

import inspect
from typing import Any

import torch
from latex2mathml.converter import convert

from steady_ppl.effects import attached, written_class
from steady_ppl.fit import Fit

MOST = 12  # numbers of a parameter that are shown


def program_page(label: str, fit: Fit) -> dict[str, Any]:
    """Name, equations of its effects as MathML, values of its parameters, its class as it is written."""
    program = fit.program
    kind = written_class(program)
    try:
        text = inspect.getsource(kind)
    except (TypeError, OSError):
        text = ""
    return {
        "label": label,
        "name": kind.__name__,
        "about": inspect.cleandoc(kind.__doc__ or ""),
        "effects": [
            {
                "name": variant.label,
                "equation": convert(variant.effect.equation),
                "text": variant.effect.text,
                "feels": variant.effect.feels,
            }
            for variant in attached(program)
        ],
        "parameters": _parameters(program),
        "text": text,
        "recipe": fit.recipe,
        "settings": {name: value for name, value in fit.settings.items() if value is not None},
        "seed": fit.seed,
        "known_start": fit.known_start,
        "notes": fit.notes,
    }


@torch.no_grad()
def _parameters(program: Any) -> list[dict[str, str]]:
    rows = []
    for name in dict.fromkeys(name.removesuffix("_unconstrained") for name, _ in program.named_parameters()):
        value: Any = program
        for part in name.split("."):
            value = getattr(value, part)
        numbers = value.flatten().tolist()
        shape = f" (of {' × '.join(map(str, value.shape))})" if len(numbers) > MOST else ""
        said = ", ".join(f"{number:.4g}" for number in numbers[:MOST]) + (f", …{shape}" if shape else "")
        rows.append({"name": name, "value": said})
    return rows
