"""Guides whose sites are Deltas at given paths: with them the ELBO is STEADY's M-step objective."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import torch

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import FilterError, require
from steady_ppl.model.handlers import masked
from steady_ppl.model.program import Program
from steady_ppl.smc.filter import STEPS_WORTH_COMPILING, Proposal, particle_filter
from steady_ppl.smc.genealogy import Paths
from steady_ppl.tempering import LinearRamp, Tempering
from steady_ppl.true_paths import true_paths

HUNDREDS = 100  # of E steps are in a training


class PathGuide:
    """A guide without parameters: Deltas at stored paths.

    Attributes:
        draws: M, the number of paths for each trajectory.
        paths: the stored paths, None before the first `refresh`.
        memory: tensors that the next `refresh` begins from; a checkpoint keeps them.
        in_plain_torch: why no kernels served in the last `refresh`; None where they did or were not worth it.
    """

    def __init__(self, draws: int) -> None:
        require(draws >= 1, "draws", draws, "at least 1")
        self.draws = draws
        self.paths: Paths | None = None
        self.memory: dict[str, torch.Tensor] = {}
        self.in_plain_torch: str | None = None

    def refresh(self, data: Trajectories, progress: float) -> dict[str, float]:
        """The E step: draw new paths for `data` at `progress` (0 to 1); returns figures for the log."""
        raise NotImplementedError

    def keep(self, paths: Paths, data: Trajectories) -> None:
        """Store paths of `data`, their padding filled.

        Raises:
            FilterError: a state is not finite.
        """
        self.paths = paths.within(data)
        broken = ~torch.isfinite(self.paths.states).all(-1).all(0) & data.rows
        if bool(broken.any()):
            row, trajectory = (int(i) for i in broken.nonzero()[0])
            label, time = data.labels[trajectory], float(data.elapsed[row, trajectory])
            raise FilterError(
                f"trajectory {label} at {time:.3g} s: a state is not finite: the program has blown up",
                trajectory=label,
                time=time,
            )

    def __call__(self, data: Trajectories) -> None:
        """The guide of the model `Joint`; `data` are the trajectories of the last `refresh`."""
        if self.paths is None:
            raise RuntimeError("refresh(data, progress) must run before the guide does")
        sample_known(self.paths, data)


class FilteringGuide(PathGuide):
    """A guide that draws its paths by a particle filter.

    Attributes:
        particles: N, for each trajectory.
        resample_below: share of N under which the effective sample size triggers resampling.
    """

    program: Program
    known_start: bool
    particles: int
    resample_below: float

    def _filter(self, data: Trajectories, weight: float, proposal: Proposal | None = None) -> dict[str, float]:
        """Keep paths of the filter; returns the health of its particles."""
        filtered = particle_filter(
            self.program,
            data,
            particles=self.particles,
            observation_weight=weight,
            known_start=self.known_start,
            resample_below=self.resample_below,
            proposal=proposal,
            kernels=HUNDREDS * self.particles * data.time.numel() >= STEPS_WORTH_COMPILING,
        )
        self.in_plain_torch = filtered.in_plain_torch or (proposal and self.in_plain_torch) or None
        self.keep(filtered.paths(self.draws), data)
        rows = data.observed.any(-1) if proposal is None else data.rows
        figures = {"ess": float(filtered.effective_sizes[rows].mean()), "roots": float(filtered.roots.mean())}
        blown_up = float(filtered.blown_up.sum())
        return figures | {"weights_blown_up": blown_up} if blown_up else figures


class SMCGuide(FilteringGuide):
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
        particles: int = 600,
        draws: int = 64,
        tempering: Tempering | None = None,
        known_start: bool = False,
        resample_below: float = 0.5,
    ) -> None:
        super().__init__(draws)
        require(particles >= 1, "particles", particles, "at least 1")
        self.program, self.particles = program, particles
        self.tempering = tempering or LinearRamp()
        self.known_start, self.resample_below = known_start, resample_below

    def refresh(self, data: Trajectories, progress: float) -> dict[str, float]:
        """Run the filter and keep `draws` paths.

        Raises:
            FilterError: the filter broke down, or a path is not finite.
        """
        weight = self.tempering(progress)
        return {"observation_weight": weight} | self._filter(data, weight)


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


def sample_known(paths: Paths, data: Trajectories) -> None:
    """Sample the sites of `Joint` as certainties at given paths of `data`, draws on the left if several."""
    rows, trajectories = data.time.shape
    several = len(paths.states) > 1

    def known(site: str, value: torch.Tensor) -> None:
        pyro.sample(site, dist.Delta(value if several else value[0], event_dim=paths.event_dims[site]))

    with pyro.plate("trajectory", trajectories, dim=-1):
        with pyro.plate("row", rows, dim=-2), masked(data.rows):
            known("states", paths.states)
        with pyro.plate("first_row", 1, dim=-2):
            for site, value in paths.start.items():
                known(site, value)
        with pyro.plate("interval", rows - 1, dim=-2), masked(data.transitions):
            for site, value in paths.noise.items():
                known(site, value)
