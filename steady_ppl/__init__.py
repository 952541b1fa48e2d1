"""Learn how a vehicle moves from noisy, indirect measurements, with its state-space model written as a Pyro program.

`__init__.pyi` lists the public names. Each is imported when it is first used, so that `steady --help` loads no torch.
"""

from typing import Any

import lazy_loader

from steady_ppl.utils.display import Displayed

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def _html(value: Any) -> str:
    from steady_ppl.plotting.notebook import html

    return html(value)


Displayed.renderer = staticmethod(_html)
