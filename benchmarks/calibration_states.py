"""Whether the true states of simulated drives rank uniformly among the guides' draws, and how many an interval holds.

The programs are those of `tests/reference`, of which NUTS knows one drive each, and the linear cart. Every drive has
its own start, noise and measurements; guides see the program that made them and draw 99 paths of each, as an E step
does. SVI's are trained on the drives first.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from calibration_variational import FAMILIES, Variational
from examples import drives, example
from references import PROBLEMS, errors_off, reference, runs
from uniformity import inside, ranks, together, uniform

from steady_ppl import (
    Constant,
    GaussianGuide,
    LookaheadGuide,
    PathGuide,
    Program,
    SMCGuide,
    Trajectories,
    seeded,
    simulate,
)
from steady_ppl.model.program import for_program

DRAWS, DRIVES, RUNS = 99, 1200, 40
CHECKED = 5  # rows of a drive, evenly spread, at which states are ranked
ENDED = Constant(1.0)  # observations count fully, as at the end of a training


def bootstrap(particles: int) -> Callable[[Program], PathGuide]:
    """The paper's guide."""
    return lambda program: SMCGuide(program, particles=particles, draws=DRAWS, tempering=ENDED)


def lookahead(particles: int) -> Callable[[Program], PathGuide]:
    """The guide that users get."""
    return lambda program: LookaheadGuide(program, particles=particles, draws=DRAWS, tempering=ENDED)


def gaussian(program: Program) -> PathGuide:
    """The linearised program's posterior."""
    return GaussianGuide(program, draws=DRAWS, tempering=ENDED)


GUIDES: dict[str, Callable[[Program], PathGuide | Variational]] = {
    "bootstrap 200": bootstrap(200),
    "bootstrap 4000": bootstrap(4000),
    "lookahead 100": lookahead(100),
    "lookahead 1000": lookahead(1000),
    "gaussian": gaussian,
    **{name: partial(Variational, family=family, draws=DRAWS) for name, family in FAMILIES.items()},
}
STATES = ("cart", *PROBLEMS)


def problem(name: str, count: int, seed: int) -> tuple[Program, Trajectories]:
    """A program and drives of it, as it reads them, with their true states; in its own steps, because ranks are uniform
    only where the world is the program."""
    if name == "cart":
        program = example("linear_gaussian").requires_grad_(False)
        return program, drives(program, count, 31, seed=seed)
    known = reference(name)
    made = simulate(known.program, seed=seed, like=runs(known.data, count), substeps=known.program.substeps)
    return known.program, for_program(known.program, made)


def ranked(name: str, guide: str, count: int = DRIVES, seed: int = 1) -> dict:
    """Ranks of the true states of some drives: how uniform they are and how many intervals hold the truth."""
    torch.set_num_threads(1)
    program, data = problem(name, count, seed)
    chosen = GUIDES[guide](program)
    with seeded(seed, guide):
        chosen.refresh(data.without_truth(), 1.0)
    rows = np.linspace(0, len(data.time) - 1, CHECKED).round().astype(int)
    truth, drawn = data.states[rows], chosen.paths.states[:, rows]
    found = ranks(truth.numpy(), drawn.numpy())  # (rows, drives, states)
    p_values = [uniform(found[row, :, state], DRAWS) for row in range(CHECKED) for state in range(found.shape[-1])]
    return {
        "p_value": together(np.array(p_values)),
        "inside_50": inside(found, DRAWS, 0.5).mean((0, 2)).tolist(),  # by drive, whose states are not independent
        "inside_90": inside(found, DRAWS, 0.9).mean((0, 2)).tolist(),
    }


def beside_nuts(name: str, guide: str) -> dict:
    """How many standard errors the worst moment of a posterior that NUTS has stored is off."""
    torch.set_num_threads(1)
    known = reference(name)
    chosen = GUIDES[guide](known.program)
    with seeded("reference"):
        chosen.refresh(runs(known.data, RUNS), 1.0)
    states = chosen.paths.states
    off = ((states.mean((0, 2)) - known.mean) / known.sd).abs().max()
    return {"standard_errors": float(errors_off(known, states).abs().max()), "sds": float(off)}
