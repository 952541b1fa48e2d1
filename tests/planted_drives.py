"""Drives with effects planted in them, and what `discover` finds on them."""

from __future__ import annotations

import torch
from examples import example

import steady_ppl as st
from steady_ppl.effects import chosen_variant, parsed

DRIVES, ROWS, SETS = 10, 81, 50


def owner():
    """The hovercraft with the noise that simulates it, everything learnable."""
    program = example("hovercraft", torch.float32)
    program.noise = torch.tensor([0.08, 0.08, 0.05])
    program.guesses = ()
    return program


def tables(program, drives: int = DRIVES, rows: int = ROWS, seed: int = 0):
    program.duration = (rows - 1) * program.step
    return st.simulate(program, drives, seed=2 * seed + 1), st.simulate(program, drives, seed=2 * seed + 2)


def with_effects(program, *texts):
    for text in texts:
        name, at, options, value = parsed(text)
        program = program.with_effect(chosen_variant(program, name, at, **options), value)
    return program


def discovered(*texts: str, program=None, seed: int = 0, known_start: bool = True, **more) -> st.Discovery:
    program = owner() if program is None else program
    train, valid = tables(with_effects(program, *texts), seed=seed)
    return st.discover(program, train, valid, known_start=known_start, simulations=SETS, **more)
