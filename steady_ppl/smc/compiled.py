"""The particle filter as machine code: the program's methods are kernels, and numba goes from one row to the next."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from torch import Tensor

from steady_ppl.kernels.codegen import SIMD_LANES
from steady_ppl.kernels.graph import NotCompilable
from steady_ppl.kernels.jit import Method, close, compiled, discard
from steady_ppl.model.handlers import Observing, Recording, Standardised, running
from steady_ppl.model.substeps import advance
from steady_ppl.smc.genealogy import FilterState, History, Run, event_dims
from steady_ppl.smc.proposal import Proposal, Steered
from steady_ppl.smc.resampling import Resampler, by_component, choose, systematic
from steady_ppl.smc.stepping import Stepping

BLOCK_BYTES = 2**22  # bytes of memory for rows' results, asked for at a time
STREAMS = 64  # random generators side by side, each with a seed of torch's
Array = np.ndarray[Any, Any]
OnFrame = Callable[[int, Tensor, Tensor, Tensor], None]
_intrinsic: Any = intrinsic  # whose annotations count the typing context among the arguments of a call


class _Methods:
    """`transition` and `observe` of a program as kernels, with the proposal's functions in them."""

    def __init__(self, plain: Stepping, state: Tensor, proposal: Proposal) -> None:
        program, one, first = plain.program, (1, 1, 1), state[:1, :1].unsqueeze(1)
        along, seen_by = map(_examples, _given(plain, proposal))
        with torch.no_grad(), running(*one), Recording() as seen:
            advance(program, first, *list(along.values())[:3])
        self.event_dims = event_dims(seen)
        self.sizes = {site: value.numel() for site, value in seen.values.items()}
        self.channels, self.width, held = sum(self.sizes.values()), state.shape[-1], program.substeps > 1

        def transition(state: Tensor, uniform: Tensor, *given: Tensor) -> Any:
            noise, ratio = proposal.steered(state, *standard_normal(uniform, self.channels), *given[3:])
            with running(*one), Recording() as recording, Standardised(noise):
                moved = advance(program, state, *given[:3])
            return (moved, *((noise,) if held else recording.values.values()), ratio)

        def observe(state: Tensor, measurement: Tensor, observed: Tensor, weight: Tensor, *given: Tensor) -> Any:
            with running(*one), Recording() as recording, Observing(measurement, observed, weight):
                program.observe(state)
            return recording.total(), proposal.future(state, *given)

        self.uniforms = 2 * ((self.channels + 1) // 2) + 1
        uniform = torch.full((*one, self.uniforms), 0.5)
        self.transition = Method(program, transition, {"state": first, "uniform": uniform}, along)
        self.observe = Method(program, observe, {"state": first}, seen_by)
        if (self.transition.values, self.observe.values) != (self.width + self.channels + 1, 2):
            raise NotCompilable("its results for one particle have other shapes: it mixes particles or trajectories")


def standard_normal(uniform: Tensor, channels: int) -> tuple[Tensor, Tensor]:
    """Standard normal numbers `(..., C)` of as many uniform ones in [0, 1), or one more (Box and Muller 1958), and the
    last of these, `(..., 1)`."""
    first, second, rest = uniform.split([uniform.shape[-1] // 2, uniform.shape[-1] // 2, 1], -1)
    radius, angle = (-2 * (1 - first).log()).sqrt(), 2 * math.pi * second
    return torch.cat([radius * angle.cos(), radius * angle.sin()], -1)[..., :channels], rest


def _given(plain: Stepping, proposal: Proposal) -> tuple[list[Tensor], list[Tensor]]:
    """What `transition` takes of each interval and `observe` of each row, `(rows, B, ...)` each."""
    data = plain.data
    weight = torch.as_tensor(plain.observation_weight, dtype=torch.float32).expand(data.time.shape)
    moved = [plain.controls[:-1], data.elapsed[:-1], data.steps, *proposal.of_intervals()]
    return moved, [data.measurements, data.observed, weight, *proposal.of_rows()]


def _examples(given: Sequence[Tensor]) -> dict[str, Tensor]:
    kinds = (values if values.dtype == torch.bool else values.float() for values in given)
    return {f"given {index}": values[:1, :1] for index, values in enumerate(kinds)}


class CompiledFilter:
    """A filter that runs through all rows of a table, for what `compiled_filter` is given."""

    def __init__(self, methods: _Methods, plain: Stepping, proposal: Proposal) -> None:
        self.methods, self.plain, self.proposal = methods, plain, proposal
        self.constants = methods.observe.parameters(plain.program), methods.transition.parameters(plain.program)
        moved, measured = _given(plain, proposal)
        self.measured, self.moved = _columns(measured), _columns(moved)
        self.observed, self.inside = plain.data.observed.any(-1).any(-1).numpy(), plain.data.rows.numpy()

    def run(self, state: FilterState, threshold: float, keep_history: bool, on_frame: OnFrame | None) -> Run:
        """Go from the first row to the last; the arguments are those of `particle_filter`, and the effective sample
        size below which a trajectory is resampled."""
        methods, last, ahead = self.methods, len(self.moved), self.proposal.looks_ahead
        particles, trajectories, _ = state.states.shape
        outputs = methods.transition.kernel.outputs
        rows = 1 if on_frame else max(1, BLOCK_BYTES // (4 * outputs * trajectories * particles))
        kept, figures = keep_history or on_frame is not None, np.empty((3, last + 1, trajectories))
        begin = by_component(state.states)
        log_weights, roots = (part.t().clone(memory_format=torch.contiguous_format) for part in state[1:])
        generator = torch.randint(2**32, (4, STREAMS)).to(torch.uint32).numpy()
        uniform = np.empty(-(-methods.uniforms * trajectories * particles // STREAMS) * STREAMS, np.float32)
        intervals, parents, room = list[Tensor](), list[Tensor | None](), list[tuple[Tensor, ...]]()
        for first in range(0, last + 1, rows):
            moves = min(rows, last - first)
            thresholds = torch.rand(moves, trajectories, dtype=torch.float64)
            if kept or len(room) < 2:  # one to fill, and one whose last row is gone on from
                room.append(_room(moves, outputs, trajectories, particles))
            moved, ancestors, resampled = room.pop() if kept else room[first // rows % 2]
            seen = log_weights.t().clone() if on_frame else log_weights[:0]
            weighed = torch.empty_like(log_weights) if on_frame else log_weights[:0]
            _go(
                (methods.observe.kernel.address, methods.transition.kernel.address),
                self.constants,
                (self.measured, self.moved, self.observed, self.inside),
                (first, min(first + rows, last + 1), threshold, ahead),
                (generator, uniform, thresholds.numpy()),
                (begin.numpy(), log_weights.numpy(), roots.numpy()),
                (moved.numpy(), ancestors.numpy(), resampled.numpy()),
                weighed.numpy(),
                figures,
            )
            if on_frame is not None:
                on_frame(first, begin.permute(2, 1, 0), seen, weighed.t())
            if keep_history:
                intervals += moved
                parents += [one if flag else None for one, flag in zip(ancestors, resampled.tolist(), strict=True)]
            if moves:
                begin = moved[moves - 1, : methods.width]
        end = FilterState(begin.permute(2, 1, 0), log_weights.t(), roots.t())
        history = History(state.states, intervals, parents, methods.sizes, methods.event_dims)
        evidence, effective_sizes, blown_up = torch.from_numpy(figures)
        return Run(end, evidence, effective_sizes, blown_up, history if keep_history else None)

    def transition(self, row: int, state: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Move states `(N, B, D)` on from a row by uniform numbers `(N, B, ·)`: the next ones, the noise of all
        channels and the proposal's log ratio `(N, B)`."""
        methods = self.methods
        found = _called(methods.transition, self.constants[1], self.moved[row], [state, uniform])
        moved, values, ratio = found.split([methods.width, methods.channels, 1], -1)
        return moved, values, ratio[..., 0]

    def log_density(self, row: int, state: Tensor) -> Tensor:
        """Tempered log-density of a row's measurements, and what the proposal thinks of later ones, `(N, B, 2)`."""
        return _called(self.methods.observe, self.constants[0], self.measured[row], [state])

    def agrees(self, state: Tensor) -> bool:
        """Whether the kernels come to the numbers of plain torch, of a few states `(N, B, D)` at the last interval."""
        row, proposal, size = len(self.moved) - 1, self.proposal, state.shape[:2]
        uniform = torch.rand(*size, self.methods.uniforms, generator=torch.Generator().manual_seed(0))
        moved, values, ratio = self.transition(row, state, uniform)
        own = standard_normal(uniform, self.methods.channels)
        noise, expected = proposal.steered(state, *own, *(given[row] for given in proposal.of_intervals()))
        plain, sites = self.plain.transition(row, state, noise.float())
        flat = [sites[site].expand(*size, *sites[site].shape[2:]).reshape(*size, -1) for site in self.methods.sizes]
        future = proposal.future(moved, *(given[row] for given in proposal.of_rows()))
        density = torch.stack([self.plain.log_density(row, moved).expand(size), future.float()], -1)
        pairs = [(moved, plain), (values, torch.cat(flat, -1)), (ratio, expected.float())]
        pairs += list(zip(self.log_density(row, moved).unbind(-1), density.unbind(-1), strict=True))
        return all(close(mine, theirs.expand_as(mine)) for mine, theirs in pairs)


def compiled_filter(plain: Stepping, state: Tensor, proposal: Proposal, resampler: Resampler) -> CompiledFilter | str:
    """A filter of a program's own lines as machine code, or why there is none.

    On some of the particles' starts, `(N, B, D)`, its kernels are compared with plain torch.
    """
    if state.device.type != "cpu" or state.dtype != torch.float32:
        return f"{str(state.dtype).removeprefix('torch.')} on {state.device.type}"
    if state.shape[0] < SIMD_LANES:
        return f"fewer than {SIMD_LANES} particles"
    if resampler is not systematic:
        return "a resampler of one's own"
    if type(proposal) is not Proposal and not (isinstance(proposal, Steered) and type(proposal).step is Steered.step):
        return "a proposal whose step is no function of one particle"
    name = "filter that looks ahead" if proposal.looks_ahead else "filter"
    methods = compiled(plain.program, name, lambda: _Methods(plain, state, proposal))
    if isinstance(methods, str):
        return methods
    found = CompiledFilter(methods, plain, proposal)
    return found if found.agrees(state[:SIMD_LANES]) else discard(plain.program, name)


def _room(rows: int, outputs: int, trajectories: int, particles: int) -> tuple[Tensor, ...]:
    """Memory for some intervals' results, their ancestors, and whether these count; by numpy: by torch it would go back
    to the system, and its fresh pages take a third of a filter's time."""
    size = trajectories, particles
    moved, ancestors = np.empty((rows, outputs, *size), np.float32), np.empty((rows, *size), np.int64)
    return tuple(torch.from_numpy(part) for part in (moved, ancestors, np.zeros(rows, np.bool_)))


def _called(method: Method, constants: Array, uniform: Array, inputs: list[Tensor]) -> Tensor:
    """A kernel's results `(N, B, ·)` of particles `(N, B, ·)`."""
    out = torch.empty(method.kernel.outputs, *inputs[0].shape[1::-1])
    method.kernel(constants, uniform, [by_component(values).numpy() for values in inputs], None, out.numpy())
    return out.permute(2, 1, 0)


def _columns(parts: Sequence[Tensor]) -> Array:
    """What differs between rows and trajectories, `(rows, B, columns)`, for a kernel."""
    flat = [part.reshape(*part.shape[:2], -1).float() for part in parts]
    return torch.cat(flat, -1).contiguous().numpy()


# --- from row to row --------------------------------------------------------------------------------------------------


@_intrinsic
def _call(typing, address, arguments):  # type: ignore[no-untyped-def]
    """Call a kernel at an address with whole numbers, addresses of arrays among them."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        given = cgutils.unpack_tuple(builder, values[1])
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in given])
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), given)
        return context.get_dummy_value()

    return types.void(address, arguments), generate


@njit(cache=True)
def _draw(generator: Array, out: Array) -> None:
    """Fill `out`, a multiple of `STREAMS`, with uniform numbers in [0, 1) by xoshiro128+ (Blackman and Vigna 2021),
    whose upper 24 bits are taken."""
    a, b, c, d = generator[0], generator[1], generator[2], generator[3]
    for first in range(0, len(out), len(a)):
        numbers = out[first : first + len(a)]
        for i in range(len(a)):
            numbers[i] = np.float32(np.int32(np.uint32(a[i] + d[i]) >> np.uint32(8))) * np.float32(2.0**-24)
            shifted = np.uint32(b[i] << np.uint32(9))
            c[i] ^= a[i]
            d[i] ^= b[i]
            b[i] ^= c[i]
            a[i] ^= d[i]
            c[i] ^= shifted
            d[i] = np.uint32(d[i] << np.uint32(11)) | np.uint32(d[i] >> np.uint32(21))


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _exponentiate(values: Array, powers: Array) -> None:
    """eˣ of numbers at most 0, in their place: 2ⁿ eʳ with |r| ≤ log(2) / 2, a series to r¹³. `powers` is room for
    whole numbers. There is no branch, so that several are computed at once."""
    for i in range(len(values)):
        x = max(values[i], -708.0)
        whole = np.int32(x * 1.4426950408889634 - 0.5)
        n = np.float64(whole)
        r = (x - n * 0.6931471803691238) - n * 1.9082149292705877e-10
        p = (r * (1 / 6227020800) + 1 / 479001600) * r + 1 / 39916800
        p = ((p * r + 1 / 3628800) * r + 1 / 362880) * r + 1 / 40320
        p = ((p * r + 1 / 5040) * r + 1 / 720) * r + 1 / 120
        p = ((p * r + 1 / 24) * r + 1 / 6) * r + 1 / 2
        values[i] = (p * r + 1) * r + 1
        powers[i] = (np.int64(whole) + 1023) << 52
    scales = powers.view(np.float64)
    for i in range(len(values)):
        values[i] *= scales[i]


@njit(cache=True, error_model="numpy", fastmath={"nnan", "nsz"})
def _largest(values: Array) -> float:
    largest = -np.inf
    for i in range(len(values)):
        largest = max(largest, values[i])
    return largest


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _sums(values: Array) -> tuple[float, float]:
    """Of numbers and of their squares."""
    total, squares = 0.0, 0.0
    for i in range(len(values)):
        total += values[i]
        squares += values[i] * values[i]
    return total, squares


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _weigh(
    log_weights: Array, density: Array, future: Array, weights: Array, powers: Array
) -> tuple[float, float, float]:
    """Weigh a trajectory's particles: `log_weights` change, of which `weights` and the future's are the exponentials
    but for a factor. Returns the evidence, the effective sample size and how many particles have blown up."""
    broken = 0
    for n in range(len(weights)):
        own = log_weights[n] + density[n]
        expected = own + future[n]
        bad = expected != expected  # explains no measurement
        broken += bad
        log_weights[n] = -np.inf if bad else own
        weights[n] = -np.inf if bad else expected
    largest = _largest(weights)
    if largest == -np.inf:
        weights[:] = 0.0
        log_weights[:] = np.nan
        return -np.inf, np.nan, broken
    for n in range(len(weights)):
        weights[n] -= largest
    _exponentiate(weights, powers)
    total, squares = _sums(weights)
    evidence = largest + math.log(total)
    for n in range(len(weights)):
        log_weights[n] -= evidence
    return evidence, total * total / squares, broken


@njit(cache=True, error_model="numpy")
def _go(
    addresses: tuple[int, int],
    constants: tuple[Array, Array],
    tables: tuple[Array, Array, Array, Array],
    settings: tuple[int, int, float, bool],
    random: tuple[Array, Array, Array],
    state: tuple[Array, Array, Array],
    block: tuple[Array, Array, Array],
    weighed: Array,
    figures: Array,
) -> None:
    """Take particles through a block's rows; what `tables` holds begins at the table's first row."""
    measured, moved, observed, inside = tables
    first_row, end, threshold, looks_ahead = settings
    generator, uniform, thresholds = random
    begin, log_weights, roots = state
    out, ancestors, resampled = block
    trajectories, particles = log_weights.shape
    seen = np.zeros((2, trajectories, particles), np.float32)
    weights, before = np.empty((trajectories, particles)), np.empty(particles, np.int64)
    powers, first = np.empty(particles, np.int64), np.empty(particles + 1, np.int64)
    even, nothing, here = -math.log(particles), np.zeros(particles, np.float32), begin.ctypes.data
    for row in range(first_row, end):
        r, any_exhausted = row - first_row, False
        weighs = looks_ahead or observed[row]
        if weighs:
            given = (constants[0].ctypes.data, measured[row].ctypes.data, here, np.uintp(0), seen.ctypes.data)
            _call(addresses[0], (*given, trajectories, particles, measured.shape[2]))
        for b in range(trajectories):
            figures[0, row, b], figures[1, row, b], figures[2, row, b] = 0.0, particles, 0.0
            if weighs:
                future = seen[1, b] if inside[row, b] else nothing
                found = _weigh(log_weights[b], seen[0, b], future, weights[b], powers)
                figures[0, row, b], figures[1, row, b], figures[2, row, b] = found
                any_exhausted |= found[1] < threshold
        if len(weighed):
            weighed[:] = log_weights
        if row == len(moved):
            break
        resampled[r] = any_exhausted
        if any_exhausted:
            for b in range(trajectories):
                chosen = ancestors[r, b]
                if figures[1, row, b] < threshold:
                    choose(weights[b], thresholds[r, b], first, chosen)
                    before[:] = roots[b]
                    for n in range(particles):
                        roots[b, n] = before[chosen[n]]
                        log_weights[b, n] = even - (seen[1, b, chosen[n]] if inside[row, b] else 0.0)
                else:
                    for n in range(particles):
                        chosen[n] = n
        came_from = ancestors[r].ctypes.data if any_exhausted else np.uintp(0)
        _draw(generator, uniform)
        inputs = (constants[1].ctypes.data, moved[row].ctypes.data, here, uniform.ctypes.data)
        _call(addresses[1], (*inputs, came_from, out[r].ctypes.data, trajectories, particles, moved.shape[2]))
        for b in range(trajectories):
            if inside[row + 1, b]:
                for n in range(particles):
                    log_weights[b, n] += out[r, -1, b, n]
        here = out[r].ctypes.data
