"""The AlphaTruck with what its hand-written model lacks, found from bearings alone (`make truck`, docs/truck.md)."""

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import nn, tensor

from steady_ppl import delayed, dense, stack

from .truck import Truck


class DiscoveredTruck(Truck):
    """The hand-written truck, and:

    speed, turn as commanded `delay` seconds before                     it acts later than commanded
    turned    = (1 − share) turn + share · turn / speed · v              it steers a curve, not a turn rate
    a_forward = clip((speed_gain · speed − v) / speed_time, ±limit) + bias − w · yaw_rate
                                                                         it follows its command with a lag
    a_lateral = ((lever + slip · (v − 1.3)) yaw_rate + crab · v − w) / grip_time + v · yaw_rate
                                                                         the tracked point is before the rear axle
    a_yaw     = clip((turn_gain · turned − yaw_rate) / turn_time, ±limit) − caster · v · yaw_rate
                                                                         curves open forwards, close backwards
    σ         = noise · (1 + erratic · (|a_forward|, 0, |turn − yaw_rate|))
                                                                         it pulls and turns in unevenly

    v and w are the forward and lateral velocity; the lever is that at 1.3 m/s, where these trajectories turn.
    """

    substeps = 4
    turning_speed = 1.3  # m/s
    settling = property(lambda self: self.grip_time)
    rates = {"noise": 3.0, "erratic": 3.0}

    def __init__(self):
        super().__init__()
        self.speed_gain = PyroParam(tensor(0.92), constraints.positive)
        self.turn_gain = PyroParam(tensor(0.82), constraints.positive)
        self.speed_time = PyroParam(tensor(0.12), constraints.positive)
        self.turn_time = PyroParam(tensor(0.07), constraints.positive)
        self.grip_time = PyroParam(tensor(0.05), constraints.positive)
        self.limit = PyroParam(tensor(6.0), constraints.positive)
        self.delay = PyroParam(tensor(0.08), constraints.positive)
        self.share = PyroParam(tensor(0.75))
        self.bias = PyroParam(tensor(0.0))
        self.lever = PyroParam(tensor(0.25))
        self.slip = PyroParam(tensor(0.0))
        self.crab = PyroParam(tensor(0.0))
        self.caster = PyroParam(tensor(0.7))
        self.erratic = PyroParam(tensor([0.6, 1.0]), constraints.positive)
        self.noise = PyroParam(tensor([0.9, 0.4, 1.2]), constraints.positive)

    def actuators(self, control, time):
        return delayed(control, time, self.delay)

    def accelerations(self, state, control, step):
        """Means and standard deviations, `(..., 3)` each."""
        speed, turn = control.unbind(-1)
        forward, lateral, yaw_rate = self.body_velocity(state)
        by_curvature = turn * speed * forward / (speed**2 + 0.05**2)
        turned = turn + self.share * (by_curvature - turn)
        sideways = (self.lever + self.slip * (forward - self.turning_speed)) * yaw_rate + self.crab * forward
        mean = stack(
            ((self.speed_gain * speed - forward) / self.speed_time).clamp(-self.limit, self.limit)
            + self.bias
            - lateral * yaw_rate,
            (sideways - lateral) / self.grip_time + forward * yaw_rate,
            ((self.turn_gain * turned - yaw_rate) / self.turn_time).clamp(-self.limit, self.limit)
            - self.caster * forward * yaw_rate,
        )
        pull, askew = mean[..., 0].abs(), (turn - yaw_rate).abs()
        by_pull, by_turn = self.erratic.unbind(-1)
        wider = stack(1 + by_pull * pull, torch.ones_like(pull), 1 + by_turn * askew)
        return mean, self.noise * wider

    def transition(self, state, control, time, step):
        mean, sd = self.accelerations(state, control, step)
        acceleration = pyro.sample("acceleration", dist.Normal(mean, sd).to_event(1))
        return self.integrate(state, acceleration, step)


class HybridTruck(DiscoveredTruck):
    """The discovered truck, and a network for what is left of its accelerations and of their spread.

    z = (v, w, yaw_rate, speed, turn) in units of 2 m/s, .5 m/s, 1 rad/s, 2 m/s, 1 rad/s
    mean = discovered + 3 head(hidden z),   σ = discovered · exp(wider z)

    The heads start at zero, as the discovered truck, and decay strongly: what they keep they have earned.
    """

    rates = {**DiscoveredTruck.rates, "hidden": 0.3, "wider": 1.0}
    decays = {"hidden": 20.0, "wider": 20.0}

    def __init__(self):
        super().__init__()
        self.hidden_in = nn.Linear(5, 64)
        self.hidden_out = nn.Linear(64, 3)
        self.wider = nn.Linear(5, 3)
        for head in (self.hidden_out, self.wider):
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)

    def rest(self, state, control):
        """What the network adds to the accelerations, `(..., 3)`, and the logarithm of its factor on their spread."""
        forward, lateral, yaw_rate = self.body_velocity(state)
        speed, turn = control.unbind(-1)
        inputs = stack(forward / 2, lateral / 0.5, yaw_rate, speed / 2, turn)
        return 3 * dense(self.hidden_out, dense(self.hidden_in, inputs).relu()), dense(self.wider, inputs)

    def accelerations(self, state, control, step):
        mean, sd = super().accelerations(state, control, step)
        more, wider = self.rest(state, control)
        return mean + more, sd * wider.clamp(-3, 3).exp()
