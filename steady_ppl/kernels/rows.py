"""Functions of a program on all rows of all trajectories, by kernels: values, Jacobians, slopes in its parameters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor, nn

from steady_ppl.errors import ProgramError
from steady_ppl.kernels.chains import Chain, discard_chain, run_chain
from steady_ppl.kernels.codegen import SIMD_LANES
from steady_ppl.kernels.jit import Method, Number, close, compiled, discard, diverged
from steady_ppl.utils.context import bound

COMPARED_EVERY = 16  # of a program's runs on all rows; the first two are compared as well
ROWS_WORTH_COMPILING = 1000  # of all trajectories together
NO_SLOPES = "some of its slopes are no numbers"
_RUNS: WeakKeyDictionary[nn.Module, Counter[Hashable]] = WeakKeyDictionary()
_WHY: ContextVar[dict[str, str] | None] = ContextVar("why functions had no kernel, by their names", default=None)


@contextmanager
def kernel_failures() -> Iterator[dict[str, str]]:
    """Why functions of the block had no kernel where there were rows enough for one, by the functions' names."""
    found: dict[str, str] = {}
    with bound(_WHY, found):
        yield found


def fallback_notes(why: Mapping[str, str]) -> list[str]:
    """What `kernel_failures` gave, as a note for who waits for the result."""
    names = {reason: [name for name in why if why[name] == reason] for reason in why.values()}
    parts = [f"{', '.join(names[reason])}: {reason}" for reason in names]
    return [f"computed in plain torch, without compiled kernels: {'; '.join(parts)}"] if parts else []


class Computed(NamedTuple):
    """A function on all rows."""

    values: Tensor  # (rows, B, V)
    jacobians: list[Tensor]  # in each argument that was asked for, (rows, B, V, ·)
    in_plain_torch: str | None  # why no kernel served; None where one did or was not worth it


def on_all_rows(
    program: nn.Module,
    name: str,
    function: Callable[..., Tensor],
    arguments: dict[str, Tensor],
    along: Sequence[str] = (),
    kernels: bool | None = None,
    outputs: int | None = None,
    chain: Callable[[], Chain] | None = None,
) -> Computed:
    """A function's value and Jacobians, by a kernel where one can serve, and else in plain torch.

    Args:
        program: what the function belongs to.
        name: of the function, by which its kernel is kept.
        function: of one row of one trajectory or of many; it returns `(..., V)`.
        arguments: its arguments in order, each `(rows, B)` or `(rows, B, ·)`.
        along: those in which to differentiate, the first ones.
        kernels: whether a kernel is worth compiling; None: if there are `ROWS_WORTH_COMPILING`.
        outputs: how many of the first components have to be differentiated; None: all.
        chain: gives the function in steps, by which it is computed where it has no kernel as a whole.

    Raises:
        ProgramError: an operation has no derivative.
    """
    in_steps = None if chain is None else partial(_in_steps, program, name, function, arguments, along, chain)
    found = _computed(program, name, function, arguments, kernels, in_steps, along=along, outputs=outputs)
    if isinstance(found, Computed):
        return found
    if isinstance(found, tuple):
        assert not isinstance(found, Slopes)  # only Jacobians are asked for
        _, values, rest = found
        widths = [arguments[at].shape[-1] for at in along]
        by = list(rest.unflatten(-1, (-1, sum(widths))).split(widths, -1)) if along else []
        return Computed(values, by, None)
    if not along:
        return Computed(function(*arguments.values()), [], found)
    inputs, given = list(arguments.values())[: len(along)], list(arguments.values())[len(along) :]
    return Computed(*derivatives(lambda *inputs: function(*inputs, *given), *inputs, outputs=outputs), found)


def derivatives(
    function: Callable[..., Tensor], *inputs: Tensor, outputs: int | None = None
) -> tuple[Tensor, list[Tensor]]:
    """A function's value `(..., V)` and the Jacobians `(..., V, ·)` of its first `outputs` components in each input
    `(..., ·)`, in plain torch; rows and trajectories on the left do not mix, so that a sum's gradient has them all."""
    leaves = [value.detach().clone().requires_grad_() for value in inputs]
    with torch.enable_grad():
        value = function(*leaves)
        rows = [_gradients(component, leaves) for component in value.unbind(-1)[:outputs]]
    return value.detach(), [torch.stack(column, -2) for column in zip(*rows, strict=True)]


