"""What a notebook shows of a value when it is a cell's last line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar


class Displayed:
    """A value with an HTML page of its own, which `plotting.notebook` writes.

    Attributes:
        renderer: writes the HTML; the package sets it, so that values need not import what draws them.
    """

    renderer: ClassVar[Callable[[Any], str]]

    def _repr_html_(self) -> str:
        return Displayed.renderer(self)
