"""Guides that linearise from one E step to the next: what they remember, learn and resume."""

from __future__ import annotations

import math

import pytest
import torch
from examples import drives, example
from oracles import cart_evidence
from training_runs import Cart, Wrong, same, slow_cart, values

from steady_ppl import (
    Constant,
    FilterError,
    GaussianGuide,
    LookaheadGuide,
    Optimization,
    UsageError,
    Validation,
    train,
)
from steady_ppl.gaussian.smoother import find_and_smooth, find_path, smooth
from steady_ppl.guides.linearized import LinearizedGuide
from steady_ppl.model.problem import Problem
from steady_ppl.utils.tensor_files import read_tensors

GUIDES = (GaussianGuide, LookaheadGuide)
REMEMBERED = ("states", "noise", "searched")


# --- from one refresh to the next -------------------------------------------------------------------------------------


def test_paths_follow_a_program_that_changes_from_one_refresh_to_the_next():
    """A refresh linearises once. What it remembers is the mean, however far that is."""
    program = example("hovercraft").requires_grad_(False)
    data = drives(program, 3, 40)
    guide = GaussianGuide(program, draws=4, known_start=True, tempering=Constant(), search_again=math.inf)
    guide.refresh(data, 0.0)
    for share in range(1, 11):
        program.mass = torch.tensor(1.5 + 0.05 * share).double()
        before = guide.memory["noise/1"].clone()
        guide.refresh(data, share / 10)
        assert not torch.equal(guide.memory["noise/1"], before)
    exact = smooth(Problem(program, data, True), find_path(Problem(program, data, True)), passes=20)
    for i, label in enumerate(data.labels):
        assert (guide.memory[f"noise/{label}"] - exact.means()[1][:, i]).abs().max() < 0.1


def test_a_guide_remembers_its_paths_from_one_refresh_to_the_next(monkeypatch):
    program = example("hovercraft:HovercraftTruth").requires_grad_(False)
    data = drives(program, 3, 12, gaps=True)
    searched = []

    def counting(problem, **settings):
        searched.append(problem.data.labels)
        return find_and_smooth(problem, **settings)

    monkeypatch.setattr("steady_ppl.guides.linearized.find_and_smooth", counting)
    guide = GaussianGuide(program, draws=4, known_start=True, tempering=Constant())
    guide.refresh(data.subset([0, 1]), 0.0)
    guide.refresh(data.subset([1, 0]), 0.0)
    assert searched == [("1", "2")] and set(guide.memory) == {f"{kind}/{i}" for kind in REMEMBERED for i in "12"}
    guide.refresh(data.subset([1, 2]), 0.0)
    assert searched == [("1", "2"), ("3",)]
    guide.memory["noise/3"].fill_(math.nan)
    assert guide.refresh(data, 0.0)["paths_lost"] == 1
    assert searched[2:] == [("3",)]  # the remembered path has blown up
    exact = smooth(Problem(program, data, True), find_path(Problem(program, data, True)), passes=20)
    for i, label in enumerate(data.labels):
        apart = guide.memory[f"states/{label}"] - exact.means()[0][:, i]
        assert apart[data.rows[:, i]].abs().max() < 0.02


def stays_put(guide, data, progress, smooth=LinearizedGuide._smooth):
    """Smooth as a guide does, but for the path to go on from, which does not move."""
    ahead = smooth(guide, data, progress)
    vars(ahead)["path"] = lambda data: ahead.linearization.path
    return ahead


@pytest.mark.parametrize("guide", GUIDES)
def test_a_guide_leaves_a_wrong_place_for_a_likelier_path(guide, monkeypatch):
    program = example("hovercraft:HovercraftTruth").requires_grad_(False)
    data = drives(program, 3, 12, gaps=True)
    looking = guide(program, draws=4, known_start=True, tempering=Constant(), search_again=0.5)
    looking.refresh(data, 0.0)
    right = {name: value.clone() for name, value in looking.memory.items()}
    wrong = right["states/2"] + torch.tensor([0.0, 0.0, 3.0, 0.0, 0.0, 0.0])
    monkeypatch.setattr(LinearizedGuide, "_smooth", stays_put)
    looking.memory["states/2"] = wrong
    looking.refresh(data, 0.4)
    assert torch.equal(looking.memory["states/2"], wrong)
    looking.refresh(data, 0.5)
    for label in data.labels:
        torch.testing.assert_close(looking.memory[f"states/{label}"], right[f"states/{label}"], rtol=0, atol=0.05)
    looking.refresh(data, 0.9)
    assert {label: float(looking.memory[f"searched/{label}"]) for label in data.labels} == dict.fromkeys("123", 0.5)


@pytest.mark.parametrize("guide", GUIDES)
def test_a_search_that_was_not_needed_may_fail(guide, monkeypatch):
    program = example("hovercraft:HovercraftTruth").requires_grad_(False)
    data = drives(program, 3, 12, gaps=True)
    looking = guide(program, draws=4, known_start=True, tempering=Constant())
    looking.refresh(data, 0.0)

    def fails(*_, **__):
        raise FilterError("no path")

    monkeypatch.setattr("steady_ppl.guides.linearized.find_and_smooth", fails)
    assert looking.refresh(data, 0.3)["searches_failed"] == 1
    looking.memory["noise/3"].fill_(math.nan)
    with pytest.raises(FilterError, match="no path"):
        looking.refresh(data, 0.3)


