"""Guides with parameters of their own: the program, rolled out under noise that they propose (SVI).

States follow from the start and the channel noise, differentiable from end to end; the joint density is the same as for
every other guide. Kingma and Welling (2014); Krishnan, Shalit and Sontag (2017).
"""

from __future__ import annotations

import math
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from pyro import poutine
from pyro.infer.autoguide import AutoGuide, AutoNormal
from pyro.infer.autoguide.initialization import init_to_value
from pyro.poutine.messenger import Messenger
from torch import Tensor, nn

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import UsageError, require
from steady_ppl.guides.base import Constant, Taking, Tempering, sample_known
from steady_ppl.model.handlers import KnownStart, Recording, Replaying, Standardised, broadcast_event, running
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import acting_controls, sample_row
from steady_ppl.model.validate import start_size, step_size
from steady_ppl.smc.genealogy import Paths, event_dims


class VariationalGuide(nn.Module):
    """What the guides share that roll the program out; a subclass proposes its noise.

    The start's noise is proposed in its standard deviations from its mean, ε, and so is that of intervals unless the
    guide is `centred`: then its values z are. With ε the guide moves with the program's parameters and the ELBO is
    E[log p(y | states) − (log q(ε) − log N(ε; 0, 1))]; with z it does not, and the program's parameters are moved by
    E[∂ log p(z | states)], as in STEADY's M step.

    Args:
        program: the state-space model; its noise is normal.
        draws: of each trajectory a gradient step.
        known_start: the first state is certain.
        annealing: schedule of the weight of the KL divergence.
        rate: learning rate of the guide's parameters relative to the recipe's.
    """

    centred = False
    program: Program

    def __init__(
        self,
        program: Program,
        *,
        draws: int = 1,
        known_start: bool = False,
        annealing: Tempering | None = None,
        rate: float = 1.0,
    ) -> None:
        super().__init__()
        require(draws >= 1, "draws", draws, "at least 1")
        require(0 < rate < math.inf, "the guide's rate", rate, "above 0")
        self.__dict__["program"] = program  # no submodule: its parameters are not the guide's
        self.draws, self.known_start, self.rate = draws, known_start, rate
        self.annealing = annealing or Constant()
        self.kl_weight = 1.0

    def refresh(self, data: Trajectories, progress: float) -> dict[str, float]:
        """Look the KL weight up; nothing is drawn outside the gradient."""
        self.kl_weight = self.annealing(progress)
        return {} if isinstance(self.annealing, Constant) else {"kl_weight": self.kl_weight}

    def begin(self, data: Trajectories) -> Tensor:
        """Called before each roll-out; the log-density of whatever is drawn here at once, as in `step`, `(M,)`."""
        return data.controls.new_zeros(self.draws)

    def start(self) -> tuple[Tensor, Tensor]:
        """ε of `initial`, `(M, B, C₀)`, and log q(ε) − log N(ε; 0, 1), `(M, B)`."""
        raise NotImplementedError

    def step(self, row: int, state: Tensor) -> tuple[Tensor, Tensor | float]:
        """The noise of the `transition` after a row, `(M, B, C)`, from states `(M, B, D)`; and log q(z) where the guide
        is centred, else log q(ε) − log N(ε; 0, 1), `(M, B)`."""
        raise NotImplementedError

    def forward(self, data: Trajectories) -> None:
        """The guide of the model `Joint`."""
        paths, at_start, later = self.roll_out(data)
        sample_known(paths, data)
        weight = self.kl_weight
        density = weight * (at_start + later)
        if not self.known_start:
            density = density + _prior_of_start(self.program, paths)
        if not self.centred or weight != 1:
            density = density + (1 - weight * self.centred) * _prior_of_noise(self.program, data, paths)
        pyro.factor("proposal", density.reshape(-1, 1, 1) if self.draws > 1 else density[0], has_rsample=True)

    def roll_out(self, data: Trajectories) -> tuple[Paths, Tensor, Tensor]:
        """Paths of `data`; log-densities of start and noise as `start` and `step` give them, each summed, `(M,)`."""
        later, at_start = self.begin(data), data.controls.new_zeros(self.draws)
        left, moving = torch.Size((self.draws, 1, len(data))), Recording()
        certain: Messenger
        if self.known_start:
            certain = KnownStart(data.known_start)
        else:
            noise, apart = self.start()
            at_start, certain = apart.sum(1), Standardised(noise.unsqueeze(1))
        with running(*left):
            with Recording() as started, certain:
                state = broadcast_event(self.program.initial(), left, 1).squeeze(1)
            states, values = [state], dict[str, list[Tensor]]()
            over_time = (acting_controls(self.program, data)[:-1], data.elapsed[:-1], data.steps)
            for row, given in enumerate(zip(*(values.split(1) for values in over_time), strict=True)):
                noise, density = self.step(row, state)
                inside = data.transitions[row]
                later = later + torch.where(inside, density, 0.0).sum(-1)
                with Recording() as moving, (Taking if self.centred else Standardised)(noise.unsqueeze(1)):
                    moved = sample_row(self.program, state.unsqueeze(1), *given).squeeze(1)
                state = torch.where(inside[:, None], moved, state)
                states.append(state)
                for site, value in moving.values.items():
                    values.setdefault(site, []).append(value)
        dims = event_dims(started, moving)
        paths = Paths(
            states=torch.stack(states, 1),
            start={site: broadcast_event(value, left, dims[site]) for site, value in started.values.items()},
            noise={site: torch.cat(parts, 1) for site, parts in values.items()},
            event_dims=dims | {"states": 1},
        )
        return paths, at_start, later


def _prior_of_noise(program: Program, data: Trajectories, paths: Paths) -> Tensor:
    """Log-density of the channel noise under the program, as `Joint` scores it, `(M,)`."""
    logs = [fn.log_prob(paths.noise[site]) for site, fn in paths.channels(program, data).items()]
    return torch.where(data.transitions, torch.stack(logs).sum(0), 0.0).sum((1, 2))


def _prior_of_start(program: Program, paths: Paths) -> Tensor:
    draws, _, trajectories, _ = paths.states.shape
    with running(draws, 1, trajectories), Recording() as seen, Replaying(paths.start):
        program.initial()
    logs = [fn.log_prob(paths.start[site]) for site, fn in seen.distributions.items()]
    return torch.stack(logs).sum((0, 2, 3))


def log_ratio(noise: Tensor, random: Tensor, log_scale: Tensor) -> Tensor:
    """log q(ε) − log N(ε; 0, 1), `(...)`, of ε = … + L r, r standard normal, exp(log_scale) the diagonal of L."""
    return (0.5 * (noise.square() - random.square()) - log_scale).sum(-1)


def times(matrix: Tensor, vector: Tensor) -> Tensor:
    """`(..., N, M)` by `(..., M)`."""
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


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
            drawn: dict[str, Any] = {name: trace.nodes[name]["value"] for name in self._shapes(data)}
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
