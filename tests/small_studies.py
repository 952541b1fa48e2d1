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

UNFITTED = f"""{STUDY[: STUDY.index("[[method]]", STUDY.index("recipe"))]}[[method]]
name = "again"
program = "{{model}}"
recipe = "hand"
settings = {{{{}}}}

[picture]
x = "data.train"
y = ["log_likelihood"]
"""


def search_study(**settings: object) -> str:
    """The text of a study that searches what its data lack."""
    text = STUDY[: STUDY.index("[[method]]")].replace("test = 2\n", 'effect = ["", "linear_drag=0.5"]\n')
    said = ", ".join(f"{name} = {value}" for name, value in settings.items())
    return f'task = "discover"{text}[[method]]\nname = "it"\nprogram = "{{model}}"\nsettings = {{{{{said}}}}}\n'


def written(folder: Path, text: str = STUDY, name: str = "study.toml", **words: str) -> Path:
    file = folder / name
    file.write_text(text.format(**{"model": CART} | words))
    return file


def row(key: str, outcome: str = "done", **more: object) -> dict:
    return {"key": key, "outcome": outcome, **more}
