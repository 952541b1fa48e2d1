"""Learn how a vehicle moves from noisy, indirect measurements, with its state-space model written as a Pyro program.

`__init__.pyi` lists the public names. Each is imported when it is first used, so that `steady --help` loads no torch.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any

import lazy_loader

from steady_ppl.utils import hooks

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def _imported_when_called(module: str, name: str) -> Callable[..., Any]:
    return lambda *arguments, **options: getattr(import_module(module, __name__), name)(*arguments, **options)


hooks.html = _imported_when_called(".plotting.notebook", "html")
hooks.attach_listed = _imported_when_called(".effects.attach", "attach_listed")
hooks.with_effect = _imported_when_called(".effects.attach", "with_effect")
