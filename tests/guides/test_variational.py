"""Guides with parameters: the ELBO is a bound on log p(y), exact where the guide can be; the model is the same."""

from __future__ import annotations

import math
from dataclasses import replace

import pyro
import pytest
import torch
from examples import cut, drives, example
from oracles import all_at_once, assert_mean, cart_parameters, kalman
from pyro import poutine
from pyro.infer import Trace_ELBO
from pyro.infer.autoguide import AutoLowRankMultivariateNormal, AutoNormal
from torch import Tensor

from steady_ppl import (
    AutoRollout,
    Constant,
    GaussianGuide,
    InferenceNetwork,
    Joint,
    LinearRamp,
    Optimization,
    SMCGuide,
    SmootherGuide,
    UsageError,
    Validation,
    VariationalGuide,
    for_program,
    seeded,
    simulate,
    train,
)

GUIDES = {
    "network": InferenceNetwork,
    "network, not centred": lambda *a, **k: InferenceNetwork(*a, centred=False, **k),
    "mean-field": AutoRollout,
    "low rank": lambda *a, **k: AutoRollout(*a, auto=AutoLowRankMultivariateNormal, **k),
    "smoother": SmootherGuide,
}


def elbos(program, guide, data, times: int, *, known_start: bool = False) -> Tensor:
    """Draws of Pyro's ELBO as the loop computes it, `(times,)`, with their gradients."""
    guide.refresh(data, 1.0)
    elbo = Trace_ELBO(num_particles=guide.draws, vectorize_particles=guide.draws > 1, max_plate_nesting=2)
    joint = Joint(program, known_start=known_start)
    with pyro.settings.context(module_local_params=True):
        return torch.stack([-elbo.differentiable_loss(joint, guide, data) for _ in range(times)])


@pytest.mark.parametrize("known_start", [False, True])
@pytest.mark.parametrize("draws", [1, 3])
def test_the_smoother_is_exact_on_a_linear_program(cart, uneven, draws: int, known_start: bool) -> None:
    """Every draw of its ELBO is log p(y) itself: gaps, unequal lengths and steps included."""
    guide = SmootherGuide(cart, uneven, draws=draws, known_start=known_start)
    exact = kalman(uneven, cart_parameters(cart), known_start=known_start).log_likelihood.sum()
    found = elbos(cart, guide, uneven, 5, known_start=known_start)
    torch.testing.assert_close(found, exact.expand(5), rtol=1e-9, atol=1e-8)


@pytest.mark.slow
def test_the_gradient_at_the_exact_posterior_is_that_of_log_p_of_y(uneven) -> None:
    """Fisher's identity, by paths that move with the parameters."""
    program = example("linear_gaussian")
    guide = SmootherGuide(program, uneven)
    exact = kalman(uneven, cart_parameters(program)).log_likelihood.sum()
    parameters = list(program.parameters())
    expected = torch.autograd.grad(exact, parameters)
    draws = [
        torch.autograd.grad(value, parameters) for value in (elbos(program, guide, uneven, 1)[0] for _ in range(200))
    ]
    for index, gradient in enumerate(expected):
        assert_mean(torch.stack([draw[index] for draw in draws]), gradient)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(GUIDES))
@pytest.mark.parametrize("draws", [1, 2])
def test_every_elbo_is_a_bound(cart, uneven, name: str, draws: int) -> None:
    guide = GUIDES[name](cart, uneven, draws=draws)
    values = elbos(cart, guide, uneven, 200).detach()
    exact = kalman(uneven, cart_parameters(cart)).log_likelihood.sum()
    assert values.mean() - 4 * values.std() / math.sqrt(len(values)) <= exact + 1e-6


def pushed(cart, rows: int):
    """Drives whose control and step differ from interval to interval: who does not read them is far from log p(y)."""
    table = drives(cart, 3, rows, gaps=True)
    with seeded("pushes"):
        table = replace(table, controls=torch.where(table.rows[..., None], 8 * torch.randn(table.controls.shape), 0.0))
    return for_program(cart, simulate(cart, seed=3, like=table))


