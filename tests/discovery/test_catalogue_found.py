"""Every effect of the catalogue is found: at four detection limits, or at its physical maximum where that is less."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from discovery_limits import KNOWN, owner, with_effects
from discovery_sets import EFFECTS, text_of_size
from examples import example

from steady_ppl import Program, simulate
from steady_ppl.discovery.finding import findings
from steady_ppl.discovery.search import Settings, search
from steady_ppl.effects import parsed
from steady_ppl.model.problem import Problem

SEEN = [effect for effect in EFFECTS if effect != "coloured_noise"]  # white and coloured are alike at this noise
DRIVES, ROWS = 12, 81
OF_EACH_KIND = ("coulomb_friction", "actuator_lag", "landmark_bias", "process_noise")
"""What CI looks for; the others take minutes more, in `make test-all`."""
SIZE = 4 * (16 * 100 / (DRIVES * (ROWS - 1))) ** 0.5  # the stored limits are those of 16 drives of 101 rows


OTHERS = {  # of the hovercraft and of other programs: four detection limits, or what is clearly felt
    "hovercraft": (
        *("acceleration_bias=0.32,0", "side_slip:lead=0=0.112", "speed_dependent_gain=0.16", "measurement_noise=1.23"),
        "acceleration_limit=0.6",  # it has no limit: absent is infinite
    ),
    "truck, seen sharply": ("command_noise=1", "curvature_steering=0.5", "lever_arm=0.3"),
    "pendulum": (
        *("stiffness=6.9", "cubic_stiffness=1.05", "coulomb_friction=0.54", "acceleration_bias=0.36"),
        *("sensor_bias:angle=0.041", "clock_offset=0.06", "actuator_delay=0.077"),
    ),
    "hovercraft, seen sharply": ("coloured_noise:translation=0.8",),
    "pendulum of known gain": ("gain_error:torque=0.1",),  # a learned gain is the gain error
}


def marked(text: str, *values: str) -> Any:
    """A test of an effect."""
    marks = pytest.mark.slow if text in OF_EACH_KIND else pytest.mark.exhaustive
    return pytest.param(*values, text, marks=marks)


def program_called(name: str) -> Program:
    """A fresh one, its noise as it declares it."""
    if name.startswith("hovercraft"):
        program = owner()
        if "sharply" in name:
            program.bearing_sd = math.radians(0.02)
        return program
    program = example(name.replace(",", "").partition(" ")[0], torch.float32)
    if "sharply" in name:
        program.noise, program.bearing_sd = torch.tensor([1.0, 1.0, 0.5]), math.radians(1)
    if "known gain" in name:
        program.gain_unconstrained.requires_grad_(False)
    program.guesses = ()  # type: ignore[misc]
    return program


@pytest.mark.parametrize("effect", [marked(effect) for effect in SEEN])
def test_it_is_found(effect: str) -> None:
    known = KNOWN.get(effect, ())
    assert_found(owner(known), owner(known), text_of_size(effect, SIZE))


@pytest.mark.parametrize(
    ("program", "text"), [marked(text, program) for program, texts in OTHERS.items() for text in texts]
)
def test_it_is_found_in_other_programs(program: str, text: str) -> None:
    assert_found(program_called(program), program_called(program), text)


def assert_found(truth: Program, program: Program, text: str) -> None:
    """That an effect planted in the one is the first finding of a search in the other."""
    truth = with_effects(truth, (text,))
    truth.duration = (ROWS - 1) * truth.step
    drives = [simulate(truth, DRIVES, seed=seed) for seed in (1, 2)]
    train, valid = (Problem.of_table(program, table, known_start=True) for table in drives)
    found = findings(search(train, valid.data, Settings(program, sets=50, later_sets=50)))
    name, where, *_ = parsed(text)
    assert found and ":".join(part for part in (name, where) if part) in found[0].aliases, [
        finding.aliases for finding in found
    ]
    assert found[0].kind == found[0].variant.effect.verdict
