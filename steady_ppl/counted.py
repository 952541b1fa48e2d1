"""Whole numbers as options: how many of something, and the random seed."""

from __future__ import annotations

from typing import Any

import typer

MOST = 10**9
"""Of anything that is counted: more of it fits in no memory and ends in no lifetime."""


def count(help: str, least: int = 1) -> Any:
    """An option that says how many, `least` or more."""
    return typer.Option(help=help, min=least, max=MOST)


def random_seed() -> Any:
    """The option of a random seed, which a run's record holds in 63 bits."""
    return typer.Option(help="Random seed.", min=0, max=2**63 - 1)
