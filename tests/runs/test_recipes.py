"""Recipes: each does what it is for on a small case, by the measurements it may look at and no others."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from examples import MODELS, HeavyTailed, example
from learned import held_out, same, values
from small import FEW, HOVERCRAFT, contents, only_start, simulated, steady, written

from steady_ppl import UsageError, for_program, load_program, read_table, seeded, simulate
from steady_ppl.runs.recipes import find_recipe, suited_recipe

QUIET = {"progress": False}
GUIDES = {
    "bootstrap": {"guide": "bootstrap", "particles": 20, "draws": 3},
    "lookahead": {"guide": "lookahead", "particles": 20, "draws": 3},
    "gaussian": {"draws": 3},
}


# --- finding them -----------------------------------------------------------------------------------------------------


def test_a_recipes_name_is_its_file() -> None:
    for file in (MODELS.parent / "inference").glob("*.py"):
        found = find_recipe(file.stem.replace("_", "-"))
        assert Path(found.__code__.co_filename) == file


@pytest.mark.parametrize("name", ["", "Steady", "fit_truth", "../inference/steady", "steady.py", "nowhere/mine.py"])
def test_what_is_no_recipe_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match="no recipe"):
        find_recipe(name)


# --- hand -------------------------------------------------------------------------------------------------------------


def test_hand_changes_nothing(tmp_path: Path) -> None:
    program = load_program(HOVERCRAFT)
    before = values(program)
    fit = find_recipe("hand")(program, simulated(rows=4), seed=3)
    assert same(values(fit.program), before) and fit.program is program
    assert (fit.recipe, fit.seed, fit.trained) == ("hand", 3, None)


# --- steady -----------------------------------------------------------------------------------------------------------


@pytest.mark.exhaustive
@pytest.mark.parametrize("guide", list(GUIDES))
def test_steady_finds_a_mass_that_was_wrong_by_far(guide: str) -> None:
    """Believed to be twice as heavy as it is and seen through bearings only; held-out drives must gain as well."""
    train, valid = simulated(trajectories=12, rows=41), simulated(trajectories=4, rows=41, seed=1)
    program = load_program(HOVERCRAFT)
    program.mass = torch.tensor(3.0)
    before = held_out(program, valid)
    options = {**GUIDES[guide], "draws": 5, "steps": 40, "learning_rate": 0.05, "known_start": True}
    if guide == "bootstrap":
        options["particles"] = 60
    find_recipe("steady")(program, train, **options, **QUIET)
    assert abs(program.mass.item() - 1.5) < abs(3.0 - 1.5) / 5
    assert held_out(program, valid) > before


@pytest.mark.slow
@pytest.mark.parametrize("guide", list(GUIDES))
@pytest.mark.parametrize("known_start", [True, False])
@pytest.mark.parametrize("name", ["hovercraft.py:Hovercraft", "neural_vehicle.py:NeuralHovercraft"])
def test_steady_never_looks_at_the_true_states(name: str, known_start: bool, guide: str) -> None:
    """But for a known start, the result is the same bit for bit whatever the x. columns say."""
    train, valid = simulated(rows=6), simulated(rows=6, seed=1)
    results = []
    for given in (lambda data: data, only_start, lambda data: data.without_truth(keep_start=known_start)):
        with seeded(1):
            program = load_program(MODELS / name)
        options = {**GUIDES[guide], "steps": 4, "validate_every": 2, "known_start": known_start}
        fit = find_recipe("steady")(program, given(train), given(valid), **options, **QUIET)
        results.append((values(program), fit.trained))
    for parameters, trained in results[1:]:
        assert same(parameters, results[0][0]) and trained == results[0][1]


def test_a_known_start_makes_a_difference() -> None:
    outcomes = []
    for known_start in (True, False):
        program = load_program(HOVERCRAFT)
        options = {"draws": 3, "steps": 2, "known_start": known_start}
        fit = find_recipe("steady")(program, simulated(rows=6), **options, **QUIET)
        assert fit.known_start == known_start
        outcomes.append(values(program))
    assert not same(*outcomes)


def test_what_is_not_given_comes_from_the_guides_defaults() -> None:
    fit = find_recipe("steady")(load_program(HOVERCRAFT), simulated(rows=4), guide="lookahead", steps=1, **QUIET)
    assert (fit.settings["particles"], fit.settings["draws"], fit.settings["gradient_steps"]) == (100, 64, 1)


@pytest.mark.parametrize(
    ("make", "options", "guide", "notes"),
    [
        (lambda: load_program(HOVERCRAFT), {}, "gaussian", []),
        (lambda: load_program(HOVERCRAFT), {"particles": 10}, "lookahead", []),
        (HeavyTailed, {"particles": 50}, "bootstrap", ["guide bootstrap: site 'acceleration' is StudentT"]),
    ],
)
def test_the_guide_is_chosen_by_the_programs_noise(make, options, guide: str, notes: list[str]) -> None:
    fit = find_recipe("steady")(make(), simulated(rows=5), steps=1, known_start=True, **options, **QUIET)
    assert fit.settings["guide"] == guide and len(fit.notes) == len(notes)
    assert all(said.startswith(note) for said, note in zip(fit.notes, notes, strict=True))


def test_a_fit_says_why_its_filter_ran_in_plain_torch() -> None:
    data = simulated(trajectories=4, rows=51)
    settings = {"guide": "bootstrap", "particles": 120, "draws": 2, "steps": 1, "known_start": True, **QUIET}
    plain, compiled = (
        find_recipe("steady")(make(), data, **settings) for make in (HeavyTailed, lambda: load_program(HOVERCRAFT))
    )
    assert any(note.startswith("the E steps ran in plain torch") and "StudentT" in note for note in plain.notes)
    assert not any("plain torch" in note for note in compiled.notes)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"guide": "kalman"}, "no guide 'kalman'; there are gaussian, lookahead, bootstrap, auto"),
        ({"guide": "gaussian", "particles": 5}, "guide gaussian has no particles"),
    ],
)
def test_a_guide_that_there_is_not_or_what_it_does_not_take_is_refused(options, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        find_recipe("steady")(load_program(HOVERCRAFT), simulated(rows=4), **options, **QUIET)


@pytest.mark.slow
def test_the_gaussian_guide_says_when_the_posterior_is_not_normal() -> None:
    """Landmarks among the drives, whose starts are not known: bearings turn quickly there."""
    far, near = load_program(HOVERCRAFT), load_program(HOVERCRAFT)
    near.landmarks = ((1.0, 1.0), (0.0, 0.0))
    for program in (far, near):
        program.duration = 3.0
    doubted, trusted = (
        find_recipe("steady")(program, simulate(program, 4, seed=1, substeps=1), steps=1, **QUIET).notes
        for program in (near, far)
    )
    assert "try guide=lookahead" in doubted[0] and len(trusted) == 0


def test_a_fits_settings_are_what_the_recipe_was_called_with() -> None:
    options = {"guide": "bootstrap", "particles": 20, "draws": 3, "steps": 2, "seed": 9}
    fit = find_recipe("steady")(load_program(HOVERCRAFT), simulated(rows=4), **options, **QUIET)
    assert options.items() <= fit.settings.items() and fit.seed == 9
    assert not {"program", "table", "valid", "run", "progress"} & fit.settings.keys()
    json.dumps(fit.settings)


# --- fit-truth --------------------------------------------------------------------------------------------------------


def regression(data) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Least squares on the true states: forward = F/m − d₁ v|v|/m, lateral = −d₂ w|w|/m, yaw = Δ/I − d₃ ω/I.

    Returns:
        Channel → coefficients and their standard errors.
    """
    states, controls, steps = (tensor.double().numpy() for tensor in (data.states, data.controls[:-1], data.steps))
    _, _, heading, vx, vy, w = np.moveaxis(states, -1, 0)
    turned = np.exp(-1j * heading[:-1])
    body = turned * (vx[:-1] + 1j * vy[:-1])
    acceleration = turned * (np.diff(vx, axis=0) + 1j * np.diff(vy, axis=0)) / steps
    left, right = np.moveaxis(controls, -1, 0)
    problems = {
        "forward": ([left + right, -body.real * abs(body.real)], acceleration.real),
        "lateral": ([-body.imag * abs(body.imag)], acceleration.imag),
        "yaw": ([right - left, -w[:-1]], np.diff(w, axis=0) / steps),
    }
    found = {}
    for channel, (columns, target) in problems.items():
        design = np.stack([column.ravel() for column in columns], -1)
        coefficients, (rest,), *_ = np.linalg.lstsq(design, target.ravel(), rcond=None)
        spread = np.linalg.inv(design.T @ design) * rest / len(design)
        found[channel] = coefficients, np.sqrt(np.diag(spread))
    return found