def _gradients(component: Tensor, leaves: list[Tensor]) -> Sequence[Tensor]:
    if not component.requires_grad:
        return [torch.zeros_like(leaf) for leaf in leaves]
    try:
        return torch.autograd.grad(component.sum(), leaves, retain_graph=True, materialize_grads=True)
    except (NotImplementedError, RuntimeError) as error:
        why = f"{str(error).splitlines()[0]} (--recipe steady --guide bootstrap takes any)"
        raise ProgramError(f"the model cannot be linearised: {why}") from error


class Slopes(NamedTuple):
    """What a function's components change by with the parameters that a kernel takes, where that is not zero."""

    function: Tensor  # its own values, (rows, B, V)
    components: Tensor  # of the function, one for each slope, (N,)
    values: Tensor  # the slopes, (N, rows, B)
    by_number: Tensor  # what the kernel's parameter of each slope changes by with each learnable number, (N, P)

    def weighted(self, weights: Tensor) -> Tensor:
        """The sum over rows and components of weights `(rows, B, V)` times slopes, `(B, P)` in double precision."""
        by_slope = (weights.movedim(-1, 0)[self.components].double() * self.values.double()).sum(1)
        return by_slope.t() @ self.by_number


InSteps = Computed | Slopes


def slopes_on_all_rows(
    program: nn.Module,
    name: str,
    function: Callable[..., Tensor],
    arguments: dict[str, Tensor],
    numbers: Sequence[Number],
    chain: Callable[[], Chain] | None = None,
) -> Slopes | str | None:
    """A function's slopes in a program's learnable numbers, if by a kernel; why there is none; or None where it is not
    worth one. The arguments are those of `on_all_rows`."""
    in_steps = None if chain is None else partial(_slopes_in_steps, program, name, function, arguments, numbers, chain)
    found = _computed(program, name, function, arguments, None, in_steps, by_parameters=True)
    if found is None or isinstance(found, str | Slopes):
        return found
    assert not isinstance(found, Computed)  # slopes are asked for
    method, values, rest = found
    if not bool(torch.isfinite(rest.sum())):  # a root of zero, say, over which differences step
        return _noted(name, NO_SLOPES)
    components, parameters = torch.tensor(method.slopes, dtype=torch.int64).view(-1, 2).unbind(-1)
    return Slopes(values, components, rest.movedim(-1, 0), method.by_number(program, numbers)[parameters])


