"""The joint density of one program over whole trajectories: what the M step and SVI differentiate."""

from contextlib import nullcontext

import pyro
import pyro.distributions as dist
from pyro.distributions import constraints

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.model.handlers import KnownStart, Observing, masked
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import row_inputs, sample_channels


class Joint:
    """The program as a Pyro model of whole trajectories, every step evaluated at once.

    The site `states` carries what a guide knows about the states, at density one; with the channel noise that goes with
    them the transitions need no loop over time. Draws, if any, are at dimension −3, rows at −2, trajectories at −1.
    Priors of the program's parameters are counted once a call. With `known_start` the first state is not scored.
    """

    def __init__(self, program: Program, *, known_start: bool = False) -> None:
        self.program, self.known_start = program, known_start

    def __call__(self, data: Trajectories) -> None:
        """The model. `data` is as returned by `for_program`."""
        for name, prior in self.program.priors.items():
            pyro.factor(f"prior of {name}", prior.log_prob(getattr(self.program, name)).sum())
        rows, trajectories = data.time.shape
        dimension = len(self.program.states)
        with pyro.plate("trajectory", trajectories, dim=-1):
            with pyro.plate("row", rows, dim=-2), masked(data.rows):
                states = pyro.sample("states", dist.ImproperUniform(constraints.real_vector, (), (dimension,)))
            certain = KnownStart(data.known_start) if self.known_start else nullcontext()
            with pyro.plate("first_row", 1, dim=-2), certain:
                self.program.initial()
            with pyro.plate("interval", rows - 1, dim=-2), masked(data.transitions):
                sample_channels(self.program, states[..., :-1, :, :], *row_inputs(self.program, data))
            with pyro.plate("observed_row", rows, dim=-2), Observing(data.measurements, data.observed):
                self.program.observe(states)
