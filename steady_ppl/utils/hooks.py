"""What lower packages call of higher ones. The root, which imports all, puts the functions here."""

from collections.abc import Callable
from typing import Any


def _absent(*arguments: Any, **options: Any) -> Any:
    raise RuntimeError("the root of steady_ppl has not been imported")


html: Callable[[Any], str] = _absent
"""The HTML that a notebook shows of a value: `plotting.notebook`."""

attach_listed: Callable[[Any], Any] = _absent
"""Give a program the effects that its class lists: `effects.attach`."""

with_effect: Callable[..., Any] = _absent
"""A copy of a program with an effect: `effects.attach`."""


class Displayed:
    """A value that a notebook shows as HTML."""

    def _repr_html_(self) -> str:
        return html(self)
