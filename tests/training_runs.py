"""Short trainings of a cart that begins far from its drives, and guides and judges that go by a script."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from examples import drives, example
from oracles import cart_evidence, cart_maximum

from steady_ppl import Optimization, SMCGuide, Trajectories, Validation, train

Cart = type(example("linear_gaussian"))
QUICK = Optimization(steps=6, validate_every=2, learning_rate=0.05)


class Wrong(Cart):
    """The cart with parameters far from those of its drives."""

    def __init__(self):
        super().__init__()
        self.gain, self.damping = torch.tensor(0.4), torch.tensor(2.4)


def slow_cart() -> tuple[Cart, Trajectories, float]:
    """A wrong cart in double precision, its drives, and the largest log p(y) that it can have of them."""

    class Slow(Wrong):
        step = 0.5
        rates = {"noise": 0.0, "measurement_sd": 0.0}

    program, truth = Slow().double(), Cart().double()
    truth.step = 0.5
    data = drives(truth, 6, 16, gaps=True)
    top = cart_maximum(Slow().double(), data)
    assert top - float(cart_evidence(program, data).detach()) > 100
    return program, data, top


@dataclass(frozen=True)
class Scripted(Validation):
    """Held-out log p(y) by heart; remembers the parameters that it was shown."""

    scores: tuple[tuple[float, ...], ...] = ()
    shown: list[dict[str, torch.Tensor]] = field(default_factory=list)

    def __call__(self, program, seed: int) -> list[float]:
        self.shown.append(values(program))
        return list(self.scores[len(self.shown) - 1])


class Stopping(SMCGuide):
    """Raises `error` at one E step, and remembers the live parameters at each."""

    def __init__(self, program, *, at: int | None = None, error: BaseException | None = None, **settings) -> None:
        super().__init__(program, particles=30, draws=5, **settings)
        self.at, self.error, self.seen = at, error, []

    def refresh(self, data, progress: float) -> dict[str, float]:
        if len(self.seen) == self.at:
            raise self.error
        self.seen.append(values(self.program))
        return super().refresh(data, progress)


def values(program) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in program.named_parameters()}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def run(program, data, optimization=QUICK, *, guide=None, validation=None, **settings):
    """A short training; every trajectory is held out as well."""
    guide = guide or SMCGuide(program, particles=30, draws=5)
    validation = validation or Validation(data, particles=50, every=2)
    return train(program, guide, data, validation, optimization, progress=False, **settings)
