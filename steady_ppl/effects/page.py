"""The catalogue as a page."""

from __future__ import annotations

from steady_ppl.effects.declaration import VERDICTS, Effect
from steady_ppl.effects.registry import catalogue, not_applicable
from steady_ppl.model.program import Program

HEAD = """# Effects

What `steady effects` prints. `steady simulate MODEL --effect NAME[:AT][:OPTION=NUMBER][=NUMBER[,NUMBER]]` adds one to \
a simulation, `steady add` writes it into a program, `program.with_effect(NAME, VALUE)` does so in Python. `c` is the \
coefficient; without a value it is the typical one.
"""


def page(program: Program | None = None) -> str:
    """All effects, or those that a program could have and why it could not have the others, in Markdown."""
    lines = [HEAD]
    for verdict in dict.fromkeys(VERDICTS.values()):
        chosen = [effect for effect in catalogue(program) if effect.verdict == verdict]
        if chosen:
            header = ["name", *(["at"] * bool(program)), "equation", "unit of c", "typical c", "options", "feels"]
            lines += [f"## {verdict.capitalize()}", "", f"| {' | '.join(header)} |", "|---" * len(header) + "|"]
        for effect in chosen:
            typical = effect.typical if isinstance(effect.typical, tuple) else (effect.typical,)
            cells = (
                f"`{effect.name}`",
                *([", ".join(_places(effect, program))] if program else []),
                effect.text.replace("|", r"\|"),
                effect.unit,
                ", ".join(f"{value:.3g}" for value in typical),
                ", ".join(effect.profiled),
                effect.feels,
            )
            lines.append(f"| {' | '.join(cells)} |".replace("|  |", "| |"))
        lines += [""] * bool(chosen)
    if program is not None:
        lines += [f"## Not for {type(program).__name__}", ""]
        lines += [f"- `{name}`: {reason}" for name, reason in not_applicable(program).items()]
    return "\n".join(lines).rstrip() + "\n"


def _places(effect: Effect, program: Program) -> list[str]:
    """Where it can act, the first where nothing is said."""
    return list(dict.fromkeys(variant.at for variant in effect.variants(program) if variant.at))
