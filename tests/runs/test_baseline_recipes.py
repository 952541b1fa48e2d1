"""The baselines: each learns a small case end to end, from what it may look at and nothing else."""

from __future__ import annotations

import inspect
import json
import math
import re
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import MODELS
from learned import held_out, same, values
from small import HOVERCRAFT, only_start, simulated, steady, written

from steady_ppl import UsageError, bearings_to, load_program, seeded, simulate
from steady_ppl.model.planar_vehicle import PlanarVehicle
from steady_ppl.runs.recipes import find_recipe

QUIET = {"progress": False}
LEARN = {"steps": 60, "learning_rate": 0.05}
SVI = {"steps": 150, "learning_rate": 0.02, "gradient_norm": None}
RECIPES = {
    "svi": {"steps": 400, "learning_rate": 0.02},
    "svi not centred": {**SVI, "centred": False, "first_kl_weight": 1.0},
    "svi mean-field": {**SVI, "guide": "mean-field"},
    "svi smoother": {**SVI, "guide": "smoother"},
    "fit-hand": {"hand": str(HOVERCRAFT), "lineages": 3, **LEARN},  # in the first test another, which is wrong
    "fit-tv": {"regularization": 0.01, **LEARN},  # sharp bearings need little
    "steady-minus": LEARN,
}
FEW = {name: options | {"steps": 3, "validate_every": 2} for name, options in RECIPES.items()}


def vehicle(degrees: float) -> PlanarVehicle:
    """The owner's hovercraft, seen so sharply."""
    program = load_program(HOVERCRAFT)
    program.bearing_sd = math.radians(degrees)
    return program


def learned(name: str, program, train, valid=None, **options):
    return find_recipe(name.split()[0])(program, train, valid, **options, **QUIET)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.exhaustive if name.startswith(("svi", "fit-tv")) else ())
        for name in RECIPES
    ],
)
def test_each_beats_hand(name: str) -> None:
    """A vehicle believed to be twice as heavy as it is: its mass is found, and held-out drives are likelier."""
    degrees = 0.25 if name == "fit-tv" else 5.0  # one row's bearings must be worth differentiating
    truth = vehicle(degrees)
    truth.duration = 4.0
    train, valid = (only_start(simulate(truth, count, seed=seed)) for count, seed in ((12, 0), (4, 1)))
    program = vehicle(degrees)
    program.mass = torch.tensor(3.0)
    options, far = dict(RECIPES[name]), abs(3.0 - 1.5) / 4
    if name == "fit-hand":  # nearer than the hand, whose paths it believes
        options["hand"], far = vehicle(degrees), abs(2.2 - 1.5)
        options["hand"].mass = torch.tensor(2.2)
    before = held_out(options.get("hand", program), valid)
    learned(name, program, train, valid, known_start=True, **options)
    assert abs(program.mass.item() - 1.5) < far
    assert held_out(program, valid) > before


@pytest.mark.exhaustive
@pytest.mark.parametrize("known_start", [True, False])
@pytest.mark.parametrize("name", list(FEW))
def test_none_of_them_looks_at_the_true_states(name: str, known_start: bool) -> None:
    """But for a known start, and FitTV not even for that: the same bit for bit whatever the x. columns say."""
    train, valid = simulated(rows=9), simulated(rows=9, seed=1)
    lies, later_lies = (replace(part, states=part.states + 3.0) for part in (train, valid))
    if known_start:
        later_lies.states[0] = valid.states[0]
        if name != "fit-tv":
            lies.states[0] = train.states[0]
    without = (part.without_truth(keep_start=known_start) for part in (train, valid))
    results = []
    for table, later in ((train, valid), (lies, later_lies), without):
        with seeded(1):
            program = load_program(MODELS / "neural_vehicle.py:NeuralHovercraft")
        fit = learned(name, program, table, later, known_start=known_start, **FEW[name])
        results.append((values(program), fit.trained))
    for parameters, trained in results[1:]:
        assert same(parameters, results[0][0]) and trained == results[0][1]


def test_fit_hand_needs_a_hand() -> None:
    with pytest.raises(UsageError, match="--hand MODEL"):
        learned("fit-hand", load_program(HOVERCRAFT), simulated(rows=5))


def test_fit_hand_needs_the_same_states() -> None:
    with pytest.raises(UsageError, match="Pendulum and Hovercraft have different states"):
        learned("fit-hand", load_program(HOVERCRAFT), simulated(rows=5), hand=str(MODELS / "pendulum.py"))


