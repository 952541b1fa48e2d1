"""Which physical effect is missing from a program."""

from steady_ppl.discovery.discovery import discover
from steady_ppl.discovery.result import Discovery

__all__ = ["Discovery", "discover"]
