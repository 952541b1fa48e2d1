"""Faults planted into the AlphaTruck's recorded commands and bearings, to be found on top of what is really there."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from experiments import truck
from response_surface import move_to_likeliest
from truck_programs import MECHANISTIC, SPACINGS

from inference import steady
from models.discovered_truck import DiscoveredTruck
from steady_ppl import Program, Trajectories, bearings_to, discover, for_program, wrap
from steady_ppl.data.trajectories import concatenated

CALIBRATION = (101, 102, 103, 104)  # draws of the bearings
KEPT_FREE = ("noise", "erratic")  # the rest is known as calibrated: a fault in a gain would be fitted away


@dataclass(frozen=True)
class Fault:
    """Something that is done to recorded drives.

    Attributes:
        text: what.
        named: effects that describe it, with their places and the signs of their coefficients, of which the first that
            is found must be one.
        plant: from the drives and a share of the full size to the altered drives.
    """

    text: str
    named: dict[str, int]
    plant: Callable[[Trajectories, float], Trajectories]


def commands_shifted(data: Trajectories, seconds: float) -> Trajectories:
    """At each row the commands of so long before, the first held."""
    controls = data.controls.clone()
    for drive in range(len(data)):
        when = data.elapsed[:, drive].numpy()
        for column in range(controls.shape[-1]):
            values = np.interp(when - seconds, when, controls[:, drive, column].numpy())
            controls[:, drive, column] = torch.from_numpy(values)
    return replace(data, controls=controls)


def turn_scaled(data: Trajectories, factor: float) -> Trajectories:
    controls = data.controls.clone()
    controls[..., data.control_names.index("turn")] *= factor
    return replace(data, controls=controls)


def landmark_askew(data: Trajectories, degrees: float, landmark: int = 1) -> Trajectories:
    measurements = data.measurements.clone()
    measurements[..., landmark] = wrap(measurements[..., landmark] + math.radians(degrees))
    return replace(data, measurements=measurements)


def bearings_late(data: Trajectories, seconds: float) -> Trajectories:
    """Bearings of where the truck was so long before, with the noise that they have."""
    states = data.states
    assert states is not None
    step = data.steps[0]
    share = (seconds / step).clamp(max=1.0)
    assert bool((seconds / step <= 2).all())
    before = torch.cat([states[:1] - _moved(states[:1], step), states])
    earlier = torch.cat([before[:1] - _moved(before[:1], step), before])
    rows = len(states)
    rest = (seconds / step - share).unsqueeze(-1)  # beyond one row
    share = share.unsqueeze(-1)
    one_before, two_before, now = before[:rows], earlier[:rows], states
    there = now + share * _difference(one_before, now) + rest * _difference(two_before, one_before)
    landmarks = DiscoveredTruck.landmarks
    noise = data.measurements - bearings_to(landmarks, states, sd=0.1).mean
    return replace(data, measurements=wrap(bearings_to(landmarks, there, sd=0.1).mean + noise))


def _moved(states: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    """How far the pose goes in a step."""
    return torch.cat([states[..., 3:] * step.unsqueeze(-1), torch.zeros_like(states[..., 3:])], -1)


def _difference(earlier: torch.Tensor, later: torch.Tensor) -> torch.Tensor:
    change = earlier - later
    change[..., 2] = wrap(change[..., 2])
    return change


FAULTS = {
    "none": Fault("nothing", {}, lambda data, share: data),
    "commands logged late": Fault(
        "commands logged .2 s late",
        {"clock_offset": -1},  # a negative delay means nothing
        lambda data, share: commands_shifted(data, 0.2 * share),
    ),
    "commands act late": Fault(
        "commands act .2 s later than logged",
        {"actuator_delay": 1, "actuator_lag": 1, "clock_offset": 1},
        lambda data, share: commands_shifted(data, -0.2 * share),
    ),
    "turn scaled": Fault(
        "turn commands logged 8 % too large",
        {"gain_error:turn": -1},
        lambda data, share: turn_scaled(data, 1 + 0.08 * share),
    ),
    "landmark askew": Fault(
        "one landmark's bearing 4° off",
        {"landmark_bias:bearing_1": 1},
        lambda data, share: landmark_askew(data, 4 * share),
    ),
    "bearings late": Fault(
        "bearings stamped .15 s late",
        {"clock_offset": 1, "actuator_delay": 1, "actuator_lag": 1},
        lambda data, share: bearings_late(data, 0.15 * share),
    ),
}


def frozen(program: Program) -> Program:
    """The program with its physical parameters known: nothing but its noise is fitted."""
    program = copy.deepcopy(program)
    for name in {name.removesuffix("_unconstrained") for name, _ in program.named_parameters()} - {*KEPT_FREE}:
        value = getattr(program, name).detach().clone()
        delattr(program, name)
        setattr(program, name, value)
    return program


@lru_cache
def calibrated(logs: Path) -> Program:
    """The discovered truck, fitted untempered to the train and valid drives with other draws of the bearings.

    Several draws, since a program that is taken as known must be known better than the drives that test it can tell. A
    response time of the yaw, negative as it comes out, stands for what is left of the yaw's dynamics; it has no
    physical meaning. Without it one draw's drives without a fault are not quiet. Lever and slip are moved to their
    likeliest values.
    """
    parts: dict[str, Trajectories] = {}
    for draw in CALIBRATION:
        train, valid, _ = truck(logs, draw, centred=True)
        parts |= {f"train{draw}": train, f"valid{draw}": valid}
    program = DiscoveredTruck().with_effect("response_time:yaw", 0.0)
    drives = concatenated(**parts).without_truth(keep_start=True)
    settings = MECHANISTIC | {"first_weight": 1.0}
    steady.fit(program, drives, known_start=True, seed=0, progress=False, **settings)
    move_to_likeliest(program, for_program(program, drives), SPACINGS, known_start=True)
    return program


def is_right(record: dict[str, Any]) -> bool:
    """Whether the first effect that was found describes the fault, its place and sign included; of drives without a
    fault, whether nothing was found."""
    named = FAULTS[record["fault"]].named
    if not named:
        return record["verdict"] == "none"
    first = record["found"][0] if record["found"] else None
    return first is not None and named.get(first["effect"], 0) * first["coefficient"][0] > 0


def planted(logs: Path, fault: str, share: float, draw: int) -> dict[str, Any]:
    """What `discover` says of drives with a fault, by the truck as it was calibrated on the drives without.

    The calibration has other draws of the bearings, but the same drives: there is one recording. Faults of a
    landmark and of the bearings' stamps are in the simulated bearings alone, those of commands in the recorded ones.
    """
    torch.set_num_threads(1)
    program = calibrated(logs)
    train, valid, _ = (FAULTS[fault].plant(part, share) for part in truck(logs, draw, centred=True))
    drives = concatenated(train=train, valid=valid).without_truth(keep_start=True)
    began = time.perf_counter()
    figures = discover(frozen(program), drives, known_start=True, seed=draw).figures
    return {
        "fault": fault,
        "share": share,
        "draw": draw,
        "sentence": figures["sentence"],
        "p_value": figures["p_value"],
        "verdict": figures["verdict"],
        "found": figures["effects"],
        "class": figures["class"],
        "confidence": figures["confidence"],
        "fitted": {one["effect"]: one["heldout_gain"] for one in figures["candidates"] if one["heldout_gain"]},
        "program": str(program),
        "notes": figures["notes"],
        "seconds": time.perf_counter() - began,
    }
