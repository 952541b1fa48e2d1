"""Fixed problems whose posteriors a long NUTS has stored in `tests/reference`, and how far draws are from these."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from examples import copies, example
from torch import Tensor

from steady_ppl import Program, Trajectories, stack
from steady_ppl.model.handlers import Observing, Recording, Standardised, running

FOLDER = Path(__file__).parent / "reference"


class Started(Program):
    """A start of which enough is known to leave one turn and one mode.

    Its moments are among the numbers that are stored.
    """

    start = ((), ())

    def __init__(self):
        super().__init__()
        mean, sd = (torch.tensor(values, dtype=torch.float64) for values in self.start)
        self.register_buffer("start_mean", mean)
        self.register_buffer("start_sd", sd)

    def initial(self):
        return pyro.sample("start", dist.Normal(self.start_mean, self.start_sd).to_event(1))


class Hovercraft(Started, type(example("paper.py:PaperHovercraftTruth"))):
    """Drag, and bearings at 10 Hz to four landmarks some ten metres off: normal but for a hundredth.

    Explicit Euler, as NUTS ran it.
    """

    start = (0.5, 1.0, 0.6, 0.3, 0.1, 0.1), (0.3, 0.3, 0.1, 0.2, 0.2, 0.1)


class Network(Started, type(example("paper.py:PaperNeuralHovercraft"))):
    """Noise that depends on the state, and bearings to two landmarks close by at 1 Hz: not normal.

    Explicit Euler, as NUTS ran it.
    """

    landmarks = ((4.0, -2.0), (-2.0, 4.5))
    start = (0.5, 1.0, 0.6, 0.3, 0.1, 0.1), (0.5, 0.5, 0.3, 0.3, 0.3, 0.15)
    step = 0.25


class Pendulum(Started, type(example("pendulum"))):
    """Falls from near its top, and is seen three times: not quite normal; semi-implicit Euler, as NUTS ran it."""

    start = (2.9, 0.3), (0.3, 0.5)
    step = 0.075
    substeps = 1

    def transition(self, state, control, time, step):
        angle, rate = state.unbind(-1)
        mean = -self.stiffness * angle.sin() - self.damping * rate + self.gain * control[..., 0]
        rate = rate + pyro.sample("acceleration", dist.Normal(mean, self.noise)) * step
        return stack(angle + rate * step, rate)


PROBLEMS = {"hovercraft": Hovercraft, "network": Network, "pendulum": Pendulum}


def rolled_out(program: Program, data: Trajectories, start: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """The program as a function of standard normal noise, differentiable.

    Args:
        start: `(B, C₀)`.
        noise: `(T, B, C)`.

    Returns:
        The states `(T + 1, B, D)`, and log p(y) given these, `(B,)`.
    """
    rows, trajectories = data.time.shape
    with running(1, trajectories), Standardised(start.unsqueeze(0)):
        states = [program.initial()]
    for row in range(rows - 1):
        at = data.controls[row, None], data.elapsed[row, None], data.steps[row, None]
        with running(1, trajectories), Standardised(noise[row, None]):
            states.append(program.transition(states[-1], *at))
    path, seen = torch.cat(states), Recording()
    with running(rows, trajectories), seen, Observing(data.measurements, data.observed):
        program.observe(path)
    return path, seen.total().sum(0)


@dataclass(frozen=True)
class Reference:
    """A problem and its posterior.

    Attributes:
        mean, sd: of every state at every row, `(T + 1, D)`.
        mean_error, sd_error: Monte-Carlo standard errors of these.
        a_draw: one draw of NUTS: its `start` and `noise`, the `states` that they led to and their `log_likelihood`.
    """

    program: Program
    data: Trajectories
    mean: Tensor
    mean_error: Tensor
    sd: Tensor
    sd_error: Tensor
    a_draw: dict[str, Tensor]


@cache
def reference(name: str) -> Reference:
    """A stored problem; every number of its program and its data is read, none is drawn."""
    stored = json.loads((FOLDER / f"{name}.json").read_text())
    program = PROBLEMS[name]().double().requires_grad_(False)
    program.load_state_dict(numbers(stored["program"]))
    columns = {
        "control_names": program.control_names,
        "measurement_names": program.measurement_names,
        "state_names": program.state_names,
    }
    data = Trajectories(**numbers(stored["data"]), **columns)
    return Reference(program, data, **numbers(stored["posterior"]), a_draw=numbers(stored["a_draw"]))


def numbers(values: dict[str, list]) -> dict[str, Tensor]:
    """Tensors of JSON lists, bit by bit: reals in double precision, as NumPy reads them."""
    return {name: torch.from_numpy(np.array(value)) for name, value in values.items()}


def runs(data: Trajectories, count: int) -> Trajectories:
    """The drive `count` times, each with a name of its own: what a guide remembers of one is no other's."""
    return replace(copies(data, count), labels=tuple(str(run) for run in range(count)))


def errors_off(reference: Reference, states: Tensor) -> Tensor:
    """How many standard errors draws miss the stored means and standard deviations by, `(2, T + 1, D)`.

    The error joins NUTS's and the engine's own. The latter comes from the scatter of independent runs, since the draws
    of one run share ancestors. Spread is judged by v = the mean square about the stored mean, which has no bias that
    the engine has not, as (v / sd + sd) / 2.

    Args:
        states: `(M, T + 1, R, D)` of R runs.
    """
    mean, sd = reference.mean.unsqueeze(1), reference.sd.unsqueeze(1)
    spreads = 0.5 * ((states - mean).square().mean(0) / sd + sd)
    scores = []
    for found, exact, error in (
        (states.mean(0), reference.mean, reference.mean_error),
        (spreads, reference.sd, reference.sd_error),
    ):
        own = found.var(1) / states.shape[2]
        scores.append((found.mean(1) - exact) / (own + error.square()).sqrt())
    return torch.stack(scores)
