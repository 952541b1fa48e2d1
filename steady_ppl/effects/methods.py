"""The methods of a program around which effects act, as lines: what `attach` does, spelt out.

Effects act one around the other, the last one outermost; a method therefore begins with the last one's lines. Two of
one class cannot always be written so, see `fits`: then a class for each is derived one from the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from steady_ppl.effects.declaration import Variant
from steady_ppl.effects.source import WIDTH, Source

ARGUMENTS = {
    "push": ("self", "state", "control", "time", "step"),
    "command": ("self", "state", "control", "time"),
    "history": ("self", "control", "time"),
    "measured": ("self", "state", "measured"),
    "viewpoint": ("self", "state"),
    "spread": ("self", "state", "control", "time", "step"),
    "blur": ("self", "state"),
    "tails": ("self",),
    "colour": ("self",),
}
TRANSITION = ("push", "command", "spread", "colour")
OBSERVE = ("measured", "viewpoint", "blur", "tails", "colour")
USED = {
    "push": "pushed",
    "spread": "widened",
    "colour": "Coloured",
    "measured": "misread",
    "blur": "blurred",
    "tails": "heavy_tailed",
}
INDENT = 8


@dataclass(frozen=True)
class Layer:
    """One effect of a class.

    Attributes:
        variant: the effect.
        source: of its function.
        channels: how many noise channels the program has.
    """

    variant: Variant
    source: Source
    channels: int

    @property
    def form(self) -> str:
        return self.variant.effect.form

    @property
    def name(self) -> str:
        """Of the coefficient, and of what the effect comes to in a method."""
        return self.variant.parameter


def layer_of(variant: Variant, channels: int) -> Layer:
    """An effect that is to be written out."""
    return Layer(variant, Source(variant.effect, ARGUMENTS[variant.effect.form]), channels)


def fits(layer: Layer, inner: Sequence[Layer]) -> bool:
    """Whether an effect can be written in the same class as those around which it acts."""
    forms = {other.form for other in inner}
    if layer.variant.needs_mean:  # what the means are with the others
        return not forms & set(TRANSITION)
    if layer.form == "measured" and layer.source.uses("state"):  # when it is called, the state is that of the others
        return not forms & {"viewpoint", "colour"}
    return layer.form != "colour" or "colour" not in forms


def imports(layers: Sequence[Layer]) -> dict[str, str]:
    """Import statements by the name that they give."""
    found: dict[str, str] = {}
    for layer in layers:
        found |= layer.source.imports()
        needs = [USED[layer.form]] if layer.form in USED else []
        for name in needs + ["channel_means"] * layer.variant.needs_mean:
            found[name] = f"from steady_ppl import {name}"
        if layer.form == "colour":
            found["torch"] = "import torch"
    return found


def methods(layers: Sequence[Layer]) -> list[str]:
    """The methods of a class with some effects, the innermost first."""
    taken = {*sum(ARGUMENTS.values(), ()), *imports(layers), *(layer.name for layer in layers)}
    found: list[str] = []
    for write, forms in (
        (_initial, ("colour",)),
        (_actuators, ("history",)),
        (_transition, TRANSITION),
        (_observe, OBSERVE),
    ):
        chosen = [layer for layer in layers if layer.form in forms]
        if chosen:
            head, *body = write(chosen, taken)
            found += ["", f"    {head}", *(f"{' ' * INDENT}{line}" if line else "" for line in body)]
    return found


def _initial(layers: Sequence[Layer], taken: set[str]) -> list[str]:
    return [
        "def initial(self):",
        "start = super().initial()",
        f"return torch.cat([start, start.new_zeros((*start.shape[:-1], {layers[0].channels}))], -1)",
    ]


def _actuators(layers: Sequence[Layer], taken: set[str]) -> list[str]:
    lines = ["def actuators(self, control, time):", "control = super().actuators(control, time)"]
    for layer in layers:
        head = "return " if layer is layers[-1] else "control = "
        lines += layer.source.written(layer.variant, INDENT, taken).after(head, INDENT)
    return lines


def _transition(layers: Sequence[Layer], taken: set[str]) -> list[str]:
    call, acting, colour = "super().transition(state, control, time, step)", [], None
    lines = ["def transition(self, state, control, time, step):"]
    for layer in reversed(layers):
        written = layer.source.written(layer.variant, INDENT, taken)
        if layer.form == "command":
            lines += written.after("control = ", INDENT)
        elif layer.form == "colour":
            colour = layer.name
            lines.append(f"state, last = state[..., :-{layer.channels}], state[..., -{layer.channels}:]")
            lines += [*written.after("shares = ", INDENT), f"{colour} = Coloured(self, shares, last)"]
            acting.append(colour)
        else:
            if layer.variant.needs_mean:
                lines.append("mean = channel_means(self, super().transition, state, control, time, step)")
            lines += written.after(f"{layer.name} = ", INDENT)
            acting.append(f"{USED[layer.form]}(self, {layer.name})")
    if colour is None:
        return lines + _within(acting, f"return {call}")
    return [*lines, *_within(acting, f"moved = {call}"), f"return {colour}.beside(moved)"]


def _observe(layers: Sequence[Layer], taken: set[str]) -> list[str]:
    lines, acting = ["def observe(self, state):"], []
    for layer in reversed(layers):
        written = layer.source.written(layer.variant, INDENT, taken)
        if layer.form == "viewpoint":
            lines += written.after("state = ", INDENT)
        elif layer.form == "colour":
            lines.append(f"state = state[..., :-{layer.channels}]")
        elif layer.form == "measured":
            expression = f"misread(self, lambda measured: {written.value[0]})"
            if written.body or len(written.value) > 1 or INDENT + len(f"with {expression}:") > WIDTH:
                inner = layer.source.written(layer.variant, INDENT + 4, {*taken} - {layer.name} | {"measured"})
                body = [f"    {line}" for line in inner.after("return ", INDENT + 4)]
                lines += [*([""] if len(lines) > 1 and lines[-1] else []), f"def {layer.name}(measured):", *body, ""]
                expression = f"misread(self, {layer.name})"
            acting.append(expression)
        else:
            lines += written.after(f"{layer.name} = ", INDENT)
            own = "self, " if layer.form not in ("blur", "tails") else ""
            acting.append(f"{USED[layer.form]}({own}{layer.name})")
    return lines + _within(acting, "super().observe(state)")


def _within(acting: Sequence[str], line: str) -> list[str]:
    """A line within what acts on its sites."""
    if not acting:
        return [line]
    head = f"with {', '.join(acting)}:"
    if INDENT + len(head) <= WIDTH:
        return [head, f"    {line}"]
    return ["with (", *(f"    {one}," for one in acting), "):", f"    {line}"]