@pytest.mark.slow
def test_a_search_that_is_lost_for_one_drive_serves_the_others(monkeypatch):
    program = example("hovercraft:HovercraftTruth").requires_grad_(False)
    data = drives(program, 3, 12, gaps=True)
    looking = GaussianGuide(program, draws=4, known_start=True, tempering=Constant(), search_again=0.5)
    looking.refresh(data, 0.0)
    right = {label: looking.memory[f"states/{label}"].clone() for label in data.labels}
    for label in "12":
        looking.memory[f"states/{label}"] = right[label] + torch.tensor([0.0, 0.0, 3.0, 0.0, 0.0, 0.0])

    def one_is_lost(*given, **settings):
        ahead = smooth(*given, **settings)
        ahead.log_likelihood[0] = math.nan
        return ahead

    monkeypatch.setattr("steady_ppl.gaussian.smoother.smooth", one_is_lost)
    monkeypatch.setattr(LinearizedGuide, "_smooth", stays_put)
    looking.refresh(data, 0.5)
    torch.testing.assert_close(looking.memory["states/2"], right["2"], rtol=0, atol=0.05)
    assert (looking.memory["states/1"] - right["1"]).abs().max() > 2
    looking.memory["noise/1"] = torch.full_like(looking.memory["noise/1"], math.nan)
    with pytest.raises(FilterError, match="trajectory 1: the linearised model's log p"):  # its path is gone
        looking.refresh(data.subset([0]), 0.6)


def test_a_guide_refuses_other_drives_of_the_same_labels():
    program = example("hovercraft:HovercraftTruth").requires_grad_(False)
    looking = GaussianGuide(program, draws=4, known_start=True, tempering=Constant())
    looking.refresh(drives(program, 3, 12), 0.0)
    with pytest.raises(UsageError, match="remembers other trajectories of the same labels"):
        looking.refresh(drives(program, 3, 11), 0.1)


# --- training ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("guide", GUIDES)
def test_the_maximum_likelihood_estimate_of_the_cart_is_learned(guide):
    program, data, top = slow_cart()
    # Adam soon forgets the first scores, which are exact and thereby huge
    optimization = Optimization(steps=60, learning_rate=0.2, betas=(0.8, 0.9), averaging=0.8, validate_every=60)
    fewer = {"particles": 30} if guide is LookaheadGuide else {}
    train(
        program,
        guide(program, draws=20, tempering=Constant(), **fewer),
        data,
        Validation(),
        optimization,
        progress=False,
    )
    # d standard errors off the estimate cost d² / 2 nats: half of one
    assert top - float(cart_evidence(program, data).detach()) < 0.125


@pytest.fixture(scope="module")
def data():
    return drives(Cart(), 4, 12, gaps=True)


def run(program, data, guide, *, batch=None, **settings):
    """A short training; every trajectory is held out as well."""
    optimization = Optimization(steps=5, validate_every=2, learning_rate=0.05, batch=batch)
    validation = Validation(data, particles=20, every=2)
    return train(program, guide, data, validation, optimization, progress=False, seed=1, **settings)


def killed_at(guide, step: int):
    """The guide, which is killed at one E step."""
    refresh, done = guide.refresh, []

    def stopping(data, progress):
        if len(done) == step:
            raise RuntimeError("killed")
        done.append(data.labels)
        return refresh(data, progress)

    guide.refresh = stopping
    return guide


@pytest.mark.slow
@pytest.mark.parametrize("batch", [None, 2])
@pytest.mark.parametrize("guide", GUIDES)
def test_a_resumed_run_repeats_an_uninterrupted_one_bit_for_bit(data, tmp_path, guide, batch):
    whole, killed, resumed = Wrong(), Wrong(), Wrong()
    a = run(whole, data, guide(whole, draws=5), batch=batch, checkpoint=tmp_path / "whole")
    with pytest.raises(RuntimeError, match="killed"):
        run(killed, data, killed_at(guide(killed, draws=5), 3), batch=batch, checkpoint=tmp_path / "cut")
    remembered = [name for name in read_tensors(tmp_path / "cut")[0] if name.startswith("memory/")]
    assert "memory/states/1" in remembered and len(remembered) % len(REMEMBERED) == 0
    b = run(resumed, data, guide(resumed, draws=5), batch=batch, checkpoint=tmp_path / "cut", resume=True)
    assert a == b and same(values(whole), values(resumed))
    left = [read_tensors(tmp_path / name) for name in ("whole", "cut")]
    assert same(left[0][0], left[1][0]) and left[0][1] == left[1][1]


def test_a_guide_that_has_forgotten_goes_on_differently(data, tmp_path):
    class Forgetful(GaussianGuide):
        def refresh(self, data, progress):
            self.memory.clear()
            return super().refresh(data, progress)

    programs = [Wrong(), Wrong()]
    for program, guide in zip(programs, (GaussianGuide, Forgetful), strict=True):
        run(program, data, guide(program, draws=5))
    assert not same(*(values(program) for program in programs))


@pytest.mark.parametrize("guide", GUIDES)
def test_mini_batches_train_and_every_trajectory_is_remembered(data, guide):
    program, sizes = Wrong(), []
    batched = guide(program, draws=5)
    refresh = batched.refresh

    def counting(part, progress):
        sizes.append(len(part))
        return refresh(part, progress)

    batched.refresh = counting
    before = values(program)
    trained = run(program, data, batched, batch=2)
    assert sizes == [2] * 5 and [entry["step"] for entry in trained.history] == [2, 4, 5]
    assert set(batched.memory) == {f"{kind}/{label}" for kind in REMEMBERED for label in data.labels}
    assert all(value.shape[0] in (11, 12) for value in batched.memory.values() if value.dim())
    after = values(program)
    assert all(after[name].isfinite() and not torch.equal(after[name], before[name]) for name in after)
