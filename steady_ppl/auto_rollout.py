"""Pyro's automatic guides over the noise of given drives: a mean field, or whatever else it has."""

from __future__ import annotations

from typing import Any

import pyro
import pyro.distributions as dist
import torch
from pyro import poutine
from pyro.infer.autoguide import AutoGuide, AutoNormal
from pyro.infer.autoguide.initialization import init_to_value
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import UsageError
from steady_ppl.model.program import Program
from steady_ppl.model.validate import start_size, step_size
from steady_ppl.variational_guides import VariationalGuide


class AutoRollout(VariationalGuide):
    """Any of Pyro's automatic guides, over the standard normal noise of given trajectories.

    Args:
        data: the trajectories, as returned by `for_program`; each has parameters of its own.
        auto: for example `pyro.infer.autoguide.AutoNormal` (mean field) or `AutoLowRankMultivariateNormal`.
        options: of `auto`, for example `init_scale`.
        more: of `VariationalGuide`.
    """

    def __init__(
        self,
        program: Program,
        data: Trajectories,
        *,
        auto: type[AutoGuide] = AutoNormal,
        options: dict[str, Any] | None = None,
        **more: Any,
    ) -> None:
        super().__init__(program, **more)
        self.sizes, self.labels = (start_size(program), step_size(program)), data.labels
        self.now: dict[str, Tensor] = {}
        zeros = {name: data.controls.new_zeros(shape) for name, shape in self._shapes(data).items()}
        with pyro.settings.context(module_local_params=True), poutine.block():
            self.auto = auto(self._noise, **{"init_loc_fn": init_to_value(values=zeros)} | (options or {}))
            self.auto(data)  # makes its parameters

    def begin(self, data: Trajectories) -> Tensor:
        if data.labels != self.labels:
            raise UsageError(
                "an automatic guide has parameters for each of its drives: it takes no others and no batch"
            )
        values, ratios = list[dict[str, Tensor]](), list[Tensor]()
        for _ in range(self.draws):
            with pyro.settings.context(module_local_params=True), poutine.block():
                trace = poutine.trace(self.auto).get_trace(data)
            drawn: dict[str, Any] = {
                name: trace.nodes[name]["value"] for name in ("start", "noise") if name in trace.nodes
            }
            values.append(drawn)
            normal = [dist.Normal(0.0, 1.0).log_prob(value).sum() for value in drawn.values()]
            ratios.append(trace.log_prob_sum() - torch.stack(normal).sum())
        self.now = {name: torch.stack([drawn[name] for drawn in values]) for name in values[0]}
        padded = data.controls.new_zeros(self.draws, *data.transitions.shape, self.sizes[1])
        padded[:, data.transitions] = self.now["noise"]
        self.now["noise"] = padded
        return torch.stack(ratios)

    def start(self) -> tuple[Tensor, Tensor]:
        noise = self.now["start"]
        return noise, noise.new_zeros(noise.shape[:2])

    def step(self, row: int, state: Tensor) -> tuple[Tensor, Tensor | float]:
        return self.now["noise"][:, row], state.new_zeros(())

    def _noise(self, data: Trajectories) -> None:
        """The prior of the noise of start and intervals, of those alone that the drives have."""
        for name, (count, size) in self._shapes(data).items():
            with pyro.plate(f"{name}s", count, dim=-1):
                pyro.sample(name, dist.Normal(data.controls.new_zeros(count, size), 1.0).to_event(1))

    def _shapes(self, data: Trajectories) -> dict[str, tuple[int, int]]:
        shapes = {"noise": (int(data.transitions.sum()), self.sizes[1])}
        return shapes if self.known_start else {"start": (len(data), self.sizes[0])} | shapes
