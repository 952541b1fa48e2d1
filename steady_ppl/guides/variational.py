"""Guides with parameters of their own: the program, rolled out under noise that they propose (SVI).

States follow from the start and the channel noise, differentiable from end to end; the joint density is the same as for
every other guide. Kingma and Welling (2014); Krishnan, Shalit and Sontag (2017).
"""

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
from torch.distributions.utils import vec_to_tril_matrix

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import UsageError, require
from steady_ppl.gaussian.predict import on_a_circle
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.guides.path_guides import Constant, Tempering, sample_known
from steady_ppl.likelihood.scores import channel_moments
from steady_ppl.model.handlers import KnownStart, Recording, Replaying, Standardised, Substituting, running
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.model.starts import first_state
from steady_ppl.model.substeps import row_inputs, sample_row
from steady_ppl.model.validate import noise_size, start_size
from steady_ppl.smc.genealogy import Paths, event_dims

HIDDEN_UNITS, BOUND = 16, 3.0  # units of a network beside its affine mean, and how many times the usual size they reach


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
            with running(self.draws, 1, len(data)), Recording() as seen, Replaying(paths.start):
                first_state(self.program, data)
            logs = [fn.log_prob(paths.start[site]) for site, fn in seen.distributions.items()]
            density = density + torch.stack(logs).sum((0, 2, 3))
        if not self.centred or weight != 1:
            channels = paths.channels(self.program, data)
            noises = torch.stack([fn.log_prob(paths.noise[site]) for site, fn in channels.items()]).sum(0)
            of_noise = torch.where(data.transitions, noises, 0.0).sum((1, 2))  # under the program, as `Joint` scores it
            density = density + (1 - weight * self.centred) * of_noise
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
                state = first_state(self.program, data).expand(*left, -1).squeeze(1)
            states, values = [state], dict[str, list[Tensor]]()
            by_row = zip(*(values.split(1) for values in row_inputs(self.program, data)), strict=True)
            for row, given in enumerate(by_row):
                noise, density = self.step(row, state)
                inside = data.transitions[row]
                later = later + torch.where(inside, density, 0.0).sum(-1)
                with Recording() as moving, (Substituting if self.centred else Standardised)(noise.unsqueeze(1)):
                    moved = sample_row(self.program, state.unsqueeze(1), *given).squeeze(1)
                state = torch.where(inside[:, None], moved, state)
                states.append(state)
                for site, value in moving.values.items():
                    values.setdefault(site, []).append(value)
        dims = event_dims(started, moving)
        paths = Paths(
            states=torch.stack(states, 1),
            start=started.expanded(left),
            noise={site: torch.cat(parts, 1) for site, parts in values.items()},
            event_dims=dims | {"states": 1},
        )
        return paths, at_start, later


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
        self.sizes, self.labels = (start_size(program), noise_size(program)), data.labels
        self.now: dict[str, Tensor] = {}
        zeros = {name: data.controls.new_zeros(shape) for name, shape in self._shapes(data).items()}
        with pyro.settings.context(module_local_params=True), poutine.block():
            self.auto = auto(self._noise, **{"init_loc_fn": init_to_value(values=zeros)} | (options or {}))
            self.auto(data)  # makes its parameters

    def begin(self, data: Trajectories) -> Tensor:
        """Draw all noise at once; log q(ε) − log N(ε; 0, 1) of it, `(M,)`."""
        if data.labels != self.labels:
            why = "it takes no others and no batch"
            raise UsageError(f"an automatic guide has parameters for each of its trajectories: {why}")
        names, normal = list(self._shapes(data)), dist.Normal(0.0, 1.0)
        with pyro.settings.context(module_local_params=True), poutine.block():
            traces = [poutine.trace(self.auto).get_trace(data) for _ in range(self.draws)]
        drawn: list[list[Any]] = [[trace.nodes[name]["value"] for name in names] for trace in traces]
        priors = [torch.stack([normal.log_prob(value).sum() for value in one]).sum() for one in drawn]
        self.now = {name: torch.stack(values) for name, values in zip(names, zip(*drawn, strict=True), strict=True)}
        padded = data.controls.new_zeros(self.draws, *data.transitions.shape, self.sizes[1])
        padded[:, data.transitions] = self.now["noise"]
        self.now["noise"] = padded
        return torch.stack([trace.log_prob_sum() - prior for trace, prior in zip(traces, priors, strict=True)])

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


class InferenceNetwork(VariationalGuide):
    """What a trajectory's later measurements say of its noise, learned for all trajectories at once.

    Backward in time a recurrent network reads measurements and controls. Its code, of all rows at once, is turned with
    the interval's own control and step into a proposal for each interval: normal, with a mean that depends on the state
    reached so far, in an affine way, as a linear program asks for, and through a small hidden layer (the structured
    approximation DKS of Krishnan, Shalit and Sontag 2017). Its output layers begin at zero: it first proposes noise of
    the size that the program then has, around its mean or, centred, around zero.

    Measurements and states are scaled by the moments of `data` and of its smoothed states, and so is the mean of
    centred noise.

    Args:
        data: training trajectories, as returned by `for_program`.
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
        path = find_and_smooth(Problem(program, data, self.known_start)).path(data)
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
        first, later, size = start_size(program), noise_size(program), features.shape[-1]
        acting = data.controls.shape[-1] + 1
        inputs = 3 * data.measurements.shape[-1] + acting
        self.step_scale = data.median_step
        self.sizes = {"first": first, "later": later, "features": size, "acting": acting}
        self.encoder = nn.Linear(inputs, width)
        self.recurrent = nn.GRU(width, width)
        self.first = nn.Linear(width, 2 * first + _below(first))
        given = width + inputs + acting
        self.affine = nn.Linear(given, later * (2 + size) + _below(later))
        self.by_code, self.by_state = nn.Linear(given, HIDDEN_UNITS), nn.Linear(size, HIDDEN_UNITS, bias=False)
        self.head = nn.Linear(HIDDEN_UNITS, later, bias=False)
        for layer in (self.first, self.affine, self.head):
            for value in layer.parameters():
                nn.init.zeros_(value)
        self.to(data.controls)

    def begin(self, data: Trajectories) -> Tensor:
        """Read the trajectories backward; centred, log q(z) of all intervals' noise, `(M,)`, which no state changes."""
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
        """Of a full covariance: where a trajectory begins, how it heads and how fast it is hang together."""
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
    return torch.diag_embed(log_diagonal.exp()) + vec_to_tril_matrix(below, -1)


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
