"""FitHand: a program written by hand says where the vehicle was, and another is fitted to that as if it were true."""

import dataclasses

import torch

from steady_ppl import Fit, Trajectories, UsageError, choose_filter, for_program, load_program, run_filter, seeded
from steady_ppl.errors import require
from steady_ppl.model.program import Program

from . import fit_truth


def fit(
    program,
    table: Trajectories,
    valid: Trajectories | None = None,
    *,
    known_start: bool = False,
    hand=None,
    lineages: int = 8,
    particles: int | None = None,
    steps: int = 500,
    learning_rate: float = 1e-2,
    weight_decay: float = 1.0,
    averaging: float = 0.98,
    validate_every: int = 50,
    validation_particles: int | None = None,
    patience: int = 5,
    seed: int = 0,
    **run,
) -> Fit:
    """Fit `program` to paths of the trajectories of `table` by the program `hand`.

    Args:
        program: the state-space model, changed in place.
        table: the training trajectories; true states, where there are any, are used for a known start only.
        valid: held-out trajectories.
        known_start: the first row's true state is given.
        hand: the program written by hand, or where it is (`models/hovercraft.py`); of the same states.
        lineages: paths of each trajectory (the paper: 8 on Hov, 1 on Hov+, 7 on Truck).
        particles: of the filter that draws them; when None 200 of the lookahead proposal, 5000 of others (the
            paper: 100 000).
        steps, learning_rate, weight_decay, averaging, validate_every, validation_particles, patience, run: as in
            `fit_truth`.

    Raises:
        UsageError: no program is given, or its states are others.
    """
    settings = {name: value for name, value in locals().items() if name not in ("program", "table", "valid", "run")}
    require(lineages >= 1, "lineages", lineages, "at least 1")
    if hand is None:
        raise UsageError("fit-hand needs the model written by hand: --hand MODEL, or hand=")
    if isinstance(hand, str):
        hand = load_program(hand)
    require(isinstance(hand, Program), "hand", hand, "a model, or where it is (MODEL.py)")
    settings["hand"] = type(hand).__name__
    if hand.state_names != program.state_names:
        raise UsageError(f"fit-hand: {type(hand).__name__} and {type(program).__name__} have different states")
    data = for_program(hand, table)
    choice = choose_filter(hand, data, known_start=known_start, particles=particles)
    with seeded(seed, "hand"):
        filtered = run_filter(
            hand, data, particles=choice.particles, known_start=known_start, look_ahead=choice.look_ahead
        )
        paths = filtered.paths(lineages).within(data)
    copies = for_program(program, table).subset(torch.arange(len(data)).repeat(lineages))
    believed = dataclasses.replace(copies, states=paths.states.transpose(0, 1).flatten(1, 2))
    return fit_truth.supervised(program, believed, valid, "fit-hand", settings, **run)