LONG, LONGER = pytest.mark.slow, pytest.mark.exhaustive
NEAR = [
    pytest.param(12, "network", 0.5, marks=LONGER),
    pytest.param(12, "network, not centred", 0.1, marks=LONG),
    pytest.param(12, "mean-field", 1.5, marks=LONGER),
    pytest.param(101, "network", 8.0, marks=LONGER),
    pytest.param(101, "network, not centred", 16.0, marks=LONGER),
    pytest.param(101, "mean-field", 50.0, marks=LONGER),
]


@pytest.mark.slow
@pytest.mark.parametrize(("rows", "name", "gap"), NEAR)
def test_training_brings_the_bound_near(rows: int, name: str, gap: float) -> None:
    """Nats a drive, some twice what was seen; independent normals cannot say that accelerations make up for each
    other."""
    cart = example("linear_gaussian")
    data = pushed(cart, rows)
    guide = GUIDES[name](cart, data, draws=1 if name == "mean-field" else 8)
    optimization = Optimization(steps=500, learning_rate=2e-2, gradient_norm=10.0, validate_every=500)
    train(cart, guide, data, Validation(), optimization, progress=False)
    exact = kalman(data, cart_parameters(cart)).log_likelihood.sum()
    values = elbos(cart, guide, data, 300).detach()
    error = 4 * values.std() / math.sqrt(len(values))
    assert exact - gap * len(data) - error < values.mean() < exact + error


@pytest.mark.slow
@pytest.mark.parametrize("known_start", [False, True])
@pytest.mark.parametrize("name", list(GUIDES))
def test_the_kl_weight_is_that_of_the_kl_divergence(cart, uneven, name: str, known_start: bool) -> None:
    """At weight w the objective is log p(y | states) − w KL of the same draws: at 0 what the measurements say, and
    linear in w."""
    guide = GUIDES[name](cart, uneven, known_start=known_start)
    joint, found = Joint(cart, known_start=known_start), []
    for weight in (0.0, 0.5, 1.0, 20.0):
        guide.annealing = Constant(weight)
        with seeded("the same draws"):
            found.append(float(elbos(cart, guide, uneven, 1, known_start=known_start).detach()))
    with seeded("the same draws"), pyro.settings.context(module_local_params=True):
        guided = poutine.trace(guide).get_trace(uneven)
        model = poutine.trace(poutine.replay(joint, guided)).get_trace(uneven)
        model.compute_log_prob()
    seen = sum(float(site["log_prob"].detach().sum()) for site in model.nodes.values() if site.get("is_observed"))
    assert found[0] == pytest.approx(seen, rel=1e-9)
    divergence = found[0] - found[2]
    assert found[1] == pytest.approx(seen - 0.5 * divergence, rel=1e-9)
    assert found[3] == pytest.approx(seen - 20 * divergence, rel=1e-9)


def test_the_kl_weight_follows_its_schedule(cart, even) -> None:
    guide = AutoRollout(cart, even)
    assert guide.refresh(even, 0.5) == {}
    guide.annealing = LinearRamp(0.1, 0.5)
    assert guide.refresh(even, 0.25) == {"kl_weight": pytest.approx(0.55)}


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["network", *(pytest.param(name, marks=LONG) for name in GUIDES if name != "network")])
def test_past_a_drives_end_there_is_no_divergence(cart, even, name: str) -> None:
    """A longer drive beside a short one changes nothing in what the short one adds."""
    long, short = even.subset([0]), cut(even.subset([1]), 4)
    together = replace(
        even.subset([0, 1]),
        lengths=torch.tensor([12, 4]),
        observed=even.subset([0, 1]).observed & (torch.arange(12)[:, None] < torch.tensor([12, 4]))[..., None],
    )
    means = []
    for data in (long, short, together):
        with seeded("guide"):
            guide = GUIDES[name](cart, data, draws=1)
        with seeded("draws"):
            means.append(elbos(cart, guide, data, 400).detach())
    apart = means[0].mean() + means[1].mean() - means[2].mean()
    error = math.sqrt(sum(float(one.var()) / len(one) for one in means))
    assert abs(float(apart)) < 4 * error + 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("known_start", [False, True])
