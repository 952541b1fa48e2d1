"""Physical effects that a program may lack: what they are, which apply, and how to add one."""

from steady_ppl.effects.attach import attach, attached, with_effect
from steady_ppl.effects.declaration import Effect, Variant
from steady_ppl.effects.registry import catalogue, chosen_variant, find, not_applicable, parsed, register

__all__ = [
    "Effect",
    "Variant",
    "attach",
    "attached",
    "catalogue",
    "chosen_variant",
    "find",
    "not_applicable",
    "parsed",
    "register",
    "with_effect",
]
