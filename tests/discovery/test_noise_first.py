"""Noise that a program declares and the drives contradict."""

from __future__ import annotations

from types import SimpleNamespace

import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import example
from pyro.distributions import constraints
from pyro.nn import PyroParam

import steady_ppl as st
from steady_ppl.discovery.candidates import Screening
from steady_ppl.discovery.noise_first import needless, with_same_noise, with_suitable_noise, without, without_outliers
from steady_ppl.discovery.refits import first_refit, refit_with
from steady_ppl.effects import attached, chosen_variant
from steady_ppl.likelihood.parameters import elements
from steady_ppl.model.problem import Problem
from steady_ppl.model.substeps import with_substeps

SD = 0.05


class Cart(st.Program):
    """A mass on a rail, its position and, in another unit, its speed measured."""

    states = ("position [m]", "velocity [m/s]")
    controls = ("force [N]",)
    measurements = ("position_0 [m]", "position_1 [m]", "speed [m/s]")
    channels = ("forward [m/s²]",)
    motion = {"forward": ("position", "velocity")}
    duration = 6.0
    declared = SD

    def __init__(self):
        super().__init__()
        self.mass = PyroParam(torch.tensor(2.0), constraints.positive)
        self.noise = PyroParam(torch.tensor(0.1), constraints.positive)

    def initial(self):
        return pyro.sample("start", dist.Normal(torch.zeros(2), 0.1).to_event(1))

    def transition(self, state, control, time, step):
        position, velocity = state.unbind(-1)
        acceleration = pyro.sample("forward", dist.Normal(control[..., 0] / self.mass, self.noise))
        faster = velocity + acceleration * step
        return st.stack(position + 0.5 * (velocity + faster) * step, faster)

    def example_controls(self, time):
        return torch.randn(*time.shape, 1, dtype=time.dtype).cumsum(0)

    def observe(self, state):
        pyro.sample("position", dist.Normal(state[..., [0, 0]], self.declared).to_event(1))
        pyro.sample("speed", dist.Normal(state[..., 1], 0.1))


class TooWide(Cart):
    declared = 2.5 * SD


class TooNarrow(Cart):
    declared = SD / 2.5


def begun(program, truth=None):
    truth = truth or Cart()
    train, valid = (st.for_program(program, st.simulate(truth, 8, seed=seed)) for seed in (1, 2))
    return first_refit(Problem(program, train, False), valid, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize(("program", "factor"), [(TooWide, 0.4), (TooNarrow, 2.5)])
def test_a_sensor_that_is_declared_wrong_is_corrected_and_no_other(program, factor):
    own = begun(program())
    base, (correction,) = with_suitable_noise(own, lambda variant: True)
    assert correction.variant.name == "measurement_noise:position" and correction.gain > 100
    assert float(base.coefficient(correction.variant)) == pytest.approx(factor, rel=0.1)
    assert [variant.name for variant in attached(base.program)] == ["measurement_noise:position"]
    assert with_suitable_noise(base, lambda variant: True) == (base, [])
    fold, finer = own.folds[0], Problem(with_substeps(program(), 2), own.folds[0].drives, False)
    same = with_same_noise(first_refit(finer, fold.held_out, seed=0), base, [correction])
    assert same.corrections == [correction] and same.base.program.substeps == 2
    assert float(same.base.coefficient(correction.variant)) == pytest.approx(factor, rel=0.1)
    assert [variant.name for variant in attached(same.base.program)] == ["measurement_noise:position"]


@pytest.mark.slow
def test_what_is_right_stays_as_it_is():
    own = begun(Cart())
    assert with_suitable_noise(own, lambda variant: True) == (own, [])


def test_what_is_withheld_stays_as_it_is():
    own = begun(TooWide())
    assert with_suitable_noise(own, lambda variant: variant.effect.name != "measurement_noise") == (own, [])


@pytest.mark.slow
def test_readings_with_heavy_tails_are_kept_and_the_noise_has_these_tails():
    cart = Cart()
    drives = [st.for_program(cart, st.simulate(cart.with_effect("heavy_tails", 0.45), 8, seed=seed)) for seed in (1, 2)]

    def fit(train, valid):
        return first_refit(Problem(Cart(), train, False), valid, seed=0)

    cleaned = without_outliers(fit, *drives, lambda variant: True)
    assert cleaned.outliers[0].note and not any(one.cells for one in cleaned.outliers)
    (tails,) = cleaned.suited.corrections
    assert tails.variant == cleaned.suited.tails and tails.variant.name == "heavy_tails" and tails.gain > 100
    assert 0.2 < float(cleaned.suited.base.coefficient(tails.variant)) < 0.49
    assert [attached(one.program) for one in (cleaned.refit, cleaned.whole)] == [(), ()]
    screening = type("Screening", (), {"spread_of": lambda self, fitted, one: torch.tensor([0.02])})()
    assert needless([tails], cleaned.suited.base, screening) == []


@pytest.mark.slow
def test_what_was_an_effect_all_along_is_no_noise():
    own = begun(Cart(), Cart().with_effect("sensor_bias:position_0", 0.3))
    base, (correction,) = with_suitable_noise(own, lambda variant: True)
    variant = chosen_variant(own.program, "sensor_bias:position_0")
    both = refit_with(base, variant, 0.0)
    screening = type("Screening", (), {"spread_of": lambda self, fitted, one: torch.tensor([0.05])})()
    assert needless([correction], both, screening) == [correction] and needless([correction], base, screening) == []
    alone = without([correction], own, both)
    assert [one.name for one in attached(alone.program)] == [variant.name]
    assert float(alone.coefficient(variant)) == pytest.approx(0.3, abs=0.05)
    assert without([correction], own, base) is None


@pytest.mark.parametrize(("told", "sd"), [(0.0, 1.0), (100.0, 0.0705)])
def test_a_factor_of_which_the_drives_tell_nothing_is_as_uncertain_as_its_prior(told, sd):
    """Half of the drives have an information of 100 on its logarithm, so that all have 200."""
    program = example("hovercraft").with_effect("measurement_noise", 0.05)
    parts = elements(program)
    (variant,) = attached(program)
    own = [told if part.owner == variant.parameter else 1.0 for part in parts]
    information = torch.diag(torch.tensor(own, dtype=torch.float64))
    fitted = SimpleNamespace(program=program, first_share=0.5)
    (spread,) = Screening(None, parts, {"": information}).spread_of(fitted, variant).tolist()
    assert spread == pytest.approx(sd, rel=0.01)
    assert float(information.diagonal().sum()) == pytest.approx(told + len(parts) - 1)