def test_fit_truth_is_least_squares_on_the_true_states() -> None:
    """Its optimum is known exactly where drag depends on the old velocity, as in the paper; what is left of the way
    must be nothing beside the estimate's own error."""
    paper = f"{MODELS / 'paper.py'}:PaperHovercraftTruth"
    truth = load_program(paper)
    truth.drag, truth.duration = torch.tensor([0.4, 0.6, 0.5]), 8.0
    data = simulate(truth, 4, seed=2)
    program = load_program(paper)
    program.drag = torch.tensor([0.2, 0.2, 0.2])
    options = {"steps": 150, "learning_rate": 0.1, "averaging": 0.8}
    find_recipe("fit-truth")(program, data, **options, **QUIET)
    mass, inertia, drag = (getattr(program, name).detach().numpy() for name in ("mass", "inertia", "drag"))
    learned = {
        "forward": np.array([1, drag[0]]) / mass,
        "lateral": np.array([drag[1]]) / mass,
        "yaw": np.array([1, drag[2]]) / inertia,
    }
    for channel, (coefficients, errors) in regression(for_program(program, data)).items():
        assert (abs(learned[channel] - coefficients) < 0.1 * errors).all(), channel
    error = 1 / math.sqrt(2 * int(data.transitions.sum()))  # relative, of a standard deviation
    np.testing.assert_array_less(abs(program.noise.detach().numpy() / [0.08, 0.08, 0.05] - 1), 4 * error)