@pytest.mark.parametrize("name", ["hovercraft", "truck", "pendulum", "neural_vehicle:NeuralHovercraft"])
def test_the_guide_changes_nothing_in_the_model(name: str, known_start: bool) -> None:
    """STEADY's and SVI's guides sample the same sites, and the joint density at an SVI guide's paths is that which the
    same paths have as STEADY's."""
    program = example(name)
    data = drives(program, 2, 6, gaps=True)
    start = {"known_start": known_start}
    joint, sites = Joint(program, **start), []
    guides = [SMCGuide(program, particles=50, draws=1, **start), GaussianGuide(program, draws=1, **start)]
    guides += [make(program, data, **start) for make in GUIDES.values()]
    with pyro.settings.context(module_local_params=True):
        for guide in guides:
            guide.refresh(data, 1.0)
            if isinstance(guide, VariationalGuide):
                rolled = guide.roll_out(data)
                guide.roll_out = lambda data, rolled=rolled: rolled
            guided = poutine.trace(guide).get_trace(data)
            model = poutine.trace(poutine.replay(joint, guided)).get_trace(data)
            sites.append([name for name, site in model.nodes.items() if site["type"] == "sample"])
            paths = rolled[0] if isinstance(guide, VariationalGuide) else guide.paths
            density = all_at_once(program, data, paths, **start)
            torch.testing.assert_close(model.log_prob_sum(), density, rtol=1e-9, atol=1e-9)
    assert all(names == sites[0] for names in sites)


def test_the_network_reads_nothing_that_is_missing_and_nothing_past_the_end(cart, uneven) -> None:
    guide = InferenceNetwork(cart, uneven)
    with torch.no_grad():
        for value in guide.parameters():
            value.normal_(0, 0.3)
    lies = replace(uneven, measurements=torch.where(uneven.observed, uneven.measurements, 9.0))
    longer = replace(
        uneven,
        controls=torch.where(uneven.rows[..., None], uneven.controls, 5.0),
        time=torch.where(uneven.rows, uneven.time, uneven.time + 1.0),
    )
    guide.begin(uneven)
    codes, shift = guide.code, guide.shift
    for data in (lies, longer):
        guide.begin(data)
        torch.testing.assert_close(guide.shift[uneven.transitions], shift[uneven.transitions])
        torch.testing.assert_close(guide.code, codes)
    guide.begin(cut(uneven.subset([1]), 10))
    torch.testing.assert_close(guide.code[0], codes[1])
    torch.testing.assert_close(guide.shift[:, 0], shift[:9, 1])


def test_a_guide_of_given_drives_takes_some_of_them_if_it_can_and_no_others(cart, uneven) -> None:
    few = uneven.subset([2, 0])
    exact = kalman(few, cart_parameters(cart)).log_likelihood.sum()
    assert float(elbos(cart, SmootherGuide(cart, uneven), few, 1).detach()) == pytest.approx(float(exact))
    with pytest.raises(UsageError, match="takes no others and no batch"):
        elbos(cart, AutoRollout(cart, uneven), few, 1)
    with pytest.raises(UsageError, match="not for 2"):
        elbos(cart, SmootherGuide(cart, few), uneven, 1)


def test_a_guides_parameters_are_its_own(cart, even) -> None:
    for make in GUIDES.values():
        guide = make(cart, even)
        own = {id(value) for value in guide.parameters()}
        assert own and not own & {id(value) for value in cart.parameters()}


def test_the_mean_field_guide_is_pyros(cart, even) -> None:
    guide = AutoRollout(cart, even, auto=AutoNormal, options={"init_scale": 0.3})
    assert isinstance(guide.auto, AutoNormal)
    scales = [value for name, value in guide.named_parameters() if "scales" in name]
    assert all(bool((value.exp() > 0.29).all()) for value in scales) and len(scales) == 2
