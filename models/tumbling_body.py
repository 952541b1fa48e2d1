"""Nothing planar: a torque-free rigid body in space, seen by its gyroscope and by two known directions."""

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import Program, stack


class TumblingBody(Program):
    """Euler's equations about the principal axes, and the attitude as a unit quaternion from body to world.

    a_x = (b − 1) / a · ω_y ω_z,   a_y = (1 − a) / b · ω_z ω_x,   a_z = (a − b) · ω_x ω_y
    q' = q ⊗ exp(ω̄ · step / 2)                                  ω̄ is the rate in the middle of the step

    `inertia` is (a, b): the moments about x and y over that about z; free motion tells no more.
    The quaternion has four components and three degrees of freedom. `transition` and `observe` normalise it, so that
    its length acts on nothing and receives no noise; only a start may have another length than 1.
    Source: Markley and Crassidis, Fundamentals of Spacecraft Attitude Determination and Control, 2014, 3.2–3.3.
    """

    states = ("q_w", "q_x", "q_y", "q_z", "rate_x [rad/s]", "rate_y [rad/s]", "rate_z [rad/s]")
    channels = ("x [rad/s²]", "y [rad/s²]", "z [rad/s²]")
    motion = {axis: ("", f"rate_{axis}") for axis in "xyz"}
    measurements = (
        *(f"gyro_{axis} [rad/s]" for axis in "xyz"),
        *(f"{seen}_{axis}" for seen in ("sun", "field") for axis in "xyz"),
    )
    error_groups = {"attitude": states[:4], "rate": ("rate_x", "rate_y", "rate_z")}
    guesses = ("noise",)
    substeps = 2
    directions = {"sun": (1.0, 0.0, 0.0), "field": (0.0, 0.6, 0.8)}  # of length 1, world frame

    def __init__(self):
        super().__init__()
        self.inertia = PyroParam(tensor([0.6, 0.8]), constraints.positive)
        self.noise = PyroParam(tensor([0.02, 0.02, 0.02]), constraints.positive)  # rad/s²

    def initial(self):
        mean, sd = tensor([1.0, 0, 0, 0, 0, 0, 0]), tensor([0.1, 0.3, 0.3, 0.3, 1.0, 1.0, 1.0])
        return pyro.sample("start", dist.Normal(mean.to(self.noise), sd.to(self.noise)).to_event(1))

    def transition(self, state, control, time, step):
        rates, step = state[..., 4:], step.unsqueeze(-1)
        mean = self.response(rates + 0.5 * step * self.response(rates))
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        faster = rates + step * acceleration
        return torch.cat([turned(unit(state), 0.5 * step * (rates + faster)), faster], -1)

    def response(self, rates):
        """Angular accelerations about the body's axes, `(..., 3)` rad/s²."""
        x, y, z = rates.unbind(-1)
        a, b = self.inertia.unbind(-1)
        return stack((b - 1) / a * y * z, (1 - a) / b * z * x, (a - b) * x * y)

    def observe(self, state):
        pyro.sample("gyro", dist.Normal(state[..., 4:], 0.02).to_event(1))
        w, *axis = unit(state).unbind(-1)
        for name, direction in self.directions.items():
            across = cross(axis, direction)
            parts = zip(direction, across, cross(axis, across), strict=True)
            seen = stack(*(one - 2 * w * two + 2 * three for one, two, three in parts))
            pyro.sample(name, dist.Normal(seen, 0.05).to_event(1))


def cross(one, two):
    """The cross product of two vectors, three components each."""
    (a, b, c), (x, y, z) = one, two
    return b * z - c * y, c * x - a * z, a * y - b * x


def unit(state):
    """The attitude's quaternion at length 1, `(..., 4)`."""
    return state[..., :4] / state[..., :4].norm(dim=-1, keepdim=True)


def turned(quaternion, rotation):
    """A quaternion turned by a rotation vector in the body frame, `(..., 4)`."""
    w, x, y, z = quaternion.unbind(-1)
    angle = (rotation.square().sum(-1) + 1e-12).sqrt()  # which has a slope at rest
    s, (a, b, c) = (0.5 * angle).cos(), ((0.5 * angle).sin() / angle * part for part in rotation.unbind(-1))
    return stack(
        w * s - x * a - y * b - z * c,
        w * a + x * s + y * c - z * b,
        w * b - x * c + y * s + z * a,
        w * c + x * b - y * a + z * s,
    )
