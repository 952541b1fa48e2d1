"""The linearised program's posterior as a guide whose every number is learned."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import UsageError
from steady_ppl.gaussian.information_filter import Steering
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.guides.variational import VariationalGuide, log_ratio, times
from steady_ppl.model.program import Program
from steady_ppl.utils.angles import wrap


class SmootherGuide(VariationalGuide):
    """The posterior of the linearised program, every number of which is then learned; exact where the program is linear
    and does not change.

    The noise of each interval is N(shift − gain (state − path), factor factorᵀ), as the lookahead steers it.

    Args:
        data: the trajectories, as returned by `for_program`; each has parameters of its own.
        more: of `VariationalGuide`.
    """

    path: Tensor
    angles: Tensor

    def __init__(self, program: Program, data: Trajectories, **more: Any) -> None:
        super().__init__(program, **more)
        kind, self.labels = data.controls.dtype, data.labels
        ahead = find_and_smooth(program, data, known_start=self.known_start)
        self.register_buffer("path", ahead.linearization.path.states.to(kind))
        angles = torch.zeros(self.path.shape[-1], dtype=torch.bool, device=self.path.device)
        angles[list(ahead.linearization.angles)] = True
        self.register_buffer("angles", angles)
        self.steps = _Steered(ahead.steps, kind)
        self.starts = _Steered(ahead.starts, kind, winding=0)
        self.index: list[int] = []

    def begin(self, data: Trajectories) -> Tensor:
        unknown = [label for label in data.labels if label not in self.labels]
        if unknown:
            raise UsageError(f"this guide has parameters for its own drives only, not for drive {unknown[0]}")
        self.index = [self.labels.index(label) for label in data.labels]
        return super().begin(data)

    def start(self) -> tuple[Tensor, Tensor]:
        return self.starts.draw(self.draws, self.index)

    def step(self, row: int, state: Tensor) -> tuple[Tensor, Tensor | float]:
        away = state - self.path[row, self.index]
        return self.steps.draw(self.draws, (row, self.index), torch.where(self.angles, wrap(away), away))


class _Steered(nn.Module):
    """Learnable steering of some noise."""

    def __init__(self, steering: Steering, kind: torch.dtype, winding: int | None = None) -> None:
        super().__init__()
        shift, gain, factor = (
            (part if winding is None else part[winding]).to(kind)
            for part in (steering.shift, steering.gain, steering.factor)
        )
        self.shift, self.gain = nn.Parameter(shift.clone()), nn.Parameter(gain.clone())
        self.log_scale = nn.Parameter(factor.diagonal(dim1=-2, dim2=-1).abs().log().clone())
        self.above = nn.Parameter(factor.triu(1).clone())

    def draw(self, draws: int, at: Any, from_path: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Noise `(M, B, C)` and log q − log p of it, `(M, B)`."""
        shift, log_scale = self.shift[at], self.log_scale[at]
        random = torch.randn(draws, *shift.shape, dtype=shift.dtype, device=shift.device)
        noise = shift + log_scale.exp() * random + times(self.above[at].triu(1), random)
        if from_path is not None:
            noise = noise - times(self.gain[at], from_path)
        return noise, log_ratio(noise, random, log_scale)
