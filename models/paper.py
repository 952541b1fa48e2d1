"""The models of STEADY's tables (IROS 2022) with its authors' explicit Euler step: for comparison, not for use.

No vehicle moves so: at 10 Hz this step has errors that look like physical effects.
"""

import pyro
import pyro.distributions as dist

from steady_ppl import ExplicitEuler, stack

from .hovercraft import Hovercraft, HovercraftTruth
from .neural_vehicle import NeuralHovercraft, NeuralTruck
from .truck import Truck


class PaperHovercraft(ExplicitEuler, Hovercraft):
    """The owner's model of Hov: no drag."""


class PaperHovercraftTruth(ExplicitEuler, HovercraftTruth):
    """What simulates Hov."""


class PaperNeuralHovercraft(ExplicitEuler, NeuralHovercraft):
    """A network in the place of the hovercraft's dynamics."""


class PaperNeuralTruck(ExplicitEuler, NeuralTruck):
    """A network in the place of the AlphaTruck's dynamics."""


class PaperTruck(ExplicitEuler, Truck):
    """The AlphaTruck by hand: it reaches its command within one step if the limit allows, and never slips.

    a_forward = clip((speed_gain · speed − v) / step, ±limit)      v forward velocity
    a_lateral = −w / step                                          w lateral velocity
    a_yaw     = clip((turn_gain · turn − yaw_rate) / step, ±limit)
    """

    settling = None

    def transition(self, state, control, time, step):
        speed, turn = control.unbind(-1)
        forward, lateral, yaw_rate = self.body_velocity(state)
        mean = stack(
            ((self.speed_gain * speed - forward) / step).clamp(-self.limit, self.limit),
            -lateral / step,
            ((self.turn_gain * turn - yaw_rate) / step).clamp(-self.limit, self.limit),
        )
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)
