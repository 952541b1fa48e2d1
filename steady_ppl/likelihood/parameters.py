"""A program's learnable numbers, one by one."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from operator import attrgetter
from typing import TypeVar

import torch
from torch import Tensor

from steady_ppl.effects import attached
from steady_ppl.errors import UsageError
from steady_ppl.kernels.jit import Number
from steady_ppl.model.program import Program, parameter_name

MAX_LEARNABLE_NUMBERS = 60  # parameters that are screened one by one; networks have more
MIN_RELATIVE_MOVE = 1e-3  # of a number, by which differences move it at least: single precision has seven digits
Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class Element(Number):
    """One number among a program's parameters, in the unconstrained space in which it is learned."""

    owner: str  # the parameter's name
    has_unit: bool = False  # whether it may be any number, of a size that only the data tell; else it is a logarithm
    is_effect: bool = False  # whether it is an effect's, whose typical size is known

    @property
    def name(self) -> str:
        """The parameter's, with an index where it has several numbers."""
        return f"{self.owner}[{self.index}]" if self.parameter.numel() > 1 else self.owner

    def move(self, by: float) -> None:
        self.parameter.data.view(-1)[self.index] += by


def elements(program: Program, *, frozen: bool = False) -> list[Element]:
    """Every learnable number of a program, and of its parameters that are `frozen` as well.

    Raises:
        UsageError: there are more than can be screened one by one.
    """
    steps = {v.parameter: 0.02 * float(v.typical.abs().max()) for v in attached(program) if v.effect.null == 0}
    found = []
    for name, parameter in program.named_parameters():
        if not (parameter.requires_grad or frozen):
            continue
        owner = parameter_name(name)
        has_unit = torch.equal(attrgetter(owner)(program), parameter)
        for index, value in enumerate(parameter.detach().flatten().tolist()):
            step = max(steps.get(owner, 0.01), MIN_RELATIVE_MOVE * abs(value))
            found.append(Element(parameter, index, step, owner, has_unit, owner in steps))
    if len(found) > MAX_LEARNABLE_NUMBERS:
        raise UsageError(
            f"model {type(program).__name__} has {len(found)} learnable numbers: a network cannot be looked at "
            "parameter by parameter. Fit it with the recipe steady; discover the effects that are missing from a "
            "mechanistic model, or from a hybrid of one"
        )
    return found


@contextmanager
def moved(part: Element, by: float) -> Iterator[None]:
    """A program whose parameter is another for a while."""
    before = part.parameter.data.view(-1)[part.index].clone()
    part.move(by)
    try:
        yield
    finally:
        part.parameter.data.view(-1)[part.index] = before


def on_both_sides(part: Element, compute: Callable[[], Result]) -> tuple[Result, Result]:
    """What is computed with a number one step up, and with it one step down."""
    with moved(part, part.step):
        up = compute()
    with moved(part, -part.step):
        return up, compute()


def values_of(parts: Sequence[Element]) -> Tensor:
    """All of them, `(P,)`, in the space in which they are learned."""
    return torch.tensor([float(part.parameter.data.view(-1)[part.index]) for part in parts], dtype=torch.float64)


def set_values(parts: Sequence[Element], values: Tensor) -> None:
    """Make them others, `(P,)`."""
    for part, value in zip(parts, values.tolist(), strict=True):
        part.parameter.data.view(-1)[part.index] = value
