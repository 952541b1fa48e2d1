"""The particle filter: the Pyro program itself, forward in time, for many particles and trajectories.

Gordon, Salmond and Smith (1993); Chopin and Papaspiliopoulos (2020), algorithms 10.1 and 10.3 (adaptive resampling).
With a twist the noise is proposed with a view to the later measurements (Guarniero, Johansen and Lee 2017).
Densities live in the channels: a particle is a start and its channel noise, its states follow.
"""

import math
from contextlib import nullcontext
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import FilterError, ProgramError, UsageError
from steady_ppl.model.handlers import KnownStart, Recording, Standardised, running
from steady_ppl.model.program import Program
from steady_ppl.model.stability import divergence
from steady_ppl.model.starts import first_state
from steady_ppl.model.substeps import channel_values
from steady_ppl.smc.compiled import CompiledFilter, OnFrame, compiled_filter
from steady_ppl.smc.genealogy import Filtered, FilterState, History, Run, event_dims
from steady_ppl.smc.proposal import Proposal
from steady_ppl.smc.resampling import Resampler, effective_sample_size, normalise, systematic, take
from steady_ppl.smc.stepping import Stepping
from steady_ppl.utils.cores import one_thread

STEPS_WORTH_COMPILING = 1_000_000  # steps of particles, which take the program's own lines a second


class Step(NamedTuple):
    """What a filter did at a row."""

    evidence: Tensor  # (B,), log p(y_t | y_0 … y_{t-1}), whose sum is log p(y); looking ahead, these telescope
    effective_sizes: Tensor  # (B,) ESS once the row is weighed; N where nothing was weighed
    blown_up: Tensor  # (B,) how many weights were not numbers; they count as zero
    ancestors: Tensor | None  # (N, B), the particles that move on; None: each
    noise: dict[str, Tensor]  # value of each site of `transition` from this row, (N, B, ...); empty at the last row


