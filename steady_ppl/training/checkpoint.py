"""Checkpoints of a training run, from which it goes on as if nothing had happened."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from steady_ppl.errors import RunError
from steady_ppl.utils.schema import NUMBER, WHOLE, mismatch
from steady_ppl.utils.tensor_files import damaged, read_tensors, write_tensors
from steady_ppl.utils.text import shown

GROUPS = ("parameters", "averaged", "kept", "memory")  # of tensors of a `Checkpoint`
PROGRESS_FORM = {"step": WHOLE, "history": [{"step": NUMBER}], "kept_step": WHOLE, "best_held_out": [NUMBER]}
"""The form of what a checkpoint says in JSON beside its tensors."""


@dataclass
class Checkpoint:
    """The state of a training run besides its optimiser."""

    parameters: Mapping[str, Tensor]  # the live ones of program and guide
    averaged: dict[str, Tensor]  # the running mean of the program's
    memory: dict[str, Tensor]  # what the guide begins its next E step from
    step: int = 0  # E steps done
    history: list[dict[str, float]] = field(default_factory=list)  # one entry a validation
    kept: dict[str, Tensor] = field(default_factory=dict)  # averaged ones to return; empty before the first validation
    kept_step: int = 0  # that they are from
    best_held_out: list[float] = field(default_factory=list)  # log p(y), one a trajectory


def write_checkpoint(path: Path, state: Checkpoint, optimizer: torch.optim.Optimizer) -> None:
    """Write everything that `read_checkpoint` needs to go on as if nothing had happened."""
    tensors = {f"{group}/{name}": value for group in GROUPS for name, value in getattr(state, group).items()}
    for index, slots in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer/{index}/{slot}": value for slot, value in slots.items()}
    numbers = {name: getattr(state, name) for name in PROGRESS_FORM}
    write_tensors(path, tensors, {name: json.dumps(value) for name, value in numbers.items()})


def read_checkpoint(path: Path, state: Checkpoint, optimizer: torch.optim.Optimizer) -> None:
    """Bring `state` and `optimizer`, made for the same program and guide, to where the checkpoint was written.

    Raises:
        RunError: the file is missing, damaged, or of another program.
    """
    tensors, text = read_tensors(path)
    groups = {group: dict[str, Tensor]() for group in (*GROUPS, "optimizer")}
    for key, value in tensors.items():
        group, _, name = key.partition("/")
        if group not in groups:
            raise damaged(path, f"no checkpoint has {shown(key, 100)}")
        groups[group][name] = value
    if _shapes(groups["parameters"]) != _shapes(state.parameters):
        raise RunError(f"{path.name} in {path.parent} was written by a model with other parameters")
    for group in ("averaged", "kept") if groups["kept"] else ("averaged",):
        if _shapes(groups[group]) != _shapes(state.averaged):
            raise damaged(path, f"the {group} parameters are others than the model's")
    if broken := [name for name, value in groups["parameters"].items() if not value.isfinite().all()]:
        raise damaged(path, f"the parameters {', '.join(broken)} are not finite")
    numbers = _numbers(path, text)
    with torch.no_grad():
        for name, value in groups["parameters"].items():
            state.parameters[name].copy_(value)
    for name, value in groups["averaged"].items():
        state.averaged[name].copy_(value)
    state.kept = {name: value.to(state.averaged[name].device) for name, value in groups["kept"].items()}
    state.memory.update(groups["memory"])
    for name, said in numbers.items():
        setattr(state, name, said)
    slots = _slots(path, groups["optimizer"], optimizer)
    optimizer.load_state_dict({"state": slots, "param_groups": optimizer.state_dict()["param_groups"]})


def _shapes(tensors: Mapping[str, Tensor]) -> dict[str, torch.Size]:
    return {name: value.shape for name, value in tensors.items()}


def _numbers(path: Path, text: Mapping[str, str]) -> dict[str, Any]:
    """The text beside the tensors, by name of the state; a RunError where `write_checkpoint` writes no such thing."""
    try:
        found = {name: json.loads(text[name]) for name in PROGRESS_FORM if name in text}
    except (ValueError, RecursionError):
        raise damaged(path, "the text beside the tensors is no JSON") from None
    if (problem := mismatch(found, PROGRESS_FORM)) is not None:
        raise damaged(path, problem)
    return found


def _slots(path: Path, tensors: Mapping[str, Tensor], optimizer: torch.optim.Optimizer) -> dict[int, dict[str, Tensor]]:
    """What the optimiser remembers of each parameter, by its number; a RunError where one or its shape does not fit."""
    trained = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    slots: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, _, slot = key.partition("/")
        number = int(index) if index.isdecimal() else len(trained)
        if number >= len(trained) or (value.dim() and value.shape != trained[number].shape):
            raise damaged(path, f"the optimiser has no {shown(key, 100)} of shape {tuple(value.shape)}")
        slots.setdefault(number, {})[slot] = value
    if len({frozenset(one) for one in slots.values()}) > 1:
        raise damaged(path, "the optimiser's memory is not complete")
    return slots
