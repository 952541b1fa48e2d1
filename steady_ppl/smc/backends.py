"""How a filter runs a program's methods on its particles: as they are written, here, or as kernels."""

import math
from contextlib import nullcontext
from typing import Any

import numpy as np
import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.kernels.codegen import SIMD_LANES
from steady_ppl.kernels.graph import NotCompilable
from steady_ppl.kernels.jit import Method, close, compiled, discard
from steady_ppl.model.handlers import Observing, Recording, Standardised, running
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import acting_controls, advance, standardised
from steady_ppl.smc.genealogy import event_dims
from steady_ppl.smc.resampling import by_component, take


class Stepping:
    """The program's own lines, through Pyro; its arguments are those of `smc.filter.particle_filter`."""

    def __init__(self, program: Program, data: Trajectories, observation_weight: float | Tensor) -> None:
        self.program, self.data, self.observation_weight = program, data, observation_weight
        self.steps, self.elapsed, self.controls = data.steps, data.elapsed, acting_controls(program, data)
        self.event_dims: dict[str, int] = {}  # of each site of `transition`, known after the first

    def transition(
        self, row: int, state: Tensor, ancestors: Tensor | None, noise: Tensor | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Move states `(N, B, D)` on from a row: the next ones, and each site's values `(N, B, ...)`, which with
        several substeps are in standard deviations (see `substeps.channel_values`).

        Args:
            ancestors: `(N, B)`, which of the states move on; None: each.
            noise: `(N, B, C)`, in standard deviations of the channels; None: drawn by the program.
        """
        if ancestors is not None:
            state = take(state, ancestors)
        given = nullcontext() if noise is None else Standardised(noise.unsqueeze(1))
        control, time, step = self.controls[row, None], self.elapsed[row, None], self.steps[row, None]
        with running(state.shape[0], 1, state.shape[1]), Recording() as recording, given:
            moved = advance(self.program, state.unsqueeze(1), control, time, step)
        self.event_dims = event_dims(recording)
        values = recording.values
        if self.program.substeps > 1:
            values = {site: standardised(fn, values[site], site) for site, fn in recording.distributions.items()}
        return moved.squeeze(1), {site: value.squeeze(1) for site, value in values.items()}

    def log_density(self, row: int, state: Tensor) -> Tensor:
        """Tempered log-density of a row's measurements, `(N, B)`."""
        measured = Observing(self.data.measurements[row, None], self.data.observed[row, None], self.observation_weight)
        with running(state.shape[0], 1, state.shape[1]), Recording() as recording, measured:
            self.program.observe(state.unsqueeze(1))
        return recording.total().squeeze(-2)


FILTER_KERNELS = "filter"  # the name of what is compiled for it
BLOCK_BYTES = 2**22  # bytes of memory for rows' results, asked for at a time


def stepping_for(plain: Stepping, state: Tensor) -> tuple[Stepping, str | None]:
    """Kernels where they can serve, and otherwise the program as written and why.

    On some of the particles' starts, `(N, B, D)`, kernels are compared with the program's lines.
    """
    if state.device.type != "cpu" or state.dtype != torch.float32:
        return plain, f"{str(state.dtype).removeprefix('torch.')} on {state.device.type}"
    if state.shape[0] < SIMD_LANES:
        return plain, f"fewer than {SIMD_LANES} particles"
    methods = compiled(plain.program, FILTER_KERNELS, lambda: _Methods(plain, state))
    if isinstance(methods, str):
        return plain, methods
    stepping = CompiledStepping(methods, plain)
    if not stepping.agrees(state[:SIMD_LANES]):
        return plain, discard(plain.program, FILTER_KERNELS)
    return stepping, None


class _Methods:
    """`transition` and `observe` of a program."""

    def __init__(self, plain: Stepping, state: Tensor) -> None:
        program, data, one, first = plain.program, plain.data, (1, 1, 1), state[:1, :1].unsqueeze(1)
        by_row = {"control": plain.controls, "time": data.elapsed, "step": data.steps}
        inputs = {name: values[:1, :1].unsqueeze(0) for name, values in by_row.items()}
        with torch.no_grad(), running(*one), Recording() as seen:
            advance(program, first, *inputs.values())
        self.event_dims = event_dims(seen)
        self.sizes = {site: value.numel() for site, value in seen.values.items()}
        self.channels, self.width, self.held = sum(self.sizes.values()), state.shape[-1], program.substeps > 1
        self.results = self.width + (0 if self.held else self.channels)

        def transition(state: Tensor, noise: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Any:
            with running(*one), Recording() as recording, Standardised(noise):
                moved = advance(program, state, control, time, step)
            return (moved,) if self.held else (moved, *recording.values.values())

        def observe(state: Tensor, measurement: Tensor, observed: Tensor, weight: Tensor) -> Any:
            with running(*one), Recording() as recording, Observing(measurement, observed, weight):
                program.observe(state)
            return (recording.total(),)

        noise = torch.zeros(*one, self.channels)
        self.transition = Method(program, transition, {"state": first, "noise": noise}, inputs)
        measurement, observed = data.measurements[:1, :1].unsqueeze(0), torch.ones_like(data.observed[:1, :1])
        measured = {"measurement": measurement, "observed": observed.unsqueeze(0), "weight": torch.ones(())}
        self.observe = Method(program, observe, {"state": first}, measured)
        if self.transition.values != self.results or self.observe.values != 1:
            raise NotCompilable("its results for one particle have other shapes: it mixes particles or trajectories")


class CompiledStepping(Stepping):
    """A program's kernels; see `Stepping`. Noise that is not given is drawn standard normal."""

    def __init__(self, methods: _Methods, plain: Stepping) -> None:
        super().__init__(plain.program, plain.data, plain.observation_weight)
        self.methods, self.plain, self.event_dims = methods, plain, methods.event_dims
        data, program = plain.data, plain.program
        self.moving, self.observing = methods.transition.parameters(program), methods.observe.parameters(program)
        moved = (plain.controls[:-1], data.elapsed[:-1, :, None], data.steps[..., None])
        self.moved = torch.cat(moved, -1).float().contiguous().numpy()
        self._rows: list[Tensor] = []
        weight = torch.as_tensor(self.observation_weight, dtype=torch.float32).expand(data.time.shape).unsqueeze(-1)
        self.measured = torch.cat((data.measurements, data.observed.to(weight), weight), -1).contiguous().numpy()

    def transition(
        self, row: int, state: Tensor, ancestors: Tensor | None, noise: Tensor | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        methods = self.methods
        particles, trajectories = state.shape[:2]
        drawn = torch.randn(methods.channels, trajectories, particles) if noise is None else by_component(noise)
        out = self._row(methods.results, trajectories, particles)
        came_from = None if ancestors is None else ancestors.t().contiguous().numpy()
        inputs = [by_component(state).numpy(), drawn.numpy()]
        methods.transition.kernel(self.moving, self.moved[row], inputs, came_from, out.numpy())
        moved, values = out.tensor_split([methods.width])
        values = drawn if methods.held else values
        noises = {
            site: value.permute(2, 1, 0) if self.event_dims[site] else value[0].t()
            for site, value in zip(methods.sizes, values.split(list(methods.sizes.values())), strict=True)
        }
        return moved.permute(2, 1, 0), noises

    def _row(self, *shape: int) -> Tensor:
        """Memory for a row's results, out of a block of several rows by numpy.

        A filter keeps its history. Rows of their own by torch go back to the system, and its fresh pages take a third
        of the filter's time; these blocks are used again. A row that is kept keeps its block, at most 4 MiB.
        """
        if not self._rows or self._rows[-1].shape != shape:
            rows = max(1, min(len(self.moved), BLOCK_BYTES // (4 * math.prod(shape))))
            self._rows = list(torch.from_numpy(np.empty((rows, *shape), np.float32)))
        return self._rows.pop()

    def log_density(self, row: int, state: Tensor) -> Tensor:
        out = torch.empty(1, state.shape[1], state.shape[0])
        inputs = [by_component(state).numpy()]
        self.methods.observe.kernel(self.observing, self.measured[row], inputs, None, out.numpy())
        return out[0].t()

    def agrees(self, state: Tensor) -> bool:
        """Whether the kernels come to the numbers of the program's own lines, from a few states at two rows."""
        generator, last = torch.Generator().manual_seed(0), len(self.moved) - 1
        pairs = []
        for row in {last // 2, last}:
            noise = torch.randn(*state.shape[:2], self.methods.channels, generator=generator)
            moved, values = self.transition(row, state, None, noise)
            plain, plain_values = self.plain.transition(row, state, None, noise)
            pairs += [(moved, plain), *((values[site], plain_values[site]) for site in values)]
            pairs.append((self.log_density(row, moved), self.plain.log_density(row, moved)))
        return all(close(mine, theirs.expand_as(mine)) for mine, theirs in pairs)
