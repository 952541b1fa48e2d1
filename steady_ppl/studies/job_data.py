"""The drives of a job and the programs of them, which know the noise of their bearings."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from steady_ppl.data.table import read_table
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.datasets.alpha_truck import read_alpha_truck
from steady_ppl.effects import Variant, chosen_variant, parsed
from steady_ppl.effects.attach import with_effects
from steady_ppl.errors import DataError, UsageError
from steady_ppl.model.loading import load_program
from steady_ppl.model.program import Program
from steady_ppl.smc.simulate import simulate
from steady_ppl.studies.job_files import PARTS, TABLES, is_program
from steady_ppl.studies.plan import Job

Split = dict[str, Trajectories]


def drives(job: Job) -> Split:
    """Train, valid and test drives, with their true states where there are any; no test drives for a search.

    Raises:
        DataError: there are none, or they are damaged.
    """
    said = job.data
    if "tables" in said:
        return {part: read_table(_table(Path(said["tables"]), part)) for part in PARTS}
    if "alpha_truck" in said:
        folder, degrees = Path(said["alpha_truck"]), said["sigma_deg"]
        return {part: read_alpha_truck(folder / part, seed=job.seed, sigma_degrees=degrees) for part in PARTS}
    whole = truth(job)
    seeds = {part: 10 * job.seed + i for i, part in enumerate(PARTS, 1)}
    return {part: simulate(whole, said[part], seed=seeds[part]) for part in PARTS if part in said}


def without_effect(job: Job) -> Program:
    """What simulates the drives, without the effect that its owner's program lacks."""
    return told(load_program(job.data["simulate"]), job)


def truth(job: Job) -> Program:
    """What simulates the drives, with the effect that its owner's program lacks."""
    owner, effect = without_effect(job), job.data["effect"]
    return with_effects(owner, [effect], say=lambda line: None) if effect else owner


def planted(job: Job) -> tuple[Variant | None, list[float]]:
    """The effect that the drives of a job have and its owner's program lacks, and how far each component of its
    coefficient is from where it would be absent."""
    if not job.data["effect"]:
        return None, []
    name, at, options, value = parsed(job.data["effect"])
    variant = chosen_variant(without_effect(job), name, at, **options)
    coefficient = variant.coefficient(value, torch.zeros(()))
    return variant, (coefficient - variant.effect.null).flatten().tolist()


def told(program: Program, job: Job) -> Program:
    """With the noise of its bearings, which is known."""
    degrees = job.data.get("sigma_deg")
    if degrees is not None:
        if not hasattr(program, "bearing_sd"):
            raise UsageError(f"{type(program).__name__} has no bearing_sd that sigma_deg could set")
        program.bearing_sd = math.radians(degrees)
    return program


def told_settings(job: Job) -> dict[str, Any]:
    """Settings whose programs know the noise of the bearings as well."""
    if "sigma_deg" not in job.data:
        return job.settings
    return {
        name: told(load_program(value), job) if is_program(value) else value for name, value in job.settings.items()
    }


def _table(folder: Path, part: str) -> Path:
    files = [folder / f"{part}{ending}" for ending in TABLES]
    found = [file for file in files if file.is_file()]
    if not found:
        raise DataError(f"{folder} has no {' and no '.join(file.name for file in files)}")
    return found[0]
