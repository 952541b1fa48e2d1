"""An inference network as a guide: what a drive's later measurements say of its noise, learned for all drives at once.

Backward in time a recurrent network reads measurements and controls. Its code, of all rows at once, is turned with the
interval's own control and step into a proposal for each interval: normal, with a mean that depends on the state reached
so far, in an affine way, as a linear program asks for, and through a small hidden layer (the structured approximation
DKS of Krishnan, Shalit and Sontag 2017). Its output layers begin at zero: it first proposes noise of the size that the
program then has, around its mean or, centred, around zero.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import require
from steady_ppl.gaussian.predict import on_a_circle
from steady_ppl.gaussian.smoother import find_and_smooth, means_as_path
from steady_ppl.guides.variational import VariationalGuide, log_ratio, times
from steady_ppl.likelihood.scores import channel_moments
from steady_ppl.model.program import Program
from steady_ppl.model.validate import start_size, step_size

HIDDEN, BOUND = 16, 3.0  # units beside the affine mean, and how many times the usual size it reaches


class InferenceNetwork(VariationalGuide):
    """The guide; measurements and states are scaled by the moments of `data` and of its smoothed states, and so is the
    mean of centred noise; its spread begins as that which the program then has.

    Args:
        data: training drives, as returned by `for_program`.
        width: of the recurrent network.
        centred: propose the noise's values, not its deviations from the program's mean, see `VariationalGuide`.
        more: of `VariationalGuide`.
    """

    circular: Tensor
    reach: Tensor
    scale: Tensor

    def __init__(
        self, program: Program, data: Trajectories, *, width: int = 64, centred: bool = True, **more: Any
    ) -> None:
        super().__init__(program, **more)
        require(width >= 1, "width", width, "at least 1")
        self.width, self.centred = width, centred
        path = means_as_path(find_and_smooth(program, data, known_start=self.known_start), data)
        states = path.states
        self.angles = program.angle_indices
        self.register_buffer("circular", on_a_circle(program, data, states))
        mean, spread = (moment[0][data.transitions] for moment in channel_moments(program, data, states[None, :-1]))
        values = mean + spread * path.noise[data.transitions]
        squares = values.square().mean(0) + spread.square().mean(0)
        self.register_buffer("reach", squares.sqrt() if centred else torch.ones_like(squares))
        self.register_buffer("scale", spread.mean(0) if centred else torch.ones_like(squares))
        inside, features = data.rows[..., None], self._features(states)
        scales = {"control": _Standard(data.controls, inside), "state": _Standard(features, inside)}
        self.scales = nn.ModuleDict({"measurement": _Standard(data.measurements, data.observed), **scales})
        first, later, size = start_size(program), step_size(program), features.shape[-1]
        acting = data.controls.shape[-1] + 1
        inputs = 3 * data.measurements.shape[-1] + acting
        self.step_scale = data.median_step
        self.sizes = {"first": first, "later": later, "features": size, "acting": acting}
        self.encoder = nn.Linear(inputs, width)
        self.recurrent = nn.GRU(width, width)
        self.first = nn.Linear(width, 2 * first + _below(first))
        given = width + inputs + acting
        self.affine = nn.Linear(given, later * (2 + size) + _below(later))
        self.by_code, self.by_state = nn.Linear(given, HIDDEN), nn.Linear(size, HIDDEN, bias=False)
        self.head = nn.Linear(HIDDEN, later, bias=False)
        for layer in (self.first, self.affine, self.head):
            for value in layer.parameters():
                nn.init.zeros_(value)
        self.to(data.controls)

    def begin(self, data: Trajectories) -> Tensor:
        inputs = self._inputs(data)
        backward = (data.lengths - 1 - torch.arange(len(inputs), device=inputs.device)[:, None]) % len(inputs)
        turned = self.encoder(inputs).tanh().take_along_dim(backward[..., None], 0)
        codes = self.recurrent(turned)[0].take_along_dim(backward[..., None], 0)
        self.code = codes[0]
        later, size = self.sizes["later"], self.sizes["features"]
        given = torch.cat([codes[1:], inputs[1:], inputs[:-1, :, -self.sizes["acting"] :]], -1)
        self.shift, self.log_sd, gain, below = self.affine(given).split([later, later, later * size, _below(later)], -1)
        self.gain, self.hidden = gain.unflatten(-1, (later, size)), self.by_code(given)
        self.random = torch.randn(self.draws, *self.shift.shape, dtype=gain.dtype, device=gain.device)
        self.around = times(_factor(self.log_sd, below), self.random)
        if not self.centred:
            return super().begin(data)
        density = -0.5 * self.random.square() - self.log_sd - self.scale.log() - 0.5 * math.log(2 * math.pi)
        return torch.where(data.transitions, density.sum(-1), 0.0).sum((1, 2))

    def start(self) -> tuple[Tensor, Tensor]:
        """Of a full covariance: where a drive begins, how it heads and how fast it is hang together."""
        size = self.sizes["first"]
        mean, log_sd, below = self.first(self.code).split([size, size, _below(size)], -1)
        random = torch.randn(self.draws, *mean.shape, dtype=mean.dtype, device=mean.device)
        noise = mean + times(_factor(log_sd, below), random)
        return noise, log_ratio(noise, random, log_sd)

    def step(self, row: int, state: Tensor) -> tuple[Tensor, Tensor | float]:
        features = self.scales["state"](self._features(state))
        mean = self.shift[row] + times(self.gain[row], features)
        mean = mean + self.head((self.hidden[row] + self.by_state(features)).tanh())
        noise = self.reach * BOUND * (mean / BOUND).tanh() + self.scale * self.around[:, row]
        if self.centred:
            return noise, state.new_zeros(())
        return noise, log_ratio(noise, self.random[:, row], self.log_sd[row])

    def _inputs(self, data: Trajectories) -> Tensor:
        """What is known of every row, `(T + 1, B, ·)`: nothing of missing measurements or past a drive's end."""
        measurements, controls = data.measurements, self.scales["control"](data.controls)
        parts = (
            torch.where(self.circular, measurements.sin(), self.scales["measurement"](measurements)),
            torch.where(self.circular, measurements.cos(), 0.0),
            torch.ones_like(measurements),
        )
        steps = torch.where(data.transitions, data.steps / self.step_scale - 1, 0.0)
        steps = nn.functional.pad(steps, (0, 0, 0, 1)).unsqueeze(-1)
        inputs = torch.cat([*(torch.where(data.observed, part, 0.0) for part in parts), controls, steps], -1)
        return torch.where(data.rows[..., None], inputs, 0.0)

    def _features(self, state: Tensor) -> Tensor:
        """Components, angles as cosine and sine, and the velocities that the channels accelerate, `(..., F)`."""
        straight = [part for i, part in enumerate(state.unbind(-1)) if i not in self.angles]
        turned = [turn(state[..., i]) for i in self.angles for turn in (torch.cos, torch.sin)]
        return torch.stack([*straight, *turned, *self.program.velocities(state).values()], -1)


def _below(size: int) -> int:
    """How many numbers a matrix has below its diagonal."""
    return size * (size - 1) // 2


def _factor(log_diagonal: Tensor, below: Tensor) -> Tensor:
    """A lower triangular matrix, `(..., C, C)`."""
    factor = torch.diag_embed(log_diagonal.exp())
    size = factor.shape[-1]
    row, column = torch.tril_indices(size, size, -1)
    factor[..., row, column] = below
    return factor


class _Standard(nn.Module):
    """Scales to mean zero and standard deviation one of those values, `(..., F)`, that are counted."""

    mean: Tensor
    sd: Tensor

    def __init__(self, values: Tensor, counted: Tensor) -> None:
        super().__init__()
        known = torch.where(counted, values, torch.nan).flatten(0, -2)
        mean = known.nanmean(0)
        self.register_buffer("mean", mean)
        self.register_buffer("sd", (known - mean).square().nanmean(0).sqrt().clamp(min=1e-3))

    def forward(self, values: Tensor) -> Tensor:
        return (values - self.mean) / self.sd