@pytest.mark.slow
def test_fit_truth_beats_hand_on_held_out_measurements() -> None:
    train, valid = simulated(rows=41), simulated(rows=41, seed=1)
    program = load_program(HOVERCRAFT)
    program.mass = torch.tensor(3.0)
    before = held_out(program, valid)
    find_recipe("fit-truth")(program, train, steps=40, learning_rate=0.1, **QUIET)
    assert held_out(program, valid) > before


# --- a recipe of one's own --------------------------------------------------------------------------------------------

MINE = """\
from steady_ppl import Fit

from .size import FACTOR


def fit(program, table, valid=None, *, known_start=False, seed=0, steps=1):
    program.mass = program.mass.detach() * FACTOR * steps
    return Fit(program, "mine", {"steps": steps}, seed=seed, known_start=known_start)
"""


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    (tmp_path / "recipes").mkdir()
    (tmp_path / "recipes" / "size.py").write_text("FACTOR = 2\n")
    file = tmp_path / "recipes" / "mine.py"
    file.write_text(MINE)
    return file


def test_a_recipe_of_ones_own_is_named_by_its_path(tmp_path: Path, mine: Path, capsys) -> None:
    table = written(tmp_path / "t.csv")
    command = ("fit", HOVERCRAFT, table, "--recipe", mine, "--out", tmp_path / "run")
    assert steady(*command, "--particles", 3) == 2
    assert "has no setting particles" in capsys.readouterr().err
    assert steady(*command, "--steps", 2) == 0
    assert "Hovercraft(mass=6.0" in capsys.readouterr().out
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (record["settings"], record["options"]) == ({"steps": 2}, {"steps": 2})
    assert steady("evaluate", tmp_path / "run", table, "--particles", 20, "--rollouts", 2) == 0


