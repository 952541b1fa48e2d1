"""What lower packages call of higher ones. The root, which is imported before any of them, puts the functions here."""

from collections.abc import Callable
from typing import Concatenate, TypeVar

Given = TypeVar("Given")

html: Callable[[object], str] = repr
"""The HTML that a notebook shows of a value: `plotting.notebook`."""

attach_listed: Callable[[object], object]
"""Give a program the effects that its class lists: `effects.attach`."""

with_effect: Callable[Concatenate[Given, ...], Given]
"""A copy of a program with an effect: `effects.attach`."""


class Displayed:
    """A value that a notebook shows as HTML."""

    def _repr_html_(self) -> str:
        return html(self)
