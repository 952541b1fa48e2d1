"""Every program and every effect converges in its step: finer substeps change what the noise drowns.

Roll-outs of a second without noise, from states at twice the speeds of a program's own drives, at K, 2 K and, without
an effect, 4 K substeps a row: they differ by less than a tenth of what the process noise does meanwhile.
"""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from examples import MODELS, VEHICLES, each_effect_once_slow, example

from steady_ppl import for_program, seeded, simulate, with_substeps
from steady_ppl.effects import catalogue, chosen_variant
from steady_ppl.model.handlers import AtMean
from steady_ppl.model.substeps import acting_controls
from steady_ppl.smc.simulate import roll_out

PROGRAMS = (
    "hovercraft",
    "hovercraft:HovercraftTruth",
    "gps_boat",
    "gps_boat:GpsBoatTruth",
    "truck",
    "discovered_truck",
    "discovered_truck:HybridTruck",
    "pendulum",
    "linear_gaussian",
    "neural_vehicle:NeuralHovercraft",
    "neural_vehicle:NeuralTruck",
    "hovercraft_unknown_map",
    "unicycle",
    *VEHICLES,
)
# times a program's substeps that an effect of typical size takes: its force is that at a step's beginning
MORE: dict[str, dict[str, int]] = {
    "pendulum": {"linear_drag": 2, "quadratic_drag": 4, "stiffness": 8, "cubic_stiffness": 32},
    "hovercraft": {"linear_drag": 2, "quadratic_drag": 4, "yaw_quadratic_drag": 2, "side_slip": 2}
    | {"wind": 4, "magnus": 4, "weathervane": 32, "added_mass": 2, "caster": 8},
    "gps_boat": {"linear_drag": 4, "quadratic_drag": 8, "yaw_quadratic_drag": 4, "side_slip": 4, "sticky_patch": 2}
    | {
        "coulomb_friction": 2,
        "wind": 16,
        "magnus": 32,
        "weathervane": 32,
        "added_mass": 8,
        "cross_flow": 8,
        "caster": 32,
    },
    "truck": {},
    "discovered_truck": {"actuator_lag": 2},
    "unicycle": {"yaw_quadratic_drag": 2, "response_time": 4, "curvature_steering": 2, "lever_arm": 4}
    | {"crab_angle": 2, "slip_angle": 2, "caster": 4},
    "car": {"quadratic_drag": 2, "yaw_quadratic_drag": 2, "acceleration_limit": 16, "response_time": 4}
    | {"crab_angle": 2, "slip_angle": 4, "caster": 8, "speed_dependent_gain": 2},
}
BOUNDLESS = {  # at twice the speeds
    ("discovered_truck", "command_noise"),  # its noise feeds itself
    ("car", "understeer"),  # it steers to the other side
}
EFFECTS = [
    (name, effect.name) for name in MORE for effect in catalogue(example(name)) if (name, effect.name) not in BOUNDLESS
]
DRAWS, EVERY = 64, 9


def ends(program, state, data, rows, count, handler=None, draws=1):
    """States a second on, `(draws, R, B, D)`."""
    controls = acting_controls(program, data)
    at = torch.stack([rows + index for index in range(count)])
    started = state.expand(draws, *state.shape)
    *_, last = roll_out(program, started, controls[at], data.elapsed[at], data.steps[at], handler=handler)
    return last


@torch.no_grad()
def worst(program, factors: tuple[int, ...] = (1, 2, 4), drives: int = 6) -> float:
    """The largest share of the noise's spread by which roll-outs at K, 2 K … substeps differ."""
    data = for_program(program, simulate(program, drives, seed=1))
    if "speed" in program.control_names:  # what is commanded in speeds drives twice as fast
        data.controls.mul_(2)
    count = round(1 / program.step)
    rows = torch.arange(0, len(data.steps) - count + 1, EVERY)
    state = data.states[rows].clone()
    for index, name in enumerate(program.state_names):
        if name in program.derivatives.values():
            state[..., index] *= 2
    finer = [with_substeps(program, program.substeps * factor) for factor in factors]
    found = [ends(one, state, data, rows, count, AtMean())[0] for one in finer]
    with seeded(3, "noise"):
        noisy = ends(program, state, data, rows, count, draws=DRAWS)
    spread = noisy.std(0).square().mean((0, 1)).sqrt()
    shares = [(one - two).square().mean((0, 1)).sqrt() / spread for one, two in pairwise(found)]
    moving = spread > 0
    return max(float(share[moving].max()) for share in shares)


def test_every_file_of_models_is_looked_at() -> None:
    files = {path.stem for path in MODELS.glob("[!_]*.py")} - {"paper"}  # explicit Euler, by name
    assert files == {name.partition(":")[0] for name in PROGRAMS}


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
def test_a_program_converges_at_its_own_substeps(name) -> None:
    assert worst(example(name)) < 0.1


def test_explicit_euler_does_not() -> None:
    """The same test sees the step that discovered effects came from."""
    assert worst(example("paper:PaperHovercraft")) > 0.3


@pytest.mark.parametrize(("name", "effect"), each_effect_once_slow(EFFECTS))
def test_an_effect_converges(name, effect) -> None:
    """With the program's own substeps, or as many times more as are written above."""
    program = example(name)
    program.duration = 3.0
    program = program.with_effect(chosen_variant(program, effect).effect.variants(program)[0])
    finer = with_substeps(program, program.substeps * MORE[name].get(effect, 1))
    assert worst(finer, factors=(1, 2), drives=18) < 0.1
