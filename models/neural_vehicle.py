"""Planar vehicles whose dynamics are a network: what STEADY learns when no equation is known."""

import math

import pyro
import pyro.distributions as dist
import torch
from torch import nn, tensor

from steady_ppl import DataError, ExplicitEuler, PlanarVehicle, bearings_to, dense, smoothed_states, stack


class NeuralVehicle(PlanarVehicle):
    """Body-frame accelerations from body-frame velocities and controls, by a network with a linear skip.

    z = (v, w, yaw_rate, controls), normalised
    mean = scale · (skip z + head(hidden z)),   sd = scale · max(softplus(noise z), 0.001)

    One hidden layer of 64 as in the paper; its code has a second, residual one and the absolute heading among the
    inputs (`layers=2, absolute_heading=True`). The heads start at zero: constant velocity and large noise.

    Args:
        layers: 1 or 2 hidden layers of 64.
        absolute_heading: add cos and sin of the heading to the inputs.
        normalise: "smoothed" takes the moments of the velocities from a smoother run before learning; "truth" from the
            true training states, a mild leak that the authors' code has.
    """

    acceleration_scale = (1.0, 1.0, 1.0)
    rates = {"noise": 4.0}
    decays = {"hidden": 10.0, "skip": 0.1, "noise": 10.0}

    def __init__(self, *, layers=1, absolute_heading=False, normalise="smoothed"):
        super().__init__()
        if layers not in (1, 2) or normalise not in ("smoothed", "truth"):
            raise ValueError(f"layers is 1 or 2 and normalise 'smoothed' or 'truth', got {layers} and {normalise!r}")
        self.absolute_heading, self.normalise = absolute_heading, normalise
        inputs = 3 + len(self.controls) + 2 * absolute_heading
        self.skip = nn.Linear(inputs, 3)
        self.hidden_in = nn.Linear(inputs, 64)
        self.hidden_residual = nn.Linear(64, 64) if layers == 2 else None
        self.hidden_out = nn.Linear(64, 3)
        self.noise = nn.Linear(inputs, 3)
        for head in (self.skip, self.hidden_out, self.noise):
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)
        self.register_buffer("scale", tensor(self.acceleration_scale))
        self.register_buffer("input_mean", torch.zeros(3 + len(self.controls)))
        self.register_buffer("input_sd", torch.ones(3 + len(self.controls)))

    def prepare(self, data, known_start):
        """Normalise by the moments of the controls and of smoothed (or, if asked, true) body velocities."""
        if self.normalise == "truth" and (data.states is None or not bool(data.states[data.rows].isfinite().all())):
            raise DataError('normalise="truth" needs the true state of every row: the x. columns are incomplete')
        states = data.states if self.normalise == "truth" else smoothed_states(self, data, known_start=known_start)
        inputs = stack(*self.body_velocity(states), *data.controls.unbind(-1))[data.rows]
        self.input_mean.copy_(inputs.mean(0))
        self.input_sd.copy_(inputs.std(0).clamp(min=1e-3))

    def initial(self):
        mean = torch.zeros(6).to(self.scale)
        sd = tensor([3.0, 3.0, math.pi, 1.0, 1.0, 0.5]).to(self.scale)
        return pyro.sample("start", dist.Normal(mean, sd).to_event(1))

    def transition(self, state, control, time, step):
        inputs = stack(*self.body_velocity(state), *control.unbind(-1))
        inputs = (inputs - self.input_mean) / self.input_sd
        if self.absolute_heading:
            heading = state[..., 2]
            inputs = stack(*inputs.unbind(-1), heading.cos(), heading.sin())
        hidden = dense(self.hidden_in, inputs).relu()
        if self.hidden_residual is not None:
            hidden = hidden + dense(self.hidden_residual, hidden).relu()
        mean = self.scale * (dense(self.skip, inputs) + dense(self.hidden_out, hidden))
        sd = self.scale * nn.functional.softplus(dense(self.noise, inputs)).clamp(min=1e-3)
        acceleration = pyro.sample("acceleration", dist.Normal(mean, sd).to_event(1))
        return self.integrate(state, acceleration, step)

    def observe(self, state):
        pyro.sample("bearing", bearings_to(self.landmarks, state, sd=self.bearing_sd))


class NeuralHovercraft(NeuralVehicle):
    """The hovercraft, nothing known of its dynamics but that its accelerations are at most some 1 m/s², 1 rad/s²."""

    controls = ("left [N]", "right [N]")
    landmarks = ((12.0, -8.0), (-6.0, -4.0), (-4.0, 10.0), (6.0, 7.0))
    acceleration_scale = (1.0, 1.0, 1.0)

    def initial(self):
        mean = tensor([0.5, 1.0, math.pi / 5, 0.25, 0.1, math.pi / 50]).to(self.scale)
        sd = tensor([2.0, 2.0, math.pi, 0.3, 0.2, 0.1 * math.pi]).to(self.scale)
        return pyro.sample("start", dist.Normal(mean, sd).to_event(1))


class NeuralTruck(NeuralVehicle):
    """The AlphaTruck, likewise, with 3 m/s² and 3 rad/s²."""

    controls = ("speed [m/s]", "turn [rad/s]")
    landmarks = ((-1.230314, -0.606814), (0.797073, 0.889471), (-3.496525, 0.207874), (0.0, 6.0))
    acceleration_scale = (3.0, 3.0, 3.0)
    decays = {"hidden": 1.0, "skip": 0.1, "noise": 3.0}


class AuthorsHovercraft(ExplicitEuler, NeuralHovercraft):
    """The authors' variant: two layers, absolute heading, normalised by true states (a leak); explicit Euler."""

    rates = {}
    decays = {}

    def __init__(self):
        super().__init__(layers=2, absolute_heading=True, normalise="truth")


class AuthorsTruck(ExplicitEuler, NeuralTruck):
    """The same for the AlphaTruck."""

    rates = {}
    decays = {}

    def __init__(self):
        super().__init__(layers=2, absolute_heading=True, normalise="truth")
