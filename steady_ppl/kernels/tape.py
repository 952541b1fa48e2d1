"""What torch computes of a program's tensors alone, noted so that it can be computed again when they have changed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload
from torch.utils._pytree import tree_leaves, tree_map

from steady_ppl.kernels.graph import NotCompilable


@dataclass(frozen=True)
class _Place:
    """Where a value is on the tape."""

    number: int


@dataclass(frozen=True)
class _Step:
    """An operation on values at places; what it makes lies at others."""

    operation: OpOverload
    arguments: tuple[Any, ...]
    keywords: dict[str, Any]
    needs: frozenset[int]
    makes: range

    def run(self, values: list[Tensor]) -> None:
        arguments = [_filled(argument, values) for argument in self.arguments]
        made = self.operation(*arguments, **{name: _filled(value, values) for name, value in self.keywords.items()})
        if len(self.makes) == 1:
            values[self.makes.start] = made[0] if isinstance(made, list | tuple) else made
        else:
            values[self.makes.start : self.makes.stop] = made


def _filled(argument: Any, values: Sequence[Tensor]) -> Any:
    """An argument with values where it has places; `tree_map` takes ten times as long."""
    if isinstance(argument, _Place):
        return values[argument.number]
    return [_filled(part, values) for part in argument] if isinstance(argument, list) else argument


def where(tensor: Tensor) -> tuple[Any, ...]:
    """What tensors have in common that are the same numbers in memory."""
    return tensor.data_ptr(), tensor.shape, tensor.stride(), tensor.dtype


def first_names(tensors: Mapping[str, Tensor]) -> dict[Any, str]:
    """Names of tensors by `where` they are; of several names that are one tensor, the first."""
    names: dict[Any, str] = {}
    for name, tensor in tensors.items():
        if tensor.numel():
            names.setdefault(where(tensor), name)
    return names


class Tape:
    """Values by place: a program's tensors, other tensors, which never change, and what is computed of them.

    It is noted with one program, and runs for any that has tensors of the same names and shapes.

    Args:
        tensors: the program's, by name.
    """

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        self._names = first_names(tensors)
        self._program: dict[int, str] = {}  # place → name
        self._values: list[Tensor] = []  # a tensor that is kept shares its `id` with no later one
        self._places: dict[int, int] = {}  # id → place
        self._steps: list[_Step] = []
        self._varying: set[int] = set()  # places that depend on the program's tensors; of whole numbers, none changes

    def varies(self, value: Tensor) -> bool:
        """Whether a value changes as the program's parameters do."""
        return self.place(value) in self._varying

    def place(self, value: Tensor) -> int:
        """Where a value is; one that is new there is the program's, or never changes."""
        if id(value) not in self._places:
            name = self._names.get(where(value))
            if name is not None:
                self._program[len(self._values)] = name
                if value.dtype.is_floating_point:
                    self._varying.add(len(self._values))
            self._add(value)
        return self._places[id(value)]

    def _add(self, value: Tensor) -> None:
        self._places[id(value)] = len(self._values)
        self._values.append(value)

    def note(self, operation: OpOverload, arguments: Sequence[Any], keywords: dict[str, Any], made: Any) -> None:
        """Note an operation on values that are here, and what it made.

        Raises:
            NotCompilable: it writes into a tensor, whose views and earlier values the tape would lose.
        """
        if operation._schema.is_mutable:
            raise NotCompilable(f"{operation} writes into a tensor that does not depend on the state")
        named = [
            tree_map(lambda leaf: _Place(self.place(leaf)) if isinstance(leaf, Tensor) else leaf, given)
            for given in (tuple(arguments), keywords)
        ]
        needs = frozenset(leaf.number for leaf in tree_leaves(named) if isinstance(leaf, _Place))
        first = len(self._values)
        for value in tree_leaves(made):
            self._add(value)
        if not needs.isdisjoint(self._varying):
            self._varying.update(range(first, len(self._values)))
        self._steps.append(_Step(operation, named[0], named[1], needs, range(first, len(self._values))))

    def cut(self, wanted: Iterable[int]) -> None:
        """End the noting, and leave out what these places do not need."""
        needed, steps = set(wanted), list[_Step]()
        for step in reversed(self._steps):
            if not needed.isdisjoint(step.makes):
                needed |= step.needs
                steps.append(step)
        self._steps = steps[::-1]
        self._places.clear()
        made = {place for step in self._steps for place in step.makes}
        for place in range(len(self._values)):  # these come from the program and from steps, or nothing takes them
            if place in made or place in self._program or place not in needed:
                self._values[place] = torch.empty(0)

    def takes(self, name: str) -> bool:
        """Whether one of the program's tensors is on it."""
        return name in self._program.values()

    def run(self, tensors: Mapping[str, Tensor]) -> list[Tensor]:
        """Values by place, for a program's tensors as they are now."""
        values = [
            tensors[self._program[place]] if place in self._program else v for place, v in enumerate(self._values)
        ]
        for step in self._steps:
            step.run(values)
        return values

    def run_again(self, values: Sequence[Tensor], name: str, tensor: Tensor) -> list[Tensor]:
        """What `run` returned, where one of the program's tensors is another."""
        changed = {place for place, known in self._program.items() if known == name}
        found = [tensor if place in changed else value for place, value in enumerate(values)]
        for step in self._steps:
            if not changed.isdisjoint(step.needs):
                step.run(found)
                changed.update(step.makes)
        return found
