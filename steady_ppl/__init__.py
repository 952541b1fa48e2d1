"""Learn vehicle dynamics from noisy, indirect measurements, with a state-space model written as a Pyro program.

`__init__.pyi` lists the public names. Each is imported when it is first used, so that `steady --help` loads no torch.
"""

from typing import Any

import lazy_loader

from steady_ppl.utils import context

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def _html(value: object) -> str:
    from steady_ppl.plotting.notebook import html

    return html(value)


def _attach_listed(program: Any) -> Any:
    from steady_ppl.effects.attach import attach_listed

    return attach_listed(program)


def _with_effect(program: Any, effect: Any, value: Any = None, **options: Any) -> Any:
    from steady_ppl.effects.attach import with_effect

    return with_effect(program, effect, value, **options)


context.html, context.attach_listed, context.with_effect = _html, _attach_listed, _with_effect
