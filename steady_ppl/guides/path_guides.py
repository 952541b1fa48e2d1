"""Guides at given paths, filtered or known, and schedules of the observation weight."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError, FilterError, ProgramError, require
from steady_ppl.model.handlers import Recording, Substituting, masked, running
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import row_inputs, sample_row
from steady_ppl.model.validate import noise_size
from steady_ppl.smc.filter import STEPS_WORTH_COMPILING, particle_filter
from steady_ppl.smc.genealogy import Paths, event_dims
from steady_ppl.smc.proposal import Proposal
from steady_ppl.utils.angles import wrap_angles

TYPICAL_E_STEPS = 100  # of E steps are in a training
MAX_GAUSS_NEWTON_STEPS = 30
NOISE_TOLERANCE = 1e-9  # of a channel's size and unit, by which noise may still move when it is found
Tempering = Callable[[float], float]  # a schedule: the observation weight at a share of the training, 0 to 1


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
        self.memory: dict[str, Tensor] = {}
        self.in_plain_torch: str | None = None

    def refresh(self, data: Trajectories, progress: float) -> dict[str, float]:
        """The E step: draw new paths for `data` at `progress` (0 to 1); returns figures for the log.

        Raises:
            FilterError: the filter or the linearised program broke down, or a path is not finite.
        """
        raise NotImplementedError

    def keep(self, paths: Paths, data: Trajectories) -> None:
        """Store paths of `data`, their padding filled; a state that is not finite is a `FilterError`."""
        self.paths = paths.within(data)
        broken = ~torch.isfinite(self.paths.states).all(-1).all(0) & data.rows
        for row, drive in broken.nonzero()[:1].tolist():
            label, time = data.labels[drive], float(data.elapsed[row, drive])
            what = f"trajectory {label} at {time:.3g} s: a state is not finite: the model has blown up"
            raise FilterError(what, trajectory=label, time=time)

    def __call__(self, data: Trajectories) -> None:
        """The guide of the model `Joint`; `data` are the trajectories of the last `refresh`."""
        if self.paths is None:
            raise RuntimeError("refresh(data, progress) must run before the guide does")
        sample_known(self.paths, data)


class FilteringGuide(PathGuide):
    """A guide that draws its paths by a particle filter."""

    program: Program
    known_start: bool
    particles: int  # N, for each trajectory
    resample_below: float  # share of N under which the effective sample size triggers resampling

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
            kernels=TYPICAL_E_STEPS * self.particles * data.time.numel() >= STEPS_WORTH_COMPILING,
        )
        self.in_plain_torch = filtered.in_plain_torch or (proposal and self.in_plain_torch) or None
        self.keep(filtered.paths(self.draws), data)
        weighed = data.observed.any(-1) if proposal is None else data.rows
        figures = {"ess": float(filtered.effective_sizes[weighed].mean()), "roots": float(filtered.roots.mean())}
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

    def known(site: str, value: Tensor) -> None:
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


@torch.no_grad()
def true_paths(program: Program, data: Trajectories) -> Paths:
    """The true states of `data`, all known, with the channel noise that leads from one to the next.

    Gauss and Newton's method from zero noise: least squares on the differences that a unit of each channel makes; one
    pass is exact where the next state is affine in the noise. What noise cannot explain (a position that does not
    follow from the velocity) is left over, and the more of that, the more precise the derivatives must be: the program
    runs in double precision. Angles are compared on the circle.

    Raises:
        DataError: a state is unknown.
        ProgramError: no noise is found within `MAX_GAUSS_NEWTON_STEPS`, or the start is not one site.
    """
    own = torch.tensor([name not in program.kept_names for name in program.state_names], device=data.time.device)
    if (states := data.states) is None or not bool(torch.isfinite(states[data.rows][:, own]).all()):
        raise DataError("supervised learning needs the true state of every row: the table's x. columns are incomplete")
    states = torch.where(data.rows[..., None], states, states[:1]).nan_to_num()  # what is kept follows from the others
    exact, within = copy.deepcopy(program).double(), data.to(torch.float64)
    before, after = states[:-1].double(), states[1:].double()
    inputs = row_inputs(exact, within)

    def run(noise: Tensor) -> tuple[Tensor, Recording]:
        with running(*before.shape[:-1]), Recording() as recording, Substituting(noise):
            return sample_row(exact, before, *inputs), recording

    channels = torch.eye(noise_size(program)).to(before)
    noise = before.new_zeros(*before.shape[:-1], len(channels))
    for _ in range(MAX_GAUSS_NEWTON_STEPS):
        base, _ = run(noise)
        effect = torch.stack([run(noise + channel)[0] - base for channel in channels], -1)[..., own, :]
        difference = wrap_angles(after - base, program.angle_indices)[..., own]
        change = (torch.linalg.pinv(effect) @ difference.unsqueeze(-1)).squeeze(-1)
        change = torch.where(within.transitions.unsqueeze(-1), change, 0.0)  # behind a trajectory's end is nothing
        noise = noise + change
        if not bool((change.abs() > NOISE_TOLERANCE * (1 + noise.abs())).any()):
            break
    else:
        what = "no channel noise was found that leads from one true state to the next"
        why = "(transition bends too much in its noise): supervised learning cannot tell which it was"
        raise ProgramError(f"model {type(program).__name__}: {what} {why}", site="transition")
    ends, moving = run(noise)
    states = torch.cat([states[:1], torch.where(own, states[1:], ends.to(states))])
    with running(1, before.shape[1]), Recording() as start:
        program.initial()
    if len(start.values) != 1:
        raise ProgramError("supervised learning needs initial() to sample the whole state as one site", site="initial")
    (site,) = start.values
    width = start.distributions[site].event_shape.numel()  # other states rest at the start
    return Paths(
        states=states[None],
        start={site: states[None, :1, :, :width]},
        noise={s: value[None].to(states.dtype) for s, value in moving.values.items()},
        event_dims=event_dims(start, moving) | {"states": 1},
    )


@dataclass(frozen=True)
class Constant:
    """The same weight throughout; 1 is STEADY− (no tempering)."""

    weight: float = 1.0

    def __call__(self, progress: float) -> float:
        return self.weight


@dataclass(frozen=True)
class LinearRamp:
    """From `first` to 1 over the first `share` of the training; the paper ramps from 0.001 over all of it.
    A share of 0 is no ramp."""

    first: float = 0.001
    share: float = 1.0

    def __post_init__(self) -> None:
        require(0 <= self.first < math.inf, "the first weight", self.first, "0 or more")
        require(0 <= self.share < math.inf, "the ramp's share of the training", self.share, "0 or more")

    def __call__(self, progress: float) -> float:
        return self.first + (1 - self.first) * min(1.0, progress / self.share) if self.share > 0 else 1.0
