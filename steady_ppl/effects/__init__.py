"""Physical effects that a program may lack: what they are, which apply, and how to add one.

Nothing here knows of data beyond what an effect's choices need, or of how an effect is found.
"""

from steady_ppl.effects.attach import (
    attach,
    record,
    restore,
    set_coefficient,
    with_effect,
    with_effects,
    written_class,
)
from steady_ppl.effects.codegen import write_program
from steady_ppl.effects.declaration import Effect, Variant, attached, coefficient
from steady_ppl.effects.registry import catalogue, chosen_variant, find, not_applicable, of_name, parsed, register
from steady_ppl.effects.sizes import Sizes

__all__ = ["Effect", "Sizes", "Variant", "attach", "attached", "catalogue", "chosen_variant", "coefficient", "find"]
__all__ += ["not_applicable", "of_name", "parsed", "record", "register", "restore", "set_coefficient", "with_effect"]
__all__ += ["with_effects", "write_program", "written_class"]