def test_a_hand_that_changed_is_not_resumed_with(tmp_path, capsys) -> None:
    hand, table = tmp_path / "hovercraft.py", written(tmp_path / "t.csv", simulated(rows=9))
    hand.write_text(HOVERCRAFT.read_text())
    few = ("--steps", 2, "--set", "lineages=2", "--known-start")
    command = ("fit", HOVERCRAFT, table, "--recipe", "fit-hand", "--hand", hand, *few, "--out", tmp_path / "run")
    assert steady(*command) == 0
    hand.write_text(hand.read_text().replace("1.5", "1.6"))
    assert steady(*command, "--resume") == 2
    assert "needs the same hand" in capsys.readouterr().err


def test_fit_hand_by_command(tmp_path, capsys) -> None:
    table = written(tmp_path / "t.csv", simulated(rows=9))
    few = ("--set", "lineages=2", "--steps", 2, "--known-start", "--out", tmp_path / "run")
    assert steady("fit", HOVERCRAFT, table, "--recipe", "fit-hand", *few) == 2
    assert "--hand MODEL" in capsys.readouterr().err and not (tmp_path / "run").exists()
    assert steady("fit", HOVERCRAFT, table, "--recipe", "fit-hand", "--hand", HOVERCRAFT, *few) == 0
    assert steady("fit", HOVERCRAFT, table, "--hand", HOVERCRAFT, "--out", tmp_path / "other") == 2
    assert "recipe steady has no setting hand" in capsys.readouterr().err


def test_svis_guides_are_named() -> None:
    with pytest.raises(UsageError, match="no guide 'lookahead'; there are network, mean-field, smoother"):
        learned("svi", load_program(HOVERCRAFT), simulated(rows=5), guide="lookahead")
    with pytest.raises(UsageError, match="no batch"):
        learned("svi", load_program(HOVERCRAFT), simulated(rows=5), guide="mean-field", batch=2, steps=1)


def test_what_is_the_networks_alone_is_refused_elsewhere() -> None:
    with pytest.raises(UsageError, match="guide mean-field has no width; network has"):
        learned("svi", load_program(HOVERCRAFT), simulated(rows=5), guide="mean-field", width=8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recipe", "setting", "value", "wanted"),
    [
        ("svi", "draws", 0, "at least 1"),
        ("svi", "width", 0, "at least 1"),
        ("svi", "guide_rate", -1.0, "above 0"),
        ("svi", "first_kl_weight", math.nan, "0 or more"),
        ("svi", "gradient_norm", -1.0, "above 0"),
        ("svi", "validate_every", 0, "at least 1"),
        ("svi", "batch", -3, "at least 1"),
        ("svi", "averaging", 2.0, "between 0 and 1"),
        ("fit-tv", "regularization", 0.0, "above 0"),
        ("fit-tv", "iterations", 0, "at least 1"),
        ("fit-hand", "lineages", 0, "at least 1"),
        ("fit-hand", "particles", 0, "at least 1"),
        ("fit-hand", "validation_particles", 0, "at least 1"),
        ("steady", "particles", 0, "at least 1"),
        ("steady", "draws", 0, "at least 1"),
        ("steady-minus", "validation_particles", -5, "at least 1"),
        ("svi", "betas", 0.9, "two numbers from 0 to below 1"),
        ("svi", "betas", (0.9,), "two numbers"),
        ("svi", "betas", "ab", "two numbers"),
        ("svi", "betas", (0.9, 0.99, 0.999), "two numbers"),
        ("fit-hand", "hand", 5, "a model, or where it is"),
    ],
)
def test_settings_that_mean_nothing_are_refused(recipe: str, setting: str, value: float, wanted: str) -> None:
    given = {"hand": str(HOVERCRAFT)} if recipe == "fit-hand" else {}
    table = simulated(rows=5)
    with pytest.raises(UsageError, match=re.escape(f"is {value}: it must be {wanted}")):
        learned(recipe, load_program(HOVERCRAFT), table, table, **given | {setting: value})


@pytest.mark.parametrize("guide", ["network", "smoother", "mean-field"])
def test_noise_that_is_not_normal_needs_the_mean_field_guide(guide: str) -> None:
    program = load_program(HOVERCRAFT)
    program.observe = lambda state: pyro.sample(
        "bearing", dist.Laplace(bearings_to(program.landmarks, state, sd=0.1).mean, 0.1).to_event(1)
    )
    call = {"guide": guide, "steps": 1, "known_start": True}
    if guide == "mean-field":
        assert learned("svi", program, simulated(rows=5), **call).trained.kept == 1
        return
    with pytest.raises(UsageError, match="begins at the linearised model.*guide mean-field does without"):
        learned("svi", program, simulated(rows=5), **call)