def function_of_rows(
    program: nn.Module, name: str, function: Callable[..., Tensor], arguments: dict[str, Tensor]
) -> Callable[..., Tensor]:
    """A function of rows with the program's numbers as they are now, for many calls: by a kernel where one can serve.

    Args:
        program: what the function belongs to.
        name: of the function, by which its kernel is kept.
        function: of one row of one trajectory or of many; it returns `(..., V)`.
        arguments: its arguments in order, each `(rows, B)` or `(rows, B, ·)`, as they may be given to it.
    """
    first = next(iter(arguments.values()))
    if why := _why_no_kernel(first, least=1):
        _noted(name, why)
        return function
    compiled_as, method = _method(program, f"{name} on all rows", function, arguments)
    if isinstance(method, str):
        _noted(name, method)
        return function
    constants, rows = method.parameters(program), -(-SIMD_LANES // first.shape[:2].numel())

    def by_kernel(*values: Tensor) -> Tensor:
        found = _called(method, constants, (torch.cat([value] * rows) if rows > 1 else value for value in values))
        return found[: len(values[0]), :, : method.values]

    if _differs(program, compiled_as, function, arguments, by_kernel(*arguments.values())):
        _noted(name, discard(program, compiled_as))
        return function
    return by_kernel


def _why_no_kernel(first: Tensor, least: int = SIMD_LANES) -> str | None:
    if first.shape[:2].numel() < least:
        return f"fewer than {least} rows"
    if first.device.type != "cpu" or first.dtype != torch.float32:
        return f"{str(first.dtype).removeprefix('torch.')} on {first.device.type}"
    return None


def _method(
    program: nn.Module,
    compiled_as: str,
    function: Callable[..., Tensor],
    arguments: Mapping[str, Tensor],
    **derivatives: Any,
) -> tuple[str, Method | str]:
    """The name under which a function is compiled, and its method or why there is none."""
    examples = {at: value[:1, :1].unsqueeze(0).clone() for at, value in arguments.items()}
    build = partial(Method, program, lambda *given: (function(*given),), examples, {}, **derivatives)
    return compiled_as, compiled(program, compiled_as, build)


def _called(method: Method, constants: Any, values: Iterable[Tensor]) -> Tensor:
    """A method's results `(rows, B, ·)` of arguments `(rows, B)` or `(rows, B, ·)`."""
    values = list(values)
    rows, trajectories = values[0].shape[:2]
    cells = rows * trajectories
    inputs = [value.float().reshape(cells, 1, -1).permute(2, 1, 0).contiguous().numpy() for value in values]
    out = torch.empty(len(method.graph.outputs), 1, cells)
    method.kernel(constants, np.zeros((1, 0), np.float32), inputs, None, out.numpy())
    return out.squeeze(1).t().reshape(rows, trajectories, -1)


def _computed(
    program: nn.Module,
    name: str,
    function: Callable[..., Tensor],
    arguments: dict[str, Tensor],
    kernels: bool | None,
    in_steps: Callable[[], InSteps | str] | None = None,
    **derivatives: Any,
) -> tuple[Method, Tensor, Tensor] | InSteps | str | None:
    """The kernel, the function's value and the derivatives `(rows, B, ·)`; or what it comes to in steps."""
    first = next(iter(arguments.values()))
    if not (first.shape[:2].numel() >= ROWS_WORTH_COMPILING if kernels is None else kernels):
        return None
    if why := _why_no_kernel(first):
        return why
    suffix = "by parameters" if "by_parameters" in derivatives else "on all rows"
    compiled_as, method = _method(program, f"{name} {suffix}", function, arguments, **derivatives)
    if isinstance(method, str):
        stepped = method if in_steps is None else in_steps()
        return _noted(name, stepped) if isinstance(stepped, str) else stepped
    found = _called(method, method.parameters(program), arguments.values())
    values, rest = found[..., : method.values], found[..., method.values :]
    if _differs(program, method, function, arguments, values):
        return _noted(name, discard(program, compiled_as))
    return method, values, rest


def _differs(
    program: nn.Module, run: Hashable, function: Callable[..., Tensor], arguments: Mapping[str, Tensor], values: Tensor
) -> bool:
    """Whether a function's values differ from torch's, as far as this run of its is compared. A run whose rows have all
    diverged does not count."""
    runs = _RUNS.setdefault(program, Counter())
    if runs[run] >= 2 and (runs[run] + 1) % COMPARED_EVERY != 0:
        runs[run] += 1
        return False
    mine, theirs = _subsample(values), function(*(_subsample(value) for value in arguments.values()))
    runs[run] += not bool(diverged(mine, theirs).all())
    return not close(mine, theirs)


def _in_steps(
    program: nn.Module,
    name: str,
    function: Callable[..., Tensor],
    arguments: dict[str, Tensor],
    along: Sequence[str],
    chain: Callable[[], Chain],
) -> Computed | str:
    """A function's value and Jacobians by its steps, see `on_all_rows`."""
    steps = chain()
    found = run_chain(program, name, steps, differentiate=bool(along))
    if isinstance(found, str):
        return found
    shape = steps.moved[1].shape[:2]
    values = found.values.t().unflatten(0, shape)
    if _differs(program, f"{name} in steps", function, arguments, values):
        return discard_chain(program, name, steps)
    widths = [arguments[at].shape[-1] for at in along]
    by = found.slopes.float().permute(2, 0, 1).unflatten(0, shape).split(widths, -1) if along else ()
    return Computed(values, list(by), None)


def _slopes_in_steps(
    program: nn.Module,
    name: str,
    function: Callable[..., Tensor],
    arguments: dict[str, Tensor],
    numbers: Sequence[Number],
    chain: Callable[[], Chain],
) -> Slopes | str:
    """A function's slopes by its steps, one of each component in each learnable number."""
    steps = chain()
    found = run_chain(program, f"{name} by parameters", steps, numbers=numbers)
    if isinstance(found, str):
        return found
    shape = steps.moved[1].shape[:2]
    values = found.values.t().unflatten(0, shape)
    if not bool(torch.isfinite(found.slopes.sum())):
        return NO_SLOPES
    if _differs(program, f"{name} by parameters in steps", function, arguments, values):
        return discard_chain(program, f"{name} by parameters", steps)
    size, count = found.slopes.shape[:2]
    components, by_number = torch.arange(size).repeat_interleave(count), torch.eye(count).double().repeat(size, 1)
    return Slopes(values, components, found.slopes.flatten(0, 1).unflatten(1, shape), by_number)


def note_failures(why: Mapping[str, str]) -> None:
    """Add what `kernel_failures` gave elsewhere to that of the block."""
    if (found := _WHY.get()) is not None:
        found.update(why)


def _noted(name: str, reason: str) -> str:
    note_failures({name: reason})
    return reason


def _subsample(values: Tensor) -> Tensor:
    """Some sixteen of all rows, `(1, ·, ·)`."""
    return values.flatten(0, 1)[None, :: max(1, values.shape[0] * values.shape[1] // SIMD_LANES)]
