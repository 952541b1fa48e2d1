"""A hovercraft with two propellers, seen through bearings to four landmarks (Hov of STEADY, IROS 2022)."""

import math

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import PlanarVehicle, bearings_to, stack


class Hovercraft(PlanarVehicle):
    """Two propellers, no drag: what its owner believes.

    a_forward = (left + right) / mass,  a_lateral = 0,  a_yaw = (right − left) / inertia      [body frame]
    """

    controls = ("left [N]", "right [N]")
    landmarks = ((12.0, -8.0), (-6.0, -4.0), (-4.0, 10.0), (6.0, 7.0))
    rates = {"noise": 3.0}
    guesses = ("noise",)

    def __init__(self):
        super().__init__()
        self.mass = PyroParam(tensor(1.5), constraints.positive)
        self.inertia = PyroParam(tensor(1.5), constraints.positive)
        self.noise = PyroParam(tensor([0.2, 0.2, 0.1]), constraints.positive)

    def initial(self):
        mean = tensor([0.5, 1.0, math.pi / 5, 0.25, 0.1, math.pi / 50])
        sd = tensor([2.0, 2.0, math.pi, 0.3, 0.2, 0.1 * math.pi])
        return pyro.sample("start", dist.Normal(mean.to(self.noise), sd.to(self.noise)).to_event(1))

    def transition(self, state, control, time, step):
        left, right = control.unbind(-1)
        mean = stack((left + right) / self.mass, torch.zeros_like(left), (right - left) / self.inertia)
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)

    def observe(self, state):
        pyro.sample("bearing", bearings_to(self.landmarks, state, sd=self.bearing_sd))

    def example_controls(self, time):
        """Thrusts through random way-points, the same manoeuvre as in the paper; the sides swap in 3 drives of 5."""
        at = tensor([0.0, 0.5, 2.0, 3.0, 5.0, 6.0, 9.0, 10.0, 12.0, 15.0], dtype=time.dtype)
        left = tensor([0.0, 1.0, 0.0, 0.7, 1.1, 0.0, 0.4, 0.0, 0.0, 0.0], dtype=time.dtype)
        right = tensor([0.0, 0.4, 0.0, 0.5, 0.5, 0.0, 1.0, 0.5, 0.0, 0.0], dtype=time.dtype)
        left_sd = 0.5 * tensor([0.0, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.0], dtype=time.dtype)
        right_sd = 0.5 * tensor([0.0, 0.1, 0.1, 0.1, 0.1, 0.1, 0.2, 0.2, 0.1, 0.0], dtype=time.dtype)
        drives = time.shape[1]
        left = left + left_sd * torch.randn(drives, len(at), dtype=time.dtype)
        right = right + right_sd * torch.randn(drives, len(at), dtype=time.dtype)
        swap = torch.rand(drives, 1) < 0.6
        sides = torch.stack([torch.where(swap, right, left), torch.where(swap, left, right)], -1)
        after = torch.searchsorted(at, time.contiguous(), right=True).clamp(1, len(at) - 1)
        share = ((time - at[after - 1]) / (at[after] - at[after - 1])).clamp(0, 1).unsqueeze(-1)
        drive = torch.arange(drives)
        return (1 - share) * sides[drive, after - 1] + share * sides[drive, after]


class HovercraftTruth(Hovercraft):
    """Drag and less noise, as in Hov (0.015, 0.03 and 0.07 over the mass of 1.5); drag acts as in the middle of a step.

    a_forward = (left + right − drag_forward · v|v|) / mass      v forward velocity
    a_lateral = −drag_lateral · w|w| / mass                      w lateral velocity
    a_yaw     = (right − left − drag_yaw · yaw_rate) / inertia
    """

    def __init__(self):
        super().__init__()
        self.drag = PyroParam(tensor([0.015, 0.03, 0.07]), constraints.positive)
        self.noise = PyroParam(tensor([0.08, 0.08, 0.05]), constraints.positive)

    def transition(self, state, control, time, step):
        left, right = control.unbind(-1)
        drag_forward, drag_lateral, drag_yaw = self.drag
        thrust = stack((left + right) / self.mass, torch.zeros_like(left), (right - left) / self.inertia)
        forward, lateral, yaw_rate = self.body_velocity(self.halfway(state, thrust, step))
        mean = stack(
            (left + right - drag_forward * forward * forward.abs()) / self.mass,
            -drag_lateral * lateral * lateral.abs() / self.mass,
            (right - left - drag_yaw * yaw_rate) / self.inertia,
        )
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)