@pytest.mark.parametrize(
    ("setting", "wanted"),
    [
        ("learning_rate=abc", "learning_rate is 'abc': it must be a number"),
        ("width=2.5", "width is 2.5: it must be a whole number or none"),
        ("centred=no", "centred is 'no': it must be true or false or none"),
    ],
)
def test_settings_of_another_kind_are_refused(tmp_path, capsys, setting: str, wanted: str) -> None:
    table = written(tmp_path / "t.csv", simulated(rows=5))
    command = ("fit", HOVERCRAFT, table, "--recipe", "svi", "--set", setting, "--out", tmp_path / "run")
    assert steady(*command) == 2
    assert wanted in capsys.readouterr().err and not (tmp_path / "run").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("word", "value"), [("false", False), ("true", True), ("none", None), ("False", False)])
def test_a_word_for_yes_and_no_is_one(tmp_path, word: str, value: bool | None) -> None:
    table, run = written(tmp_path / "t.csv", simulated(rows=5)), tmp_path / "run"
    few = ("--steps", 1, "--known-start", "--set", f"centred={word}", "--out", run)
    assert steady("fit", HOVERCRAFT, table, "--recipe", "svi", *few) == 0
    record = json.loads((run / "run.json").read_text())
    assert record["options"]["centred"] is value
    assert record["settings"]["centred"] is (value is not False) and record["settings"]["width"] == 64


def test_what_a_guide_has_not_is_none_among_its_settings() -> None:
    fit = learned("svi", load_program(HOVERCRAFT), simulated(rows=5), guide="mean-field", steps=1)
    assert fit.settings["width"] is fit.settings["centred"] is None


def test_fit_hand_by_a_hand_that_reads_less() -> None:
    """Its paths are fitted to all that the other program reads."""
    hand = load_program(HOVERCRAFT)
    hand.landmarks = hand.landmarks[:3]
    fit = learned("fit-hand", load_program(HOVERCRAFT), simulated(rows=9), hand=hand, lineages=2, steps=2)
    assert fit.trained.kept == 2


def test_steady_minus_has_steadys_settings_but_the_tempering() -> None:
    takes = {
        name: {
            setting: parameter.default for setting, parameter in inspect.signature(find_recipe(name)).parameters.items()
        }
        for name in ("steady", "steady-minus")
    }
    assert takes["steady-minus"] == {k: v for k, v in takes["steady"].items() if k not in ("first_weight", "ramp")}


def test_fit_hand_fits_to_different_paths(monkeypatch) -> None:
    recipe, given = find_recipe("fit-hand"), []
    module = recipe.__globals__["fit_truth"]
    whole = module.supervised
    monkeypatch.setattr(module, "supervised", lambda *told, **more: given.append(told[1]) or whole(*told, **more))
    recipe(load_program(HOVERCRAFT), simulated(rows=9), hand=str(HOVERCRAFT), lineages=3, steps=2, **QUIET)
    states = given[0].states.unflatten(1, (3, -1))
    assert bool((states[1:].std(1) > 0).any(-1).all())


def test_steady_minus_does_not_temper() -> None:
    fit = learned("steady-minus", load_program(HOVERCRAFT), simulated(rows=9), steps=4, validate_every=1)
    assert [entry["observation_weight"] for entry in fit.trained.history] == [1.0] * 4
    assert fit.recipe == "steady-minus"


@pytest.mark.slow
@pytest.mark.parametrize("guide", ["network", "mean-field", "smoother"])
def test_svi_resumes_as_if_nothing_had_happened(tmp_path, guide: str) -> None:
    """The guide's parameters are in the checkpoint as well."""
    outcomes = []
    for steps in ((6,), (3, 6)):
        file = tmp_path / f"{len(steps)}.safetensors"
        for index, count in enumerate(steps):
            with seeded(1):
                program = load_program(HOVERCRAFT)
            options = {
                "validate_every": 3,
                "final_rate": 1.0,
                "annealing": 0.0,
                "checkpoint": file,
                "resume": index > 0,
            }
            learned("svi", program, simulated(rows=9), guide=guide, steps=count, **options)
        outcomes.append(values(program))
    assert same(*outcomes)
