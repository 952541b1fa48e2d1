"""Which effects there are, which of them a program could lack, how users name them, and the page of them."""

import difflib
import math
from dataclasses import replace
from typing import Any

from steady_ppl.effects.catalogue.actuators import ACTUATORS
from steady_ppl.effects.catalogue.forces import FORCES
from steady_ppl.effects.catalogue.noise import NOISE
from steady_ppl.effects.catalogue.sensors import SENSORS
from steady_ppl.effects.catalogue.wheels import WHEELS
from steady_ppl.effects.declaration import VERDICT_OF_FORM, Effect, Variant
from steady_ppl.errors import UsageError
from steady_ppl.model.program import Program

PAGE_HEAD = """# Effects

What `steady effects` prints. `steady simulate MODEL --effect NAME[:AT][:OPTION=NUMBER][=NUMBER[,NUMBER]]` adds one to \
a simulation, `steady add` writes it into a model, `program.with_effect(NAME, VALUE)` does so in Python. `c` is the \
coefficient; without a value it is the typical one.
"""
_EFFECTS: list[Effect] = [*FORCES, *WHEELS, *ACTUATORS, *SENSORS, *NOISE]


def register(effect: Effect) -> Effect:
    """Add an effect of one's own to the catalogue; one of the same name and form is replaced."""
    _EFFECTS[:] = [known for known in _EFFECTS if (known.name, known.form) != (effect.name, effect.form)]
    _EFFECTS.append(effect)
    return effect


def catalogue(program: Program | None = None) -> list[Effect]:
    """All effects, or those that a program could have."""
    return [effect for effect in _EFFECTS if program is None or effect.lacks(program) is None]


def not_applicable(program: Program) -> dict[str, str]:
    """Why each other effect does not apply to a program."""
    known = {effect.name for effect in catalogue(program)}
    return {effect.name: str(effect.lacks(program)) for effect in _EFFECTS if effect.name not in known}


def of_name(name: str) -> list[Effect]:
    """All effects of a name, which differ in what they apply to; UsageError, with the nearest name, without any."""
    if not (named := [effect for effect in _EFFECTS if effect.name == name]):
        near = difflib.get_close_matches(name, [effect.name for effect in _EFFECTS], n=1, cutoff=0.5)
        meant = f"did you mean {near[0]}? " if near else ""
        raise UsageError(f"no effect {name!r}: {meant}there are {', '.join(sorted({e.name for e in _EFFECTS}))}")
    return named


def find(name: str, program: Program) -> Effect:
    """The effect of a name that applies to a program; UsageError where there is none, with the nearest name."""
    return _applicable(of_name(name), program)


def _applicable(effects: list[Effect], program: Program) -> Effect:
    for effect in effects:
        if not (reason := effect.lacks(program)):
            return effect
    raise UsageError(f"effect {effect.name} does not apply to {type(program).__name__}: {reason}")


def parsed(text: str) -> tuple[str, str, dict[str, float], tuple[float, ...] | None]:
    """`NAME[:AT][:OPTION=NUMBER]...[=NUMBER[,NUMBER]]` as name, place, options and value; UsageError for other text."""
    head, *parts = text.strip().split(":")
    if not parts:
        head, equals, numbers = head.partition("=")
        return head, "", {}, _numbers(text, numbers) if equals else None
    *middle, last = parts
    pieces = last.split("=")
    value: tuple[float, ...] | None = None
    is_option = any(pieces[0] in effect.profiled for effect in _EFFECTS if effect.name == head)
    if len(pieces) == 3 or (len(pieces) == 2 and not is_option):
        value = _numbers(text, pieces.pop())
    at, options = "", {}
    for part in [*middle, "=".join(pieces)]:
        option, equals, number = part.partition("=")
        if equals:
            (options[option],) = _numbers(text, number, most=1)
        elif at:
            raise UsageError(f"effect {text}: it is at {at} or at {option}, not at both")
        else:
            at = option
    return head, at, options, value


def chosen_variant(program: Program, effect: str | Effect, at: str = "", **options: Any) -> Variant:
    """An effect with everything settled but its coefficient; what is not said is the first of its choices.

    An effect, a place or an option that does not exist is a UsageError.
    """
    if isinstance(effect, str):
        effect, said, more, value = parsed(effect)
        if value is not None:
            raise UsageError(f"the coefficient of {effect} is given apart from its name")
        at, options = at or said, {**more, **options}
        effect = find(effect, program)
    _applicable([effect], program)
    if unknown := set(options) - set(effect.profiled):
        has = f"it has {', '.join(effect.profiled)}" if effect.profiled else "it has none"
        raise UsageError(f"effect {effect.name} has no option {sorted(unknown)[0]}: {has}")
    for option, number in options.items():
        if not math.isfinite(number):
            raise UsageError(f"effect {effect.name}: {option} is a finite number, got {number}")
    choices = effect.variants(program)
    for index, choice in enumerate(choices):
        if at in (choice.at, str(index)) or (not at and index == 0):
            return replace(choice, options={**choice.options, **options})
    places = ", ".join(dict.fromkeys(choice.at for choice in choices if choice.at))
    raise UsageError(
        f"effect {effect.name} has no place {at!r}: " + (f"it can be at {places}" if places else "there is one only")
    )


def _numbers(text: str, numbers: str, most: int | None = None) -> tuple[float, ...]:
    try:
        found = tuple(float(number) for number in numbers.split(","))
    except ValueError:
        found = ()
    if not found or len(found) > (most or len(found)):
        raise UsageError(f"effect {text}: expected NAME or NAME=NUMBER (NUMBER,NUMBER for two components)")
    return found


def page(program: Program | None = None) -> str:
    """All effects, or those that a program could have and why it could not have the others, in Markdown."""
    lines = [PAGE_HEAD]
    for verdict in dict.fromkeys(VERDICT_OF_FORM.values()):
        if chosen := [effect for effect in catalogue(program) if effect.verdict == verdict]:
            header = ["name", *(["at"] * bool(program)), "equation", "unit of c", "typical c", "options", "feels"]
            lines += [f"## {verdict.capitalize()}", "", f"| {' | '.join(header)} |", "|---" * len(header) + "|"]
        for effect in chosen:
            typical = effect.typical if isinstance(effect.typical, tuple) else (effect.typical,)
            numbers = ", ".join(f"{value:.3g}" for value in typical)
            cells = [effect.text.replace("|", r"\|"), effect.unit, numbers, ", ".join(effect.profiled), effect.feels]
            if program:  # where it can act, the first where nothing is said
                cells.insert(0, ", ".join(dict.fromkeys(one.at for one in effect.variants(program) if one.at)))
            cells.insert(0, f"`{effect.name}`")
            lines.append(f"| {' | '.join(cells)} |".replace("|  |", "| |"))
        lines += [""] * bool(chosen)
    if program is not None:
        lines += [f"## Not for {type(program).__name__}", ""]
        lines += [f"- `{name}`: {reason}" for name, reason in not_applicable(program).items()]
    return "\n".join(lines).rstrip() + "\n"
