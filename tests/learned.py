"""What a fit has learned: the numbers of a program, and how likely it makes other drives."""

from __future__ import annotations

import torch

from steady_ppl import for_program, log_likelihood, seeded


def values(program) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in program.state_dict().items()}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def held_out(program, data) -> float:
    """Log p(y) of other drives, the same random numbers for every program."""
    with seeded(0):
        return (
            log_likelihood(program, for_program(program, data), particles=1000, known_start=True, every=1).mean().item()
        )
