"""The program of a run as a reader wants it: its equation, its parameters, its text."""

from __future__ import annotations

import inspect
from typing import Any

from latex2mathml.converter import convert
from markupsafe import Markup, escape

from steady_ppl.effects import Effect, attached, written_class
from steady_ppl.plotting.notebook import parameter_rows
from steady_ppl.runs.fit import Fit


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
                "equation": _equation(variant.effect),
                "text": variant.effect.text,
                "feels": variant.effect.feels,
            }
            for variant in attached(program)
        ],
        "parameters": [{"name": name, "value": value} for name, value in parameter_rows(program)],
        "text": text,
        "recipe": fit.recipe,
        "settings": {name: value for name, value in fit.settings.items() if value is not None},
        "seed": fit.seed,
        "known_start": fit.known_start,
        "notes": fit.notes,
    }


def _equation(effect: Effect) -> Markup:
    """As MathML; in words where somebody's own LaTeX is none."""
    try:
        return Markup(convert(effect.equation))
    except Exception:  # the converter raises many kinds
        return escape(effect.text)
