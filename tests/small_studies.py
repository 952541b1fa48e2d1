"""A small study, and what tests of studies write."""

from __future__ import annotations

from pathlib import Path

from small import MODELS

CART = f"{MODELS / 'linear_gaussian.py'}"
STUDY = """
title = "Small"
seeds = [1, 2]
known_start = true

[data]
simulate = "{model}"
train = 2
valid = 2
test = 2

[[method]]
name = "as declared"
program = "{model}"
recipe = "hand"

[[method]]
name = "learned"
program = "{model}"
recipe = "likelihood"
settings = {{validation_particles = [50, 60]}}

[picture]
x = "settings.validation_particles"
y = ["log_likelihood"]
published = {{log_likelihood = {{learned = [[50, -5.0], [60, -4.0]]}}}}
"""


def written(folder: Path, text: str = STUDY, name: str = "study.toml", **words: str) -> Path:
    file = folder / name
    file.write_text(text.format(**{"model": CART} | words))
    return file


def row(key: str, outcome: str = "done", **more: object) -> dict:
    return {"key": key, "outcome": outcome, **more}
