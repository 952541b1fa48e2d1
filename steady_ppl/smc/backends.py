"""How a filter runs a program's methods on its particles: as they are written, here, or compiled (`compiled`)."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.kernels.codegen import LANES
from steady_ppl.kernels.graph import NotCompilable
from steady_ppl.kernels.jit import Method, close, compiled, discard
from steady_ppl.model.handlers import Observing, Recording, Standardised, running
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import acting_controls, advance, standardised
from steady_ppl.smc.resampling import by_component, take


class Stepping:
    """The program's own lines, through Pyro.

    Args:
        program: the state-space model.
        data: as returned by `for_program`.
        observation_weight: tempers the observations' log-density; `(B,)` for one a trajectory.

    Attributes:
        event_dims: event dimension of each site of `transition`, known after the first.
    """

    def __init__(self, program: Program, data: Trajectories, observation_weight: float | Tensor) -> None:
        self.program, self.data, self.observation_weight = program, data, observation_weight
        self.steps, self.elapsed, self.controls = data.steps, data.elapsed, acting_controls(program, data)
        self.event_dims: dict[str, int] = {}

    def transition(
        self, row: int, state: Tensor, ancestors: Tensor | None, noise: Tensor | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Move on by one interval.

        Args:
            row: the interval's first row.
            state: `(N, B, D)`.
            ancestors: `(N, B)`, which of these move on; None: each.
            noise: `(N, B, C)`, in standard deviations of the channels; None: drawn by the program.

        Returns:
            The next states `(N, B, D)` and each site's values `(N, B, ...)`; with several substeps these are in
            standard deviations, see `substeps.channel_values`.
        """
        if ancestors is not None:
            state = take(state, ancestors)
        recording = Recording()
        given = nullcontext() if noise is None else Standardised(noise.unsqueeze(1))
        control, time, step = self.controls[row, None], self.elapsed[row, None], self.steps[row, None]
        with running(state.shape[0], 1, state.shape[1]), recording, given:
            moved = advance(self.program, state.unsqueeze(1), control, time, step)
        self.event_dims = {site: fn.event_dim for site, fn in recording.distributions.items()}
        values = recording.values
        if self.program.substeps > 1:
            values = {site: standardised(fn, values[site], site) for site, fn in recording.distributions.items()}
        return moved.squeeze(1), {site: value.squeeze(1) for site, value in values.items()}

    def log_density(self, row: int, state: Tensor) -> Tensor:
        """Tempered log-density of a row's measurements, `(N, B)`."""
        recording = Recording()
        measured = Observing(self.data.measurements[row, None], self.data.observed[row, None], self.observation_weight)
        with running(state.shape[0], 1, state.shape[1]), recording, measured:
            self.program.observe(state.unsqueeze(1))
        return recording.total().squeeze(-2)


FILTER = "filter"  # the name of what is compiled for it


def stepping_for(
    program: Program, data: Trajectories, state: Tensor, observation_weight: float | Tensor
) -> tuple[Stepping, str | None]:
    """Kernels where they can serve, and otherwise the program as written and why.

    Args:
        state: `(N, B, D)`, the particles' starts, on some of which kernels are compared with the program's lines.
    """
    plain = Stepping(program, data, observation_weight)
    if state.device.type != "cpu" or state.dtype != torch.float32:
        return plain, f"{str(state.dtype).removeprefix('torch.')} on {state.device.type}"
    if state.shape[0] < LANES:
        return plain, f"fewer than {LANES} particles"
    methods = compiled(program, FILTER, lambda: _Methods(program, data, plain.controls, state))
    if isinstance(methods, str):
        return plain, methods
    stepping = CompiledStepping(methods, plain)
    if not stepping.agrees(state[:LANES]):
        return plain, discard(program, FILTER)
    return stepping, None


