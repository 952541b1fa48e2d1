"""Guides whose sites are Deltas at given paths: with them the ELBO is STEADY's M-step objective."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import pyro
import pyro.distributions as dist
import torch

from steady_ppl.data import Trajectories
from steady_ppl.errors import FilterError
from steady_ppl.particles import particle_filter
from steady_ppl.paths import Paths
from steady_ppl.program import Program
from steady_ppl.sites import masked
from steady_ppl.true_paths import true_paths


class Tempering(Protocol):
    """A schedule of the observation weight (w_obs in STEADY)."""

    def __call__(self, progress: float) -> float:
        """The weight at `progress` through the training, 0 to 1."""
        ...


@dataclass(frozen=True)
class Constant:
    """The same weight throughout; 1 is STEADY− (no tempering)."""

    weight: float = 1.0

    def __call__(self, progress: float) -> float:
        return self.weight


@dataclass(frozen=True)
class LinearRamp:
    """From `first` to 1 over the first `share` of the training; the paper ramps from 0.001 over all of it."""

    first: float = 0.001
    share: float = 1.0

    def __call__(self, progress: float) -> float:
        return min(1.0, self.first + (1 - self.first) * progress / self.share)


class PathGuide:
    """A guide without parameters: Deltas at stored paths.

    Attributes:
        draws: M, the number of paths for each trajectory.
        paths: the stored paths, None before the first `refresh`.
    """

    def __init__(self, draws: int) -> None:
        self.draws = draws
        self.paths: Paths | None = None

    def refresh(self, data: Trajectories, progress: float) -> dict[str, float]:
        """The E step: draw new paths for `data` at `progress` (0 to 1); returns figures for the log."""
        raise NotImplementedError

    def __call__(self, data: Trajectories) -> None:
        """The guide of the model `Joint`; `data` are the trajectories of the last `refresh`."""
        if self.paths is None:
            raise RuntimeError("refresh(data, progress) must run before the guide does")
        paths = self.paths
        rows, trajectories = data.time.shape

        def known(site: str, value: torch.Tensor) -> None:
            pyro.sample(site, dist.Delta(value if self.draws > 1 else value[0], event_dim=paths.event_dims[site]))

        with pyro.plate("trajectory", trajectories, dim=-1):
            with pyro.plate("row", rows, dim=-2), masked(data.rows):
                known("states", paths.states)
            with pyro.plate("first_row", 1, dim=-2):
                for site, value in paths.start.items():
                    known(site, value)
            with pyro.plate("interval", rows - 1, dim=-2), masked(data.transitions):
                for site, value in paths.noise.items():
                    known(site, value)


class SMCGuide(PathGuide):
    """The particle filter with tempered observations as a guide: STEADY's E step.

    Args:
        program: the state-space model that the filter runs.
        particles: N, for each trajectory.
        draws: M, equally weighted paths resampled from all surviving lineages (the paper uses 10).
        tempering: schedule of the observation weight.
        known_start: the first state is certain.
        resample_below: share of N under which the effective sample size triggers resampling.
    """

    def __init__(
        self,
        program: Program,
        *,
        particles: int = 300,
        draws: int = 10,
        tempering: Tempering | None = None,
        known_start: bool = False,
        resample_below: float = 0.5,
    ) -> None:
        super().__init__(draws)
        self.program, self.particles = program, particles
        self.tempering = tempering or LinearRamp()
        self.known_start, self.resample_below = known_start, resample_below

    def refresh(self, data: Trajectories, progress: float) -> dict[str, float]:
        """Run the filter and keep `draws` paths.

        Raises:
            FilterError: the filter broke down, or a path is not finite.
        """
        weight = self.tempering(progress)
        filtered = particle_filter(
            self.program,
            data,
            particles=self.particles,
            observation_weight=weight,
            known_start=self.known_start,
            resample_below=self.resample_below,
        )
        self.paths = filtered.paths(self.draws).within(data)
        _require_finite(self.paths, data)
        observed = data.observed.any(-1)
        return {
            "observation_weight": weight,
            "ess": float(filtered.effective_sizes[observed].mean()),
            "roots": float(filtered.roots.mean()),
        }


class TruthGuide(PathGuide):
    """Deltas at the true states and the channel noise that explains them: supervised learning (FitTruth)."""

    def __init__(self, program: Program) -> None:
        super().__init__(draws=1)
        self.program = program
        self._of: Trajectories | None = None

    def refresh(self, data: Trajectories, progress: float) -> dict[str, float]:
        """Look the true paths up; nothing is drawn."""
        if data is not self._of:
            self.paths, self._of = true_paths(self.program, data), data
        return {}


def _require_finite(paths: Paths, data: Trajectories) -> None:
    broken = ~torch.isfinite(paths.states).all(-1).all(0) & data.rows
    if bool(broken.any()):
        row, trajectory = (int(i) for i in broken.nonzero()[0])
        label, time = data.labels[trajectory], float(data.elapsed[row, trajectory])
        raise FilterError(
            f"trajectory {label} at {time:.3g} s: a state is not finite: the program has blown up",
            trajectory=label,
            time=time,
        )
