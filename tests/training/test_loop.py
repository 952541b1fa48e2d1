"""The training loop: independent and reproducible fits, early stopping, and learning itself."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pyro
import pytest
import torch
from examples import drives, example
from oracles import cart_evidence
from pyro.nn import pyro_method
from torch import nn
from training_runs import Cart, Scripted, Stopping, Wrong, run, same, slow_cart, values

from steady_ppl import (
    Constant,
    Optimization,
    SMCGuide,
    TrainingError,
    TruthGuide,
    Validation,
    particle_filter,
    seeded,
    stack,
    train,
)

# --- fits of their own, the same run from the same seed ---------------------------------------------------------------


def test_a_second_fit_in_one_process_repeats_the_first_bit_for_bit(data):
    first, second = Wrong(), Wrong()
    a = run(first, data, seed=3)
    assert same(values(second), values(Wrong()))  # untouched by the fit of its sister
    b = run(second, data, seed=3)
    assert a == b
    assert same(values(first), values(second))
    assert not same(values(first), values(Wrong()))


def test_another_seed_gives_another_run(data):
    programs = [Wrong(), Wrong()]
    histories = [run(program, data, seed=seed).history for seed, program in enumerate(programs)]
    assert histories[0] != histories[1]
    assert not same(*(values(program) for program in programs))


def test_the_callers_random_numbers_neither_change_the_run_nor_are_changed(data):
    programs, states = [Wrong(), Wrong()], []
    for seed, program in enumerate(programs):
        torch.manual_seed(seed)
        states.append(torch.get_rng_state())
        run(program, data)
        states.append(torch.get_rng_state())
    assert torch.equal(states[0], states[1]) and torch.equal(states[2], states[3])
    assert same(*(values(program) for program in programs))


def test_a_second_network_trains_and_repeats_the_first():
    source = "neural_vehicle:NeuralHovercraft"
    hovercraft = example("hovercraft", torch.float32)
    bearings = drives(hovercraft, 2, 11)
    network = type(example(source))
    fits = []
    for _ in range(2):
        with seeded("weights"):
            program = network()
        before = values(program)
        run(program, bearings, Optimization(steps=3, validate_every=3))
        fits.append(values(program))
        assert all(not torch.equal(before[name], fits[-1][name]) for name in before)
    assert same(*fits)


def test_training_leaves_pyros_global_parameter_store_alone(data):
    before = set(pyro.get_param_store().keys())
    run(Wrong(), data)
    assert set(pyro.get_param_store().keys()) == before


class Decorated(Wrong):
    """Written in Pyro's habit; its parameters live in the global store unless told otherwise."""

    @pyro_method
    def transition(self, state, control, time, step):
        return super().transition(state, control, time, step)


def test_fits_of_pyro_methods_are_independent_as_well(data):
    with pyro.get_param_store().scope() as scope:
        first, second = Decorated(), Decorated()
        a, b = (run(program, data) for program in (first, second))
        assert not scope["params"]
    assert a == b and same(values(first), values(second))
    assert not same(values(first), values(Wrong()))


def test_a_program_of_pyro_methods_keeps_its_own_values_outside_of_training(data):
    with pyro.get_param_store().scope():
        first, second = Decorated(), Decorated()
        first.gain = torch.tensor(5.0)
        second.gain = torch.tensor(0.1)
        for program in (first, second):
            particle_filter(program, data, particles=10)
        assert first.gain.item() == pytest.approx(5.0)
        assert second.gain.item() == pytest.approx(0.1)


