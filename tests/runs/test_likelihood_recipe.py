"""The recipe `likelihood` finds what made the drives, as far as long training does."""

from __future__ import annotations

import json
from pathlib import Path

import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import MODELS, HeavyTailed
from pyro.distributions import constraints
from pyro.nn import PyroParam
from small import HOVERCRAFT, steady, written

import steady_ppl as st
from steady_ppl.model.problem import Problem
from steady_ppl.runs.recipes import find_recipe

NEURAL = f"{MODELS / 'neural_vehicle.py'}:NeuralHovercraft"


@pytest.fixture(scope="module")
def fitted(lighter) -> st.Fit:
    return find_recipe("likelihood")(st.load_program(HOVERCRAFT), *lighter, known_start=True)


@pytest.mark.slow
def test_it_finds_what_made_the_drives(fitted):
    assert float(fitted.program.mass.detach()) == pytest.approx(1.2, rel=0.05)
    assert float(fitted.program.noise[0].detach()) == pytest.approx(0.08, rel=0.4)
    assert fitted.recipe == "likelihood" and not fitted.notes
    first, last = fitted.trained.history
    assert first["step"] == 0 and last["step"] == fitted.trained.kept
    assert last["log_likelihood"] > first["log_likelihood"] + 1 and fitted.trained.still_rising is None


class Wheel(st.Program):
    """A wheel that turns at a constant rate; how high a mark on its rim is seen to be."""

    states = ("turned [rad]",)
    controls = ("nothing",)
    measurements = ("height [m]",)
    channels = ("turned [rad/s]",)
    step, duration = 0.1, 10.0

    def __init__(self, rate: float = 1.0) -> None:
        super().__init__()
        self.rate = PyroParam(torch.tensor(rate), constraints.positive)

    def initial(self):
        return pyro.sample("start", dist.Normal(torch.zeros(1), 0.01).to_event(1))

    def transition(self, state, control, time, step):
        drawn = pyro.sample("turned", dist.Normal(self.rate + 0 * control[..., 0], 0.01))
        return st.stack(state[..., 0] + step * drawn)

    def observe(self, state):
        pyro.sample("height", dist.Normal(state.sin(), 0.1).to_event(1))


@pytest.mark.slow
def test_of_several_starts_the_likeliest_is_kept():
    """Slow waves fit a fast one in many places, each better than its neighbours."""
    table = st.simulate(Wheel(2.2), 2, seed=3)
    ends = [find_recipe("likelihood")(Wheel(1.0), table, starts=starts, seed=1) for starts in (1, 12)]
    alone, several = (float(fit.program.rate.detach()) for fit in ends)
    assert abs(alone - 2.2) > 0.3 and abs(several - 2.2) < 0.02
    assert any("nats above those before it" in note for note in ends[1].notes)
    assert ends[1].settings["starts"] == 12
    with pytest.raises(st.UsageError, match="starts is 0: it must be at least 1"):
        find_recipe("likelihood")(Wheel(1.0), table, starts=0)


@pytest.mark.exhaustive
def test_long_training_does_not_get_further(fitted, lighter):
    program = st.load_program(HOVERCRAFT)
    long = find_recipe("steady")(program, lighter[0], known_start=True, steps=150, progress=False).program
    ours, theirs = (likelihood(one, lighter[0]) for one in (fitted.program, long))
    assert ours > theirs - 0.1


def likelihood(program, table) -> float:
    """Log p(y) of the linearised program."""
    from steady_ppl.gaussian.smoother import find_path, smooth

    data = st.for_program(program, table)
    with st.seeded(0, "paths"):
        path = find_path(Problem(program, data, True))
    return float(smooth(Problem(program, data, True), path, passes=4).log_likelihood.sum())


@pytest.mark.slow
def test_it_is_a_recipe_of_the_command_line(tmp_path: Path, lighter, capsys):
    tables = [written(tmp_path / f"{name}.csv", data) for name, data in zip(("train", "valid"), lighter, strict=True)]
    command = ("fit", HOVERCRAFT, tables[0], "--valid", tables[1], "--recipe", "likelihood", "--known-start")
    assert steady(*command, "--out", tmp_path / "run") == 0
    assert "held-out log p(y) of a trajectory" in capsys.readouterr().out
    assert json.loads((tmp_path / "run/run.json").read_text())["recipe"] == "likelihood"
    assert float(st.Fit.load(tmp_path / "run").program.mass.detach()) == pytest.approx(1.2, rel=0.05)


def test_what_it_cannot_fit_is_refused(lighter):
    for program, says in ((st.load_program(NEURAL), "a network cannot be looked at"), (HeavyTailed(), "StudentT")):
        with pytest.raises(st.UsageError, match=says):
            find_recipe("likelihood")(program, lighter[0], known_start=True)
