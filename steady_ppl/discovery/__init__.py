"""Which physical effect is missing from a program."""

from steady_ppl.discovery.discovery import Discovery, discover

__all__ = ["Discovery", "discover"]
