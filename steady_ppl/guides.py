"""Guides whose sites are Deltas at given paths: with them the ELBO is STEADY's M-step objective."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import torch

from steady_ppl.data import Trajectories
from steady_ppl.errors import FilterError
from steady_ppl.gaussian_smoother import find_and_smooth, means_as_path, smooth, smoother_paths
from steady_ppl.linearization import Path
from steady_ppl.lookahead import Lookahead
from steady_ppl.particles import WORTH_COMPILING, particle_filter
from steady_ppl.paths import Filtered, Paths
from steady_ppl.program import Program
from steady_ppl.proposals import Proposal, Twist
from steady_ppl.sites import masked
from steady_ppl.tempering import LinearRamp, Tempering
from steady_ppl.true_paths import true_paths


class PathGuide:
    """A guide without parameters: Deltas at stored paths.

    Attributes:
        draws: M, the number of paths for each trajectory.
        paths: the stored paths, None before the first `refresh`.
        memory: tensors that the next `refresh` begins from; a checkpoint keeps them.
        in_plain_torch: why no kernels served in the last `refresh`; None where they did or were not worth it.
    """

    def __init__(self, draws: int) -> None:
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
        filtered = _run_filter(self, data, weight)
        self.keep(filtered.paths(self.draws), data)
        return {"observation_weight": weight} | _health(filtered, data.observed.any(-1))


class LinearizedGuide(PathGuide):
    """What the guides share that linearise the program: each trajectory's path, kept from one `refresh` to the next.

    Args:
        program: the state-space model; its noise is normal, see `linearize`.
        draws: M, paths for each trajectory.
        tempering: schedule of the observation weight.
        known_start: the first state is certain.
        passes: linearisations a `refresh`; one is enough where the parameters have moved little since the last.
    """

    def __init__(
        self,
        program: Program,
        *,
        draws: int = 30,
        tempering: Tempering | None = None,
        known_start: bool = False,
        passes: int = 1,
    ) -> None:
        super().__init__(draws)
        self.program, self.tempering = program, tempering or LinearRamp()
        self.known_start, self.passes, self.lost = known_start, passes, 0

    def look_ahead(self, data: Trajectories, weight: float) -> Lookahead:
        """Linearise along the remembered paths; search for those that are not there, and again for those that are lost.

        Raises:
            FilterError: a path cannot be found.
        """
        self._search(data, [i for i, label in enumerate(data.labels) if f"states/{label}" not in self.memory], weight)
        ahead = self._smooth(data, weight)
        lost = (~torch.isfinite(ahead.log_likelihood)).nonzero().flatten().tolist()
        self.lost = len(lost)
        if lost:
            self._search(data, lost, weight)
            ahead = self._smooth(data, weight)
        self._remember(means_as_path(ahead, data), data)
        self.in_plain_torch = ahead.linearization.in_plain_torch
        return ahead

    def _search(self, data: Trajectories, trajectories: list[int], weight: float) -> None:
        if trajectories:
            part = data.subset(trajectories)
            ahead = find_and_smooth(self.program, part, known_start=self.known_start, observation_weight=weight)
            self._remember(means_as_path(ahead, part), part)

    def _smooth(self, data: Trajectories, weight: float) -> Lookahead:
        path = Path(self._recall("states", data), self._recall("noise", data))
        return smooth(
            self.program,
            data,
            path,
            known_start=self.known_start,
            observation_weight=weight,
            passes=self.passes,
        )

    def _recall(self, kind: str, data: Trajectories) -> torch.Tensor:
        return torch.stack([self.memory[f"{kind}/{label}"] for label in data.labels], 1).to(data.controls)

    def _remember(self, path: Path, data: Trajectories) -> None:
        for i, label in enumerate(data.labels):
            self.memory[f"states/{label}"] = path.states[:, i]
            self.memory[f"noise/{label}"] = path.noise[:, i]

    def _figures(self, ahead: Lookahead) -> dict[str, float]:
        """Log p(y) of the linearised program, at this step's observation weight; and whether paths were lost."""
        figures = {"log_evidence": float(ahead.log_likelihood.mean())}
        return figures | {"paths_lost": float(self.lost)} if self.lost else figures


class GaussianGuide(LinearizedGuide):
    """Draws of the linearised program's posterior as the E step: the iterated extended Kalman smoother.

    The cheapest, and as good as any where the posterior is close to normal (10 Hz, three landmarks or more); what it
    neglects, `LookaheadGuide` weighs.
    """

    def refresh(self, data: Trajectories, progress: float) -> dict[str, float]:
        """Linearise, smooth and keep `draws` independent paths.

        Raises:
            FilterError: the linearised program blew up.
        """
        weight = self.tempering(progress)
        ahead = self.look_ahead(data, weight)
        self.keep(smoother_paths(self.program, data, ahead, self.draws, known_start=self.known_start), data)
        return {"observation_weight": weight} | self._figures(ahead)


class LookaheadGuide(LinearizedGuide):
    """The particle filter that looks ahead as a guide: a hundred particles do what twenty thousand do in `SMCGuide`.

    Args:
        particles: N, for each trajectory.
        resample_below: share of N under which the effective sample size triggers resampling.
        untwisted, tempered: see `Twist`.
    """

    def __init__(
        self,
        program: Program,
        *,
        particles: int = 100,
        draws: int = 100,
        tempering: Tempering | None = None,
        known_start: bool = False,
        passes: int = 1,
        resample_below: float = 0.5,
        untwisted: float = 0.01,
        tempered: float = 1.0,
    ) -> None:
        super().__init__(program, draws=draws, tempering=tempering, known_start=known_start, passes=passes)
        self.particles, self.resample_below = particles, resample_below
        self.untwisted, self.tempered = untwisted, tempered

    def refresh(self, data: Trajectories, progress: float) -> dict[str, float]:
        """Run the filter and keep `draws` paths.

        Raises:
            FilterError: the filter broke down.
        """
        weight = self.tempering(progress)
        ahead = self.look_ahead(data, weight)
        filtered = _run_filter(self, data, weight, Twist(ahead, untwisted=self.untwisted, tempered=self.tempered))
        self.keep(filtered.paths(self.draws), data)
        return {"observation_weight": weight} | self._figures(ahead) | _health(filtered, data.rows)


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


def _run_filter(
    guide: SMCGuide | LookaheadGuide, data: Trajectories, weight: float, proposal: Proposal | None = None
) -> Filtered:
    filtered = particle_filter(
        guide.program,
        data,
        particles=guide.particles,
        observation_weight=weight,
        known_start=guide.known_start,
        resample_below=guide.resample_below,
        proposal=proposal,
        kernels=100 * guide.particles * data.time.numel() >= WORTH_COMPILING,  # a training has hundreds of E steps
    )
    guide.in_plain_torch = filtered.in_plain_torch or (proposal and guide.in_plain_torch) or None
    return filtered


def _health(filtered: Filtered, rows: torch.Tensor) -> dict[str, float]:
    return {"ess": float(filtered.effective_sizes[rows].mean()), "roots": float(filtered.roots.mean())}