# --- interrupted ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("at", [0, 1, 5])
def test_an_interrupted_run_leaves_usable_parameters_and_says_so(data, at):
    program, script = Wrong(), Scripted(data, scores=((1.0,), (2.0,), (3.0,)))
    trained = run(program, data, guide=Stopping(program, at=at, error=KeyboardInterrupt()), validation=script)
    assert trained.interrupted
    assert [entry["step"] for entry in trained.history] == [2, 4][: at // 2]
    if at == 0:
        assert same(values(program), values(Wrong()))
    elif at == 5:
        assert same(values(program), script.shown[-1]) and trained.kept == 4
    assert particle_filter(program, data, particles=10).log_likelihood.isfinite().all()


def test_an_interrupt_during_validation_restores_the_parameters(data):
    class Interrupting(Scripted):
        def __call__(self, program, seed):
            held_out = super().__call__(program, seed)
            if len(self.shown) == 2:
                raise KeyboardInterrupt
            return held_out

    program, script = Wrong(), Interrupting(data, scores=((1.0,), (2.0,)))
    trained = run(program, data, validation=script)
    assert trained.interrupted and trained.kept == 2
    assert same(values(program), script.shown[0])


# --- which parameters are kept ----------------------------------------------------------------------------------------


def test_the_best_validated_parameters_are_kept(data):
    program, script = Wrong(), Scripted(data, scores=((1.0, 1.0), (3.0, 3.0), (2.0, 2.0)))
    trained = run(program, data, validation=script)
    assert trained.kept == 4 and not trained.interrupted
    assert [entry["log_likelihood"] for entry in trained.history] == [1.0, 3.0, 2.0]
    assert same(values(program), script.shown[1])
    assert not same(script.shown[1], script.shown[2])


def test_of_parameters_within_one_standard_error_of_the_best_the_latest_are_kept(data):
    # paired differences from the best: mean .5 and standard error .5, then mean 1 and standard error .58
    scores = ((10.0, 10.0, 10.0, 10.0), (10.0, 8.0, 10.0, 10.0), (8.0, 10.0, 8.0, 10.0))
    program, script = Wrong(), Scripted(data, scores=scores)
    assert run(program, data, validation=script).kept == 4
    assert same(values(program), script.shown[1])


def test_training_stops_when_its_patience_is_at_an_end(data):
    program, script = Wrong(), Scripted(data, scores=((1.0,), (2.0,), (0.0,), (1.0,), (9.0,)))
    trained = run(program, data, Optimization(steps=10, validate_every=2, patience=2), validation=script)
    assert [entry["step"] for entry in trained.history] == [2, 4, 6, 8]
    assert trained.kept == 4 and same(values(program), script.shown[1])


def test_the_last_step_is_validated_whatever_the_stride(data):
    script = Scripted(data, scores=((1.0,), (2.0,)))
    trained = run(Wrong(), data, Optimization(steps=5, validate_every=3), validation=script)
    assert [entry["step"] for entry in trained.history] == [3, 5] and trained.kept == 5


def test_without_validation_the_last_averaged_parameters_are_kept(data):
    def fit(steps: int):
        program = Wrong()
        guide = Stopping(program, tempering=Constant())
        optimization = Optimization(steps=steps, final_rate=1.0, averaging=0.3, learning_rate=0.05, validate_every=2)
        return run(program, data, optimization, guide=guide, validation=Validation()), values(program), guide.seen

    trained, kept, _ = fit(6)
    _, _, live = fit(7)  # a constant rate: its first six steps are the same, and it shows where they led
    average = live[0]
    for step, present in enumerate(live[1:], start=1):
        weight = min(0.3, (step - 1) / (step + 9))
        average = {name: weight * average[name] + (1 - weight) * present[name] for name in present}
    torch.testing.assert_close(kept, average)
    assert trained.kept == 6 and all("log_likelihood" not in entry for entry in trained.history)


def test_validation_sees_the_average_and_training_goes_on_from_the_live_parameters(data):
    optimization = Optimization(steps=6, validate_every=2, averaging=0.9, learning_rate=0.05)
    guides = []
    for validation in (Scripted(data, scores=((1.0,), (2.0,), (3.0,))), Validation()):
        program = Wrong()
        guides.append(Stopping(program))
        run(program, data, optimization, guide=guides[-1], validation=validation)
    assert all(same(a, b) for a, b in zip(guides[0].seen, guides[1].seen, strict=True))


def test_every_validation_uses_the_same_random_numbers(data):
    optimization = Optimization(steps=4, validate_every=1, learning_rate=0.0)
    history = run(Wrong(), data, optimization).history
    assert len({entry["log_likelihood"] for entry in history}) == 1
    assert len({entry["loss"] for entry in history}) == 4


# --- the optimiser ----------------------------------------------------------------------------------------------------


def test_relative_rates_go_by_the_beginning_of_a_parameters_name(data):
    class Rated(Wrong):
        rates = {"gain": 3.0, "noise": 0.0}

    program = Rated()
    before = values(program)
    run(program, data, Optimization(steps=1, learning_rate=0.01), validation=Validation())
    # Adam's first step is the rate itself
    moved = {name: float((value - before[name]).abs()) for name, value in values(program).items()}
    expected = {"gain": 0.03, "damping": 0.01, "noise": 0.0, "measurement_sd": 0.01}
    assert moved == pytest.approx({f"{n}_unconstrained": v for n, v in expected.items()}, rel=1e-3, abs=1e-9)


def test_relative_decays_go_by_the_beginning_of_a_parameters_name_and_spare_vectors(data):
    class Decayed(Wrong):
        decays = {"hidden": 10.0, "skip": 0.1}

        def __init__(self):
            super().__init__()
            for name in ("hidden", "skip", "other"):
                setattr(self, name, nn.Linear(2, 1))

        def transition(self, state, control, time, step):
            nothing = sum(layer(state).squeeze(-1) for layer in (self.hidden, self.skip, self.other))
            return super().transition(state + 0 * nothing[..., None], control, time, step)

    program = Decayed()
    before = values(program)
    run(program, data, Optimization(steps=1, learning_rate=0.01, weight_decay=2.0), validation=Validation())
    after = values(program)
    for name, factor in {"hidden": 10.0, "skip": 0.1, "other": 1.0}.items():
        shrunk = before[f"{name}.weight"] * (1 - 0.01 * 2.0 * factor)
        torch.testing.assert_close(after[f"{name}.weight"], shrunk)
        assert torch.equal(after[f"{name}.bias"], before[f"{name}.bias"])


def test_the_rate_falls_along_half_a_cosine(data):
    steps, rate, final = 8, 0.01, 0.2
    program = Wrong()
    guide = Stopping(program)
    optimization = Optimization(
        steps=steps, learning_rate=rate, final_rate=final, betas=(0.0, 0.0), validate_every=steps
    )
    run(program, data, optimization, guide=guide, validation=Validation())
    # with betas of zero every step is the rate, whatever the gradient
    lengths = [float((b["gain_unconstrained"] - a["gain_unconstrained"]).abs()) for a, b in pairwise(guide.seen)]
    cosine = [final + (1 - final) * (1 + math.cos(math.pi * k / steps)) / 2 for k in range(steps - 1)]
    assert lengths == pytest.approx([rate * share for share in cosine], rel=1e-3)


def test_a_batch_holds_so_many_trajectories(data):
    sizes = []

    class Counting(SMCGuide):
        def refresh(self, data, progress):
            sizes.append(data.labels)
            return super().refresh(data, progress)

    program = Wrong()
    optimization = Optimization(steps=8, batch=3, validate_every=8)
    run(program, data, optimization, guide=Counting(program, particles=20, draws=2), validation=Validation())
    assert all(len(set(labels)) == 3 for labels in sizes)
    assert {label for labels in sizes for label in labels} == set(data.labels)


@pytest.mark.filterwarnings("ignore:Encountered NaN")
def test_a_loss_that_is_not_finite_is_an_error_and_names_the_step(data):
    program = Cart()
    with torch.no_grad():
        program.gain_unconstrained.fill_(math.nan)
    with pytest.raises(TrainingError, match="the loss is nan at step 1"):
        run(program, data, guide=TruthGuide(program), validation=Validation())


@pytest.mark.filterwarnings("ignore:Encountered NaN")
@pytest.mark.parametrize("steps", [1, 5])
def test_a_gradient_that_is_not_finite_is_an_error(data, steps):
    class Steep(Cart):
        def transition(self, state, control, time, step):
            nothing = (self.gain - self.gain).sqrt()  # 0, but its slope is not finite
            return super().transition(state, control + nothing, time, step)

    program = Steep()
    with pytest.raises(TrainingError):
        run(program, data, Optimization(steps=steps), guide=TruthGuide(program), validation=Validation())


@pytest.mark.filterwarnings("ignore:Encountered NaN")
def test_padding_that_blows_up_does_not_spoil_the_parameters():
    class Toppling(Cart):
        """Unstable beyond 5 m: a trajectory that ended there goes on to infinity in its padding."""

        def transition(self, state, control, time, step):
            position, velocity = state.unbind(-1)
            mean = torch.where(position > 5, 40 * self.gain * velocity, -self.damping * velocity)
            acceleration = pyro.sample("acceleration", pyro.distributions.Normal(mean, self.noise))
            return stack(position + velocity * step, velocity + acceleration * step)

    data = drives(Cart(), 2, 61)
    lengths = torch.tensor([3, 61])
    inside = (torch.arange(61)[:, None] < lengths)[..., None]
    states = torch.where(inside, data.states, math.nan)
    states[0] = torch.tensor([[10.0, 1.0], [0.0, 0.0]])
    measurements = torch.where(inside, data.measurements + states[0, :, :1], 0.0)
    data = replace(data, lengths=lengths, observed=data.observed & inside, measurements=measurements, states=states)
    program = Toppling()
    guide = SMCGuide(program, particles=20, draws=5, known_start=True)
    run(program, data, Optimization(steps=2), guide=guide, validation=Validation(), known_start=True)
    last = particle_filter(program, data, particles=20, known_start=True).states[-1]
    assert not last[:, 0].isfinite().any() and guide.paths.states.isfinite().all()
    assert all(value.isfinite() for value in program.parameters())


# --- learning ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_steady_learns_the_maximum_likelihood_estimate_of_the_cart():
    program, data, top = slow_cart()
    guide = SMCGuide(program, particles=200, draws=20, tempering=Constant())
    optimization = Optimization(steps=100, learning_rate=0.2, validate_every=100)
    train(program, guide, data, Validation(), optimization, progress=False)
    # d standard errors off the estimate cost d² / 2 nats: half of one
    assert top - float(cart_evidence(program, data).detach()) < 0.125


def test_gradients_are_scaled_down_to_their_norm(data, monkeypatch):
    """Each array's by itself, before the optimiser sees it."""
    norms, step = [], torch.optim.AdamW.step

    def spy(self, *arguments):
        norms.append([float(p.grad.norm()) for group in self.param_groups for p in group["params"]])
        return step(self, *arguments)

    monkeypatch.setattr(torch.optim.AdamW, "step", spy)
    for bound in (None, 0.01):
        run(example("linear_gaussian"), data, Optimization(steps=2, validate_every=2, gradient_norm=bound))
    assert max(norms[0]) > 0.02 and all(value <= 0.01 * (1 + 1e-5) for one in norms[2:] for value in one)
