"""Guides that linearise the program along a path of every trajectory: drawn from it, steered by it, or begun at it."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import FilterError, UsageError, require
from steady_ppl.gaussian.information_filter import Lookahead, Steering
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import find_and_smooth, require_found, resting_path, smooth, smoother_paths
from steady_ppl.gaussian.twisted_proposal import Twist
from steady_ppl.guides.path_guides import FilteringGuide, LinearRamp, PathGuide, Tempering
from steady_ppl.guides.variational import VariationalGuide, log_ratio, times
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.utils.angles import wrap

GUIDE_ROWS_WORTH_COMPILING = 200  # rows of all trajectories together; a training linearises them hundreds of times


class LinearizedGuide(PathGuide):
    """What the guides share that linearise the program: each trajectory's path, kept from one `refresh` to the next.

    Args:
        program: the state-space model; its noise is normal, see `linearize`.
        draws: M, paths for each trajectory.
        tempering: schedule of the observation weight.
        known_start: the first state is certain.
        passes: linearisations a `refresh`; one is enough where the parameters have moved little since the last.
        search_again: progress after which a drive's path is searched for anew; the likelier of the two is kept.
    """

    def __init__(
        self,
        program: Program,
        *,
        draws: int = 30,
        tempering: Tempering | None = None,
        known_start: bool = False,
        passes: int = 1,
        search_again: float = 0.2,
    ) -> None:
        super().__init__(draws)
        self.program, self.tempering = program, tempering or LinearRamp()
        self.known_start, self.passes, self.search_again = known_start, passes, search_again

    def look_ahead(self, data: Trajectories, progress: float) -> tuple[Lookahead, dict[str, float]]:
        """Linearise along the remembered paths; search for those that are not there, again for those that are lost, and
        now and then for all: what was found while the program knew little can be a wrong place that it never leaves.

        With the lookahead come figures: the step's observation weight, log p(y) of the linearised program at it, and
        how many paths were lost and searches failed.
        """
        self._search(data, [i for i, label in enumerate(data.labels) if f"states/{label}" not in self.memory], progress)
        ahead = self._smooth(data, progress)
        lost = ahead.is_broken.nonzero().flatten().tolist()
        searched = [float(self.memory[f"searched/{label}"]) for label in data.labels]
        due = [i for i, then in enumerate(searched) if progress - then >= self.search_again and i not in lost]
        counts = {"paths_lost": float(len(lost)), "searches_failed": 0.0}
        self._search(data, lost, progress)
        try:
            self._search(data, due, progress, ahead.log_likelihood)
        except FilterError:  # nothing likelier was found than what is known
            counts["searches_failed"] = 1.0
        if lost or due:
            ahead = self._smooth(data, progress)
        self.remember(ahead.path(data), data)
        self.in_plain_torch = ahead.linearization.in_plain_torch
        figures = {"observation_weight": self.tempering(progress), "log_evidence": float(ahead.log_likelihood.mean())}
        return ahead, figures | {name: count for name, count in counts.items() if count}

    def _search(
        self, data: Trajectories, trajectories: Sequence[int], progress: float, known: Tensor | None = None
    ) -> None:
        """Remember paths found from the measurements alone, where they are likelier than what is known already."""
        if not trajectories:
            return
        part, weight = data.subset(trajectories), self.tempering(progress)
        for label in part.labels:
            self.memory[f"searched/{label}"] = torch.tensor(progress, dtype=torch.float64)
        problem = Problem(self.program, part, self.known_start)
        ahead = find_and_smooth(problem, observation_weight=weight, may_fail=known is not None)
        found = resting_path(ahead, part)
        better = ahead.log_likelihood > (-torch.inf if known is None else known[trajectories])  # not where it is a nan
        if kept := better.nonzero().flatten().tolist():
            self.remember(found.subset(kept), part.subset(kept))

    def _smooth(self, data: Trajectories, progress: float) -> Lookahead:
        has_tails = all(f"variance/{label}" in self.memory for label in data.labels)
        variance = self._recall("variance", data) if has_tails else None
        path = ReferencePath(self._recall("states", data), self._recall("noise", data), variance)
        weight, kernels = self.tempering(progress), data.time.numel() >= GUIDE_ROWS_WORTH_COMPILING
        problem = Problem(self.program, data, self.known_start)
        return smooth(problem, path, observation_weight=weight, passes=self.passes, kernels=kernels)

    def _recall(self, kind: str, data: Trajectories) -> Tensor:
        known = [self.memory[f"{kind}/{label}"] for label in data.labels]
        if any(len(path) != len(data.time) - (kind == "noise") for path in known):
            raise UsageError("this guide remembers other trajectories of the same labels: make a new one for these")
        return torch.stack(known, 1).to(data.controls)

    def remember(self, path: ReferencePath, data: Trajectories) -> None:
        """Begin the next `refresh` at this path of the trajectories of `data` instead of searching for one."""
        for i, label in enumerate(data.labels):
            self.memory.setdefault(f"searched/{label}", torch.tensor(0.0, dtype=torch.float64))
            self.memory[f"states/{label}"] = path.states[:, i]
            self.memory[f"noise/{label}"] = path.noise[:, i]
            if path.variance is not None:
                self.memory[f"variance/{label}"] = path.variance[:, i]


class GaussianGuide(LinearizedGuide):
    """Draws of the linearised program's posterior as the E step: the iterated extended Kalman smoother.

    The cheapest, and as good as any where the posterior is close to normal (10 Hz, three landmarks or more); what it
    neglects, `LookaheadGuide` weighs.
    """

    def refresh(self, data: Trajectories, progress: float) -> dict[str, float]:
        ahead, figures = self.look_ahead(data, progress)
        problem = Problem(self.program, data, self.known_start)
        require_found(ahead, problem)
        paths = smoother_paths(problem, ahead, self.draws, kernels=data.time.numel() >= GUIDE_ROWS_WORTH_COMPILING)
        self.in_plain_torch = self.in_plain_torch or paths.in_plain_torch
        self.keep(paths, data)
        return figures


class LookaheadGuide(LinearizedGuide, FilteringGuide):
    """The particle filter that looks ahead as a guide: a hundred particles do what twenty thousand do in `SMCGuide`.

    Args:
        particles: N, for each trajectory.
        resample_below: share of N under which the effective sample size triggers resampling.

    All others are arguments of `Twist` or of `LinearizedGuide`.
    """

    def __init__(
        self,
        program: Program,
        *,
        particles: int = 100,
        draws: int = 100,
        resample_below: float = 0.5,
        untwisted: float = 0.01,
        tempered: float = 1.0,
        tempering: Tempering | None = None,
        known_start: bool = False,
        passes: int = 1,
        search_again: float = 0.2,
    ) -> None:
        more: dict[str, Any] = {"passes": passes, "search_again": search_again}
        super().__init__(program, draws=draws, tempering=tempering, known_start=known_start, **more)
        require(particles >= 1, "particles", particles, "at least 1")
        self.particles, self.resample_below = particles, resample_below
        self.untwisted, self.tempered = untwisted, tempered

    def refresh(self, data: Trajectories, progress: float) -> dict[str, float]:
        ahead, figures = self.look_ahead(data, progress)
        twist = Twist(ahead, untwisted=self.untwisted, tempered=self.tempered)
        return figures | self._filter(data, self.tempering(progress), twist)


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
        ahead = find_and_smooth(Problem(program, data, self.known_start))
        self.register_buffer("path", ahead.linearization.path.states.to(kind))
        self.register_buffer("angles", ahead.linearization.circular)
        self.steps = _Steered(ahead.steps, kind)
        self.starts = _Steered(ahead.starts, kind, winding=0)
        self.index: list[int] = []

    def begin(self, data: Trajectories) -> Tensor:
        if unknown := [label for label in data.labels if label not in self.labels]:
            raise UsageError(f"this guide has parameters for its own trajectories only, not for {unknown[0]}")
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
        shift, gain, factor = ((part if winding is None else part[winding]).to(kind) for part in steering)
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