class _Methods:
    """`transition` and `observe` of a program."""

    def __init__(self, program: Program, data: Trajectories, controls: Tensor, state: Tensor) -> None:
        one = (1, 1, 1)
        seen = Recording()
        first = state[:1, :1].unsqueeze(1)
        inputs = {
            "control": controls[:1, :1].unsqueeze(0),
            "time": data.elapsed[:1, :1].unsqueeze(0),
            "step": data.steps[:1, :1].unsqueeze(0),
        }
        with torch.no_grad(), running(*one), seen:
            advance(program, first, *inputs.values())
        self.event_dims = {site: fn.event_dim for site, fn in seen.distributions.items()}
        self.sizes = {site: value.numel() for site, value in seen.values.items()}
        self.channels, self.width = sum(self.sizes.values()), state.shape[-1]
        self.held = program.substeps > 1
        self.values = 0 if self.held else self.channels

        def transition(state: Tensor, noise: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Any:
            recording = Recording()
            with running(*one), recording, Standardised(noise):
                moved = advance(program, state, control, time, step)
            return (moved,) if self.held else (moved, *recording.values.values())

        def observe(state: Tensor, measurement: Tensor, observed: Tensor, weight: Tensor) -> Any:
            recording = Recording()
            with running(*one), recording, Observing(measurement, observed, weight):
                program.observe(state)
            return (recording.total(),)

        noise = torch.zeros(*one, self.channels)
        self.transition = Method(transition, {"state": first, "noise": noise}, inputs)
        measured = {
            "measurement": data.measurements[:1, :1].unsqueeze(0),
            "observed": torch.ones_like(data.observed[:1, :1].unsqueeze(0)),
            "weight": torch.ones(()),
        }
        self.observe = Method(observe, {"state": first}, measured)
        if self.transition.values != self.width + self.values or self.observe.values != 1:
            raise NotCompilable("its results for one particle have other shapes: it mixes particles or trajectories")


class CompiledStepping(Stepping):
    """A program's kernels; see `Stepping`. Noise that is not given is drawn standard normal."""

    def __init__(self, methods: _Methods, plain: Stepping) -> None:
        super().__init__(plain.program, plain.data, plain.observation_weight)
        self.methods, self.plain, self.event_dims = methods, plain, methods.event_dims
        data = plain.data
        self.moving = methods.transition.parameters()
        self.observing = methods.observe.parameters()
        moved = (plain.controls[:-1], data.elapsed[:-1, :, None], data.steps[..., None])
        self.moved = torch.cat(moved, -1).float().contiguous().numpy()
        weight = torch.as_tensor(self.observation_weight, dtype=torch.float32).expand(data.time.shape).unsqueeze(-1)
        self.measured = torch.cat((data.measurements, data.observed.to(weight), weight), -1).contiguous().numpy()

    def transition(
        self, row: int, state: Tensor, ancestors: Tensor | None, noise: Tensor | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        methods = self.methods
        particles, trajectories = state.shape[:2]
        if noise is None:
            drawn = torch.randn(methods.channels, trajectories, particles)
        else:
            drawn = noise.permute(2, 1, 0).contiguous()
        out = torch.empty(methods.width + methods.values, trajectories, particles)
        came_from = None if ancestors is None else ancestors.t().contiguous().numpy()
        inputs = [by_component(state).numpy(), drawn.numpy()]
        methods.transition.kernel(self.moving, self.moved[row], inputs, came_from, out.numpy())
        moved, values = out.split([methods.width, methods.values])
        values = drawn if methods.held else values
        noises = {
            site: value.permute(2, 1, 0) if self.event_dims[site] else value[0].t()
            for site, value in zip(methods.sizes, values.split(list(methods.sizes.values())), strict=True)
        }
        return moved.permute(2, 1, 0), noises

    def log_density(self, row: int, state: Tensor) -> Tensor:
        out = torch.empty(1, state.shape[1], state.shape[0])
        inputs = [by_component(state).numpy()]
        self.methods.observe.kernel(self.observing, self.measured[row], inputs, None, out.numpy())
        return out[0].t()

    def agrees(self, state: Tensor) -> bool:
        """Whether the kernels come to the numbers of the program's own lines, from a few states at two rows."""
        generator = torch.Generator().manual_seed(0)
        last = len(self.moved) - 1
        return all(self._agrees_at(row, state, generator) for row in {last // 2, last})

    def _agrees_at(self, row: int, state: Tensor, generator: torch.Generator) -> bool:
        noise = torch.randn(*state.shape[:2], self.methods.channels, generator=generator)
        moved, values = self.transition(row, state, None, noise)
        plain, plain_values = self.plain.transition(row, state, None, noise)
        density, plain_density = self.log_density(row, moved), self.plain.log_density(row, moved)
        pairs = [(moved, plain), (density, plain_density), *((values[s], plain_values[s]) for s in values)]
        return all(close(mine, theirs.expand_as(mine)) for mine, theirs in pairs)
