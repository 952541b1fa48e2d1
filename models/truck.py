"""The AlphaTruck of STEADY (IROS 2022), commanded in speed and turn rate, as its authors model it by hand."""

import math

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import PlanarVehicle, bearings_to, stack


class Truck(PlanarVehicle):
    """Reaches its command in about a tenth of a second if the acceleration limit allows, and never slips.

    a_forward = clip((speed_gain · speed − v) / settling, ±limit) − w · yaw_rate    v forward velocity
    a_lateral = −w / settling + v · yaw_rate                                        w lateral velocity
    a_yaw     = clip((turn_gain · turn − yaw_rate) / settling, ±limit)

    The terms with the yaw rate turn the velocity along with the vehicle.
    """

    controls = ("speed [m/s]", "turn [rad/s]")
    landmarks = ((-1.230314, -0.606814), (0.797073, 0.889471), (-3.496525, 0.207874), (0.0, 6.0))
    rates = {"noise": 3.0}
    guesses = ("noise",)  # wide enough for whatever the equations lack
    slips = False
    substeps = 2
    settling = 0.1  # s

    def __init__(self):
        super().__init__()
        self.speed_gain = PyroParam(tensor(1.0), constraints.positive)
        self.turn_gain = PyroParam(tensor(0.5), constraints.positive)
        self.limit = PyroParam(tensor(6.0), constraints.positive)
        self.noise = PyroParam(tensor([5.0, 5.0, 2.0]), constraints.positive)

    def initial(self):
        mean = torch.zeros(6).to(self.noise)
        sd = tensor([3.0, 3.0, math.pi, 1.0, 1.0, 0.5]).to(self.noise)
        return pyro.sample("start", dist.Normal(mean, sd).to_event(1))

    def transition(self, state, control, time, step):
        speed, turn = control.unbind(-1)
        forward, lateral, yaw_rate = self.body_velocity(state)
        mean = stack(
            ((self.speed_gain * speed - forward) / self.settling).clamp(-self.limit, self.limit) - lateral * yaw_rate,
            -lateral / self.settling + forward * yaw_rate,
            ((self.turn_gain * turn - yaw_rate) / self.settling).clamp(-self.limit, self.limit),
        )
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)

    def observe(self, state):
        pyro.sample("bearing", bearings_to(self.landmarks, state, sd=self.bearing_sd))

    def example_controls(self, time):
        """Speeds and curvatures held for two seconds each."""
        held = (time / 2).long()
        drives = time.shape[1]
        speeds = 2 * torch.rand(int(held.max()) + 1, drives) - 0.7
        curvatures = 1.5 * torch.rand(int(held.max()) + 1, drives) - 0.75
        speed, curvature = speeds.gather(0, held).to(time), curvatures.gather(0, held).to(time)
        return torch.stack([speed, speed * curvature], -1)