def test_a_recipe_beside_its_program_is_no_obstacle(tmp_path: Path, mine: Path) -> None:
    program = mine.with_name("hovercraft.py")
    program.write_text(HOVERCRAFT.read_text())
    table = written(tmp_path / "t.csv")
    assert steady("fit", program, table, "--recipe", mine, "--out", tmp_path / "run") == 0
    assert steady("evaluate", tmp_path / "run", table, "--particles", 20, "--rollouts", 2) == 0


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (", known_start=False, seed=0, steps=1", ""),
        ('    return Fit(program, "mine", {"steps": steps}, seed=seed, known_start=known_start)\n', ""),
    ],
    ids=["lacks arguments", "returns nothing"],
)
def test_a_recipe_of_another_form_is_bad_input_and_leaves_no_run(tmp_path: Path, mine: Path, capsys, old, new) -> None:
    assert old in MINE
    mine.write_text(MINE.replace(old, new).replace(", *)", ")"))
    table = written(tmp_path / "t.csv")
    before = contents(tmp_path)
    assert steady("fit", HOVERCRAFT, table, "--recipe", mine, "--out", tmp_path / "run") == 2
    error = capsys.readouterr().err
    assert "mine" in error and len(error.splitlines()) == 1
    assert contents(tmp_path) == before


# --- the one that suits -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("program", "options", "device", "recipe", "says"),
    [
        ("hovercraft", {}, "cpu", "likelihood", "5 learnable numbers and noise that can be linearised"),
        ("hovercraft", {"validation_particles": 50}, "cpu", "likelihood", "5 learnable numbers"),
        ("hovercraft", {"particles": 50}, "cpu", "steady", "particles is a setting of it"),
        ("hovercraft", {}, "cuda", "steady", "it computes on cuda"),
        (
            "neural_vehicle.py:NeuralHovercraft",
            {},
            "cpu",
            "steady",
            "where likelihood takes 1 to 60",
        ),
    ],
)
def test_it_goes_by_program_and_settings(tmp_path: Path, program: str, options, device: str, recipe: str, says: str):
    table = read_table(written(tmp_path / "t.csv"))
    name, why = suited_recipe(example(program), table, options, device=device)
    assert name == recipe and says in why


def test_noise_that_cannot_be_linearised_is_steadys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    table = read_table(written(tmp_path / "t.csv"))
    monkeypatch.setattr("steady_ppl.gaussian.linearize.why_not_linear", lambda *_, **__: "its noise is Laplace")
    assert suited_recipe(example("hovercraft"), table, {}) == (
        "steady",
        "likelihood needs a model that can be linearised: its noise is Laplace",
    )


@pytest.mark.slow
def test_a_fit_says_which_and_keeps_it_and_goes_on_with_it(tmp_path: Path, capsys):
    table = written(tmp_path / "t.csv")
    assert steady("fit", HOVERCRAFT, table, "--out", tmp_path / "one") == 0
    assert "recipe likelihood: 5 learnable numbers" in capsys.readouterr().err
    assert json.loads((tmp_path / "one" / "run.json").read_text())["recipe"] == "likelihood"
    assert steady("fit", HOVERCRAFT, table, *FEW, "--out", tmp_path / "two") == 0
    assert "recipe steady: " in capsys.readouterr().err
    assert steady("fit", HOVERCRAFT, table, *FEW, "--out", tmp_path / "two", "--resume") == 0
    assert "recipe steady: " in capsys.readouterr().err
    svi = ("fit", HOVERCRAFT, table, "--set", "steps=2", "--out", tmp_path / "four")
    assert steady(*svi, "--recipe", "svi") == 0
    capsys.readouterr()
    assert steady(*svi, "--resume") == 0
    assert json.loads((tmp_path / "four" / "run.json").read_text())["recipe"] == "svi"
    assert "recipe " not in capsys.readouterr().err
    assert steady("fit", HOVERCRAFT, table, "--recipe", "hand", "--out", tmp_path / "three") == 0
    assert "recipe hand: " not in capsys.readouterr().err
