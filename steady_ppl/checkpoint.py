"""Checkpoints: tensors and a little text in one safetensors file, written beside and renamed. Never pickle."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from steady_ppl.errors import RunError
from steady_ppl.whole_file import whole_file


@dataclass
class Checkpoint:
    """The state of a training run besides its optimiser.

    Attributes:
        step: E steps done.
        history: one entry a validation.
        parameters: the live parameters of program and guide.
        averaged: the running mean of the program's parameters.
        kept: the averaged parameters that would be returned now, empty before the first validation.
        kept_step: the step that they are from.
        best_held_out: the best held-out log p(y) so far, one a trajectory.
        memory: what the guide begins its next E step from.
    """

    step: int
    history: list[dict[str, float]]
    parameters: Mapping[str, Tensor]
    averaged: dict[str, Tensor]
    kept: dict[str, Tensor]
    kept_step: int = 0
    best_held_out: list[float] = field(default_factory=list)
    memory: dict[str, Tensor] = field(default_factory=dict)


def write_tensors(path: Path, tensors: Mapping[str, Tensor], text: Mapping[str, str] | None = None) -> None:
    """Write tensors and text to a safetensors file, whole or not at all."""
    kept = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    with whole_file(path, RunError) as beside:
        try:
            save_file(kept, beside, dict(text or {}))
        except SafetensorError as error:  # what the file system refuses comes as its own
            raise RunError(f"{path} cannot be written: {error}") from error


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read a file of `write_tensors`.

    Raises:
        RunError: the file is missing or damaged.
    """
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118
    except FileNotFoundError:
        raise RunError(f"no file {path.name} in {path.parent}") from None
    except SafetensorError as error:
        raise RunError(f"{path.name} in {path.parent} is damaged ({error})") from error


def write_checkpoint(path: Path, state: Checkpoint, optimizer: torch.optim.Optimizer) -> None:
    """Write everything that `read_checkpoint` needs to go on as if nothing had happened."""
    tensors = {f"parameters/{name}": value for name, value in state.parameters.items()}
    tensors |= {f"averaged/{name}": value for name, value in state.averaged.items()}
    tensors |= {f"kept/{name}": value for name, value in state.kept.items()}
    tensors |= {f"memory/{name}": value for name, value in state.memory.items()}
    for index, slots in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer/{index}/{slot}": value for slot, value in slots.items()}
    numbers = {name: getattr(state, name) for name in ("step", "history", "kept_step", "best_held_out")}
    write_tensors(path, tensors, {name: json.dumps(value) for name, value in numbers.items()})


def read_checkpoint(path: Path, state: Checkpoint, optimizer: torch.optim.Optimizer) -> None:
    """Bring `state` and `optimizer`, made for the same program and guide, to where the checkpoint was written.

    Raises:
        RunError: the file is missing, damaged, or of another program.
    """
    tensors, text = read_tensors(path)
    groups: dict[str, dict[str, Tensor]] = {"parameters": {}, "averaged": {}, "kept": {}, "memory": {}, "optimizer": {}}
    for key, value in tensors.items():
        group, _, name = key.partition("/")
        groups[group][name] = value
    if {n: v.shape for n, v in groups["parameters"].items()} != {n: v.shape for n, v in state.parameters.items()}:
        raise RunError(f"{path.name} in {path.parent} was written by a program with other parameters")
    with torch.no_grad():
        for name, value in groups["parameters"].items():
            state.parameters[name].copy_(value)
    for name, value in groups["averaged"].items():
        state.averaged[name].copy_(value)
    state.kept = {name: value.to(state.averaged[name].device) for name, value in groups["kept"].items()}
    state.memory.update(groups["memory"])
    for name in ("step", "history", "kept_step", "best_held_out"):
        setattr(state, name, json.loads(text[name]))
    slots: dict[int, dict[str, Tensor]] = {}
    for key, value in groups["optimizer"].items():
        index, _, slot = key.partition("/")
        slots.setdefault(int(index), {})[slot] = value
    optimizer.load_state_dict({"state": slots, "param_groups": optimizer.state_dict()["param_groups"]})
