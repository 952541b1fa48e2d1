"""The particle filter as machine code: the program's methods are kernels, and `loops` goes from one row to the next."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from steady_ppl.kernels.codegen import SIMD_LANES
from steady_ppl.kernels.graph import NotCompilable
from steady_ppl.kernels.jit import Method, close, compiled, discard
from steady_ppl.model.handlers import Observing, Recording, Standardised, running
from steady_ppl.model.substeps import advance
from steady_ppl.smc.genealogy import FilterState, History, Run, event_dims
from steady_ppl.smc.loops import Array, filter_rows
from steady_ppl.smc.proposal import Proposal, Steered
from steady_ppl.smc.resampling import Resampler, by_component, systematic
from steady_ppl.smc.stepping import Row, Stepping, at_row

BLOCK_BYTES = 2**22  # bytes of memory for rows' results, asked for at a time
STREAMS = 64  # random generators side by side, each with a seed of torch's
OnFrame = Callable[[int, Tensor, Tensor, Tensor], None]


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
    moved = [plain.controls[:-1], data.elapsed[:-1], data.steps, *proposal.intervals]
    return moved, [data.measurements, data.observed, weight, *proposal.rows]


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
        intervals, parents, memory = list[Tensor](), list[Tensor | None](), list[tuple[Tensor, ...]]()
        for first in range(0, last + 1, rows):
            moves = min(rows, last - first)
            thresholds = torch.rand(moves, trajectories, dtype=torch.float64)
            if kept or len(memory) < 2:  # one to fill, and one whose last row is gone on from
                memory.append(_memory(moves, outputs, trajectories, particles))
            moved, ancestors, resampled = memory.pop() if kept else memory[first // rows % 2]
            seen = log_weights.t().clone() if on_frame else log_weights[:0]
            weighed = torch.empty_like(log_weights) if on_frame else log_weights[:0]
            filter_rows(
                (methods.observe.kernel.address, methods.transition.kernel.address),
                self.constants,
                (self.measured, self.moved, self.observed, self.inside),
                (first, min(first + rows, last + 1), float(threshold), ahead),
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

    def transition(self, row: Row, state: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Move states `(N, B, D)` on from a row by uniform numbers `(N, B, ·)`: the next ones, the noise of all
        channels and the proposal's log ratio `(N, B)`."""
        methods = self.methods
        found = _called(methods.transition, self.constants[1], at_row(self.moved, row), [state, uniform])
        moved, values, ratio = found.split([methods.width, methods.channels, 1], -1)
        return moved, values, ratio[..., 0]

    def log_density(self, row: Row, state: Tensor) -> Tensor:
        """Tempered log-density of a row's measurements, and what the proposal thinks of later ones, `(N, B, 2)`."""
        return _called(self.methods.observe, self.constants[0], at_row(self.measured, row), [state])

    def agrees(self, state: Tensor) -> bool:
        """Whether the kernels come to the numbers of plain torch, of a few states `(N, B, D)`: at the last interval of
        each trajectory, and at the last row where it is measured."""
        proposal, data, size = self.proposal, self.plain.data, state.shape[:2]
        interval, rows = (data.lengths - 2).clamp(min=0), torch.arange(len(data.time)).unsqueeze(-1)
        seen = torch.where(data.observed.any(-1), rows, 0).amax(0)
        uniform = torch.rand(*size, self.methods.uniforms, generator=torch.Generator().manual_seed(0))
        moved, values, ratio = self.transition(interval, state, uniform)
        own = standard_normal(uniform, self.methods.channels)
        noise, expected = proposal.steered(state, *own, *(at_row(one, interval) for one in proposal.intervals))
        plain, sites = self.plain.transition(interval, state, noise.float())
        flat = [sites[site].expand(*size, *sites[site].shape[2:]).reshape(*size, -1) for site in self.methods.sizes]
        future = proposal.future(moved, *(at_row(one, seen) for one in proposal.rows))
        density = torch.stack([self.plain.log_density(seen, moved).expand(size), future.float()], -1)
        pairs = [(moved, plain), (values, torch.cat(flat, -1)), (ratio.unsqueeze(-1), expected.float().unsqueeze(-1))]
        pairs += list(zip(self.log_density(seen, moved).split(1, -1), density.split(1, -1), strict=True))
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
    steered = isinstance(proposal, Steered) and type(proposal).step is Steered.step and proposal.looks_ahead
    if type(proposal) is not Proposal and not steered:
        return "a proposal whose step is no function of one particle"
    shapes = [one.shape[2:] for one in (*proposal.intervals, *proposal.rows)]
    name = ("filter", type(proposal), *shapes)
    methods = compiled(plain.program, name, lambda: _Methods(plain, state, proposal))
    if isinstance(methods, str):
        return methods
    found = CompiledFilter(methods, plain, proposal)
    return found if found.agrees(state[:SIMD_LANES]) else discard(plain.program, name)


def _memory(rows: int, outputs: int, trajectories: int, particles: int) -> tuple[Tensor, ...]:
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