@dataclass(eq=False)
class ParticleFilter:
    """A particle filter that goes through a table row by row: `init`, then a `step` a row, under `torch.no_grad()`.

    Its arguments are those of `particle_filter`.
    """

    program: Program
    data: Trajectories
    _: KW_ONLY
    particles: int
    observation_weight: float | Tensor = 1.0
    known_start: bool = False
    resample_below: float = 0.5
    proposal: Proposal = field(default_factory=Proposal)
    resampler: Resampler = systematic
    on_frame: OnFrame | None = None
    start: Recording = field(init=False)  # the sites of `initial`, known after `init`
    stepping: Stepping = field(init=False)  # runs the program's methods, known after `init`

    def __post_init__(self) -> None:
        particles, data = self.particles, self.data
        if self.proposal.looks_ahead and self.on_frame is not None:
            why = "a filter that looks ahead has seen the later measurements"
            raise UsageError(f"on_frame sees what is predicted: {why}")
        self.bootstrap = type(self.proposal) is Proposal
        self.last, self.left = len(data.time) - 1, torch.Size((particles, 1, len(data)))
        self.inside, self.ended = data.rows, (~data.rows).any(1).tolist()  # rows past a trajectory's end
        self.observed = data.observed.any(-1).any(-1).tolist()

    def init(self) -> FilterState:
        """Draw the particles' starts; the state has come to the first row.

        Raises:
            ProgramError: a known start, and `initial` returns another state than the one that it samples.
        """
        program, data = self.program, self.data
        noise, log_ratio = (None, 0.0) if self.known_start else self.proposal.start(self.particles)
        given = nullcontext() if noise is None else Standardised(noise.to(data.controls.dtype).unsqueeze(1))
        drawing = KnownStart(data.known_start) if self.known_start else given
        with running(*self.left), Recording() as self.start, drawing:
            states = first_state(program, data)
        states = states.expand(*self.left, -1).squeeze(1)
        if self.known_start and not bool((states == data.known_start).all()):
            what = "a known start needs initial() to return the sampled state as it is; it returns another"
            raise ProgramError(what, site="initial")
        self.stepping = Stepping(program, data, self.observation_weight)
        size = (len(data), self.particles)
        even = states.new_full(size, -math.log(self.particles), dtype=torch.float64).t()
        self._unmoved = torch.arange(self.particles, device=states.device).expand(size).t()
        self._none, self._all = even.new_zeros(len(data)), even.new_full(size[:1], float(self.particles))
        return FilterState(states=states, log_weights=even + log_ratio, roots=self._unmoved)

    def step(self, state: FilterState, row: int) -> tuple[FilterState, Step]:
        """Weigh the particles that have come to a row 0 … T, resample those trajectories that need it, and move on;
        returned are the particles at the next row, after the last one at itself, and what was done."""
        weighed, weights, future, done = self._weigh(state, row)
        states, log_weights, roots = state.states, weighed, state.roots
        ancestors, noise = None, dict[str, Tensor]()
        if row < self.last and weights is not None:
            log_weights, roots, ancestors = self._resample(weighed, weights, future, done.effective_sizes, roots)
        if self.on_frame is not None:
            self.on_frame(row, states, state.log_weights, weighed)
        if row < self.last:
            states, log_weights, noise = self._move(row, states, log_weights, ancestors)
        return FilterState(states, log_weights, roots), done._replace(ancestors=ancestors, noise=noise)

    def run(self, state: FilterState, keep_history: bool) -> Run:
        """Go from the state that `init` returns through all rows."""
        start, steps = state.states, list[Step]()
        intervals, parents, sizes = list[Tensor](), list[Tensor | None](), dict[str, int]()
        for row in range(self.last + 1):
            state, step = self.step(state, row)
            steps.append(step._replace(ancestors=None, noise={}))
            if keep_history and row < self.last:
                noise = {site: value.reshape(*value.shape[:2], -1) for site, value in step.noise.items()}
                sizes = {site: value.shape[-1] for site, value in noise.items()}
                intervals.append(torch.cat([state.states, *noise.values()], -1).permute(2, 1, 0).contiguous())
                parents.append(None if step.ancestors is None else step.ancestors.t())
        evidence, effective, blown_up = (torch.stack(part) for part in zip(*(one[:3] for one in steps), strict=True))
        history = History(start, intervals, parents, sizes, self.stepping.event_dims) if keep_history else None
        return Run(state, evidence, effective, blown_up, history)

    def _weigh(self, state: FilterState, row: int) -> tuple[Tensor, Tensor | None, Tensor | None, Step]:
        """Log-weights with a row's measurements in them; weights that sum to one and know of the `future`, None where
        nothing was measured; the `future`; and figures of the row."""
        observed, future = self.observed[row], None
        if self.bootstrap and not observed:
            return state.log_weights, None, None, Step(self._none, self._all, self._none, None, {})
        log_weights = state.log_weights + (self.stepping.log_density(row, state.states) if observed else 0.0)
        if self.proposal.looks_ahead:
            future = self._within(row, self.proposal.log_future(row, state.states))
        expected = log_weights if future is None else log_weights + future
        broken = expected.isnan()  # a particle that blew up explains no measurement
        log_weights.masked_fill_(broken, -math.inf)
        weights, evidence = normalise(expected.masked_fill_(broken, -math.inf))
        done = Step(evidence, effective_sample_size(weights), broken.sum(0, dtype=torch.float64), None, {})
        return log_weights - evidence, weights, future, done

    def _resample(
        self, log_weights: Tensor, weights: Tensor, future: Tensor | None, sizes: Tensor, roots: Tensor
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Log-weights, roots and ancestors of the particles that move on."""
        exhausted = sizes < self.resample_below * self.particles
        all_stay = log_weights.device.type == "cpu" and not bool(
            exhausted.any()
        )  # a device would have to be waited for
        if self.resample_below <= 0 or all_stay:
            return log_weights, roots, None
        ancestors = torch.where(exhausted, self.resampler(weights, self.particles), self._unmoved)
        fresh = -math.log(self.particles) - (0.0 if future is None else take(future, ancestors))
        return torch.where(exhausted, fresh, log_weights), take(roots, ancestors), ancestors

    def _move(
        self, row: int, states: Tensor, log_weights: Tensor, ancestors: Tensor | None
    ) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """States at the next row, their log-weights, and the noise that led there."""
        if ancestors is not None:
            states = take(states, ancestors)
        noise, log_ratio = self.proposal.step(row, states)
        moved, values = self.stepping.transition(row, states, noise)
        return moved, log_weights + self._within(row + 1, torch.as_tensor(log_ratio, dtype=torch.float64)), values

    def _within(self, row: int, values: Tensor) -> Tensor:
        """The same, zero past a trajectory's end."""
        return torch.where(self.inside[row], values, 0.0) if self.ended[row] else values


@one_thread()
@torch.no_grad()
def particle_filter(
    program: Program,
    data: Trajectories,
    *,
    particles: int,
    observation_weight: float | Tensor = 1.0,
    known_start: bool = False,
    resample_below: float = 0.5,
    proposal: Proposal | None = None,
    resampler: Resampler = systematic,
    keep_history: bool = True,
    kernels: bool | None = None,
    on_frame: OnFrame | None = None,
) -> Filtered:
    """Run the program as a particle filter on every trajectory at once; with `keep_history` its genealogy is returned.

    Args:
        program: the state-space model.
        data: as returned by `for_program`.
        particles: N, for each trajectory.
        observation_weight: tempers the observations' log-density (w_obs in STEADY); `(B,)` for one a trajectory.
        known_start: start every particle at the true first state instead of drawing it from the prior.
        resample_below: resample a trajectory when its effective sample size falls below this share of N;
            checked at its observed rows (at all rows with a proposal), never at the table's last one.
        proposal: where the noise of start and steps comes from; the program itself when None (the bootstrap filter).
        resampler: how; `systematic`, `stratified` or `multinomial` of `smc.resampling`, or another `Resampler`.
        keep_history: keep what `Filtered.paths` needs.
        kernels: run compiled methods where they can serve; None: if there is enough to do, see `STEPS_WORTH_COMPILING`.
        on_frame: called at every row with (row, states `(N, B, D)`, log-weights before, log-weights after), `(N, B)`;
            not when looking ahead.

    Raises:
        FilterError: every weight is zero; names trajectory and time.
        UsageError: `on_frame` is given with a proposal that looks ahead.
    """
    proposal = proposal or Proposal()
    settings: Any = {"observation_weight": observation_weight, "known_start": known_start}
    settings |= {"resample_below": resample_below, "proposal": proposal, "resampler": resampler, "on_frame": on_frame}
    along = ParticleFilter(program, data, particles=particles, **settings)
    state, rows, reason = along.init(), len(data.time), None
    if kernels is None:
        kernels = particles * data.time.numel() >= STEPS_WORTH_COMPILING
    by_kernels = compiled_filter(along.stepping, state.states, proposal, resampler) if kernels and rows > 1 else None
    if isinstance(by_kernels, CompiledFilter):
        run = by_kernels.run(state, resample_below * particles, keep_history, on_frame)
    else:
        run, reason = along.run(state, keep_history), by_kernels
    _raise_if_broken(program, run.evidence, run.blown_up, data)
    roots = run.end.roots
    return Filtered(
        log_likelihood=run.evidence.sum(0),
        log_weights=run.end.log_weights,
        effective_sizes=run.effective_sizes,
        roots=torch.zeros_like(run.end.log_weights).scatter_(0, roots, 1.0).sum(0),
        blown_up=run.blown_up.sum(0),
        start={site: value.squeeze(1) for site, value in along.start.expanded(along.left).items()},
        event_dims={"states": 1} | event_dims(along.start) | along.stepping.event_dims,
        history=run.history,
        in_plain_torch=reason,
        channels=None if program.substeps == 1 else partial(channel_values, program, data),
    )


def _raise_if_broken(program: Program, log_likelihood: Tensor, blown_up: Tensor, data: Trajectories) -> None:
    """Find the first row whose evidence is not finite."""
    for row, drive in (~torch.isfinite(log_likelihood)).nonzero()[:1].tolist():
        label, time = data.labels[drive], float(data.elapsed[row, drive])
        impossible = bool(log_likelihood[row, drive] == -math.inf) and not bool(blown_up[: row + 1, drive].any())
        what = divergence(program, data.subset([drive]), row) or (
            "every particle's weight is zero: the measurement is impossible under the model"
            if impossible
            else "no particle is left that is a number: the model's parameters or states have blown up"
        )
        raise FilterError(f"trajectory {label} at {time:.3g} s: {what}", trajectory=label, time=time)
