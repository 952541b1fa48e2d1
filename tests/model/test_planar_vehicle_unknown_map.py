"""Landmarks that are learned together with the dynamics."""

from __future__ import annotations

import pytest
import torch
from examples import MODELS, drives, example
from small import HOVERCRAFT, only_start, simulated

from steady_ppl import ProgramError, UnknownMap, UsageError, load_program, log_likelihood, simulate
from steady_ppl.comparison.evaluate import map_errors
from steady_ppl.runs.recipes import find_recipe

UNKNOWN = f"{MODELS / 'hovercraft_unknown_map.py'}:HovercraftUnknownMap"


def test_a_map_is_where_it_was_declared_until_it_is_learned() -> None:
    known, unknown = example("hovercraft:HovercraftTruth"), example("hovercraft_unknown_map")
    assert unknown.measurements == known.measurements
    torch.testing.assert_close(unknown.landmarks, torch.tensor(known.landmarks).double())
    data = drives(known, 2, 9)
    settings = {"particles": 50, "known_start": True, "look_ahead": True, "every": 1}
    values = []
    for program in (known, unknown):
        torch.manual_seed(1)
        values.append(log_likelihood(program, data, **settings))
    torch.testing.assert_close(*values)
    assert map_errors(unknown, known) == {"rms": 0.0, "most": 0.0}


def test_surveyed_landmarks_stay() -> None:
    class Surveyed(UnknownMap, type(load_program(HOVERCRAFT))):
        surveyed = (0, 2)

    program = Surveyed()
    with torch.no_grad():
        program.map += 1.0
    moved = program.landmarks - program.declared
    assert moved.tolist() == [[0, 0], [1, 1], [0, 0], [1, 1]]
    (program.landmarks**2).sum().backward()
    gradient = dict(program.named_parameters())["map"].grad
    assert gradient.bool().all(1).tolist() == [False, True, False, True]


def test_a_map_in_no_frame_is_not_learned() -> None:
    table, vehicle = simulated(rows=9), type(load_program(HOVERCRAFT))
    for about, fixed in (({}, False), ({"surveyed": (0,)}, False), ({"surveyed": (0, 2)}, True)):
        program = type("Surveyed", (UnknownMap, vehicle), about)()
        for known_start in (True, False):
            program.prepare(table, known_start) if known_start or fixed else None
        if not fixed:
            with pytest.raises(UsageError, match="nothing fixes the frame of its map"):
                find_recipe("steady")(program, table, steps=1, progress=False)
    type("Framed", (UnknownMap, vehicle), {"framed_by_start": True})().prepare(table, False)
    with pytest.raises(ProgramError, match="surveyed names landmark 7, there are 0 to 3"):
        type("Beyond", (UnknownMap, vehicle), {"surveyed": (7,)})()


def test_landmarks_in_whole_metres_are_learned_too() -> None:
    vehicle = type(load_program(HOVERCRAFT))
    program = type("Whole", (UnknownMap, vehicle), {"landmarks": ((12, -8), (-6, -4), (-4, 10))})()
    assert program.map.dtype == torch.get_default_dtype() and program.map.requires_grad


@pytest.mark.slow
def test_fit_tv_learns_no_map_that_only_true_starts_would_fix() -> None:
    vehicle, table = type(load_program(HOVERCRAFT)), simulated(rows=9)
    fit = find_recipe("fit-tv")
    with pytest.raises(UsageError, match="fit-tv looks at no true start"):
        fit(type("Unsurveyed", (UnknownMap, vehicle), {})(), table, known_start=True, steps=1, progress=False)
    fit(type("Surveyed", (UnknownMap, vehicle), {"surveyed": (0, 2)})(), table, steps=1, progress=False)


@pytest.mark.slow
def test_a_wrong_map_is_mended_from_bearings_and_known_starts() -> None:
    program = load_program(UNKNOWN)
    truth = load_program(HOVERCRAFT)
    train = only_start(simulate(load_program(f"{HOVERCRAFT}:HovercraftTruth"), 12))
    with torch.no_grad():
        program.map += torch.tensor([[0.8, -0.6], [-0.6, 0.8], [0.6, 0.8], [-0.8, -0.6]])
    before = map_errors(program, truth)["rms"]
    settings = {"draws": 5, "steps": 60, "learning_rate": 2e-2, "progress": False}
    find_recipe("steady")(program, train, known_start=True, **settings)
    assert before == pytest.approx(1.0) and map_errors(program, truth)["rms"] < 0.5
