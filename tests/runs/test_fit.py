"""Run folders: what a fit leaves behind, and what is refused when it is read again."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import arviz
import pytest
import torch
from examples import MODELS, drives, example
from safetensors.torch import load_file
from small import HOVERCRAFT, TRUTH, contents, simulated, steady, written

from steady_ppl import Fit, Program, ProgramError, RunError, SteadyError, Trained, load_program, write_table
from steady_ppl.comparison.evaluate import evaluate
from steady_ppl.likelihood.information import ParameterInformation
from steady_ppl.runs.recipes import run_recipe
from steady_ppl.utils.tensor_files import write_tensors

FILES = {"parameters.safetensors", "posterior.nc", "run.json"}
NEURAL = f"{MODELS / 'neural_vehicle.py'}:NeuralHovercraft"


def fitted(program: Program | None = None) -> Fit:
    """A fit as a recipe returns it, with parameters that are nobody's defaults."""
    program = program or load_program(HOVERCRAFT)
    with torch.no_grad():
        for parameter in program.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    trained = Trained(history=[{"step": 2.0, "loss": 1.5, "log_likelihood": -3.25}], kept=2)
    return Fit(program, "steady", {"steps": 2}, seed=7, known_start=True, trained=trained, notes=["a note"])


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The hovercraft's file, to move and to change."""
    return Path(shutil.copy(HOVERCRAFT, tmp_path / "hovercraft.py"))


# --- there and back ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "source", [HOVERCRAFT, TRUTH, NEURAL, MODELS / "pendulum.py"], ids=["own", "truth", "net", "pendulum"]
)
def test_a_fit_comes_back_as_it_was_saved(tmp_path: Path, source) -> None:
    fit = fitted(load_program(source))
    fit.save(tmp_path / "run")
    again = Fit.load(tmp_path / "run")
    assert type(again.program).__name__ == type(fit.program).__name__ and again.program is not fit.program
    before, after = fit.program.state_dict(), again.program.state_dict()
    assert before.keys() == after.keys() and all(torch.equal(before[name], after[name]) for name in before)
    for field in ("recipe", "settings", "seed", "known_start", "trained", "notes"):
        assert getattr(again, field) == getattr(fit, field), field


def test_a_networks_normalisation_is_part_of_the_run(tmp_path: Path) -> None:
    data = drives(load_program(TRUTH), 2, 8)
    program = load_program(NEURAL)
    program.prepare(data, False)
    Fit(program, "hand").save(tmp_path / "run")
    assert torch.equal(Fit.load(tmp_path / "run").program.input_mean, program.input_mean)


def test_a_loaded_fit_is_judged_exactly_as_the_saved_one(tmp_path: Path) -> None:
    fit, data = fitted(), simulated()
    fit.save(tmp_path / "run")
    options = {"particles": 40, "rollouts": 3, "seed": 2}
    assert evaluate(Fit.load(tmp_path / "run"), data, **options) == evaluate(fit, data, **options)


def test_double_precision_comes_back(tmp_path: Path) -> None:
    fit = fitted(load_program(HOVERCRAFT).double())
    fit.save(tmp_path / "run")
    again = Fit.load(tmp_path / "run").program
    assert again.mass.dtype == torch.float64 and torch.equal(again.mass, fit.program.mass)


def test_a_hand_written_program_has_no_history(tmp_path: Path) -> None:
    Fit(load_program(HOVERCRAFT), "hand").save(tmp_path / "run")
    assert Fit.load(tmp_path / "run").trained is None


def test_a_fit_interrupted_before_its_first_validation_comes_back_as_interrupted(tmp_path: Path) -> None:
    Fit(load_program(HOVERCRAFT), "steady", trained=Trained([], kept=0, interrupted=True)).save(tmp_path / "run")
    assert Fit.load(tmp_path / "run").trained == Trained([], kept=0, interrupted=True)


# --- what is written --------------------------------------------------------------------------------------------------


def test_the_record_says_where_a_result_is_from(tmp_path: Path, copy: Path) -> None:
    folder = tmp_path / "runs" / "first"
    fitted(load_program(copy)).save(folder)
    record = json.loads((folder / "run.json").read_text())
    digest = hashlib.sha256(copy.read_bytes()).hexdigest()
    assert record["program"] == {"class": "Hovercraft", "file": "../../hovercraft.py", "sha256": digest}
    expected = {"recipe": "steady", "status": "finished", "known_start": True, "seed": 7, "settings": {"steps": 2}}
    expected |= {"kept_step": 2, "notes": ["a note"]}
    expected["history"] = [{"step": 2.0, "loss": 1.5, "log_likelihood": -3.25}]
    assert {key: record[key] for key in expected} == expected
    for package in ("steady-ppl", "torch", "pyro-ppl", "numpy"):
        assert record["versions"][package] == importlib.metadata.version(package)
    assert {"python", "torch_threads"} <= record["versions"].keys()


def test_the_record_of_a_fit_holds_options_settings_and_the_tables_hashes(tmp_path: Path) -> None:
    train, valid = simulated(rows=6), simulated(rows=6, seed=1)
    options = {"guide": "bootstrap", "particles": 10, "draws": 2, "steps": 2}
    run_recipe("steady", load_program(HOVERCRAFT), train, valid, tmp_path / "run", options=options, seed=3)
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert record["options"] == options and record["seed"] == 3 and not record["known_start"]
    assert options.items() <= record["settings"].items() and record["settings"]["learning_rate"] > 0
    assert record["table_sha256"] != record["valid_sha256"] and len(record["table_sha256"]) == 64
    assert [entry["step"] for entry in record["history"]] == [2.0]


def test_nothing_in_a_run_is_pickled(tmp_path: Path) -> None:
    """Pickles, zipped or not, begin with their own bytes; every file here is of a format that holds no code."""
    run_recipe(
        "steady", load_program(NEURAL), simulated(rows=6), None, tmp_path / "run",
        options={"guide": "bootstrap", "particles": 10, "draws": 2, "steps": 2},
    )  # fmt: skip
    files = contents(tmp_path / "run")
    assert files.keys() == FILES | {"checkpoint.safetensors"}
    assert files["posterior.nc"].startswith(b"\x89HDF\r\n\x1a\n")
    json.loads(files["run.json"])
    for name, content in files.items():
        assert not content.startswith((b"\x80", b"PK"))
        if name.endswith(".safetensors"):
            assert load_file(tmp_path / "run" / name)


def test_the_posterior_of_the_training_drives_opens_with_names_and_units(tmp_path: Path) -> None:
    data = simulated(rows=6)
    fitted().save(tmp_path / "run", train=data)
    posterior = arviz.from_netcdf(tmp_path / "run" / "posterior.nc")
    states = posterior["posterior"]
    assert states["heading"].dims == ("chain", "draw", "trajectory", "row")
    assert states["trajectory"].values.tolist() == ["1", "2", "3"]
    assert states["acceleration_channel"].values.tolist() == ["forward", "lateral", "yaw"]
    assert (states["x"].attrs["units"], states["yaw_rate"].attrs["units"]) == ("m", "rad/s")
    assert posterior["constant_data"]["control_left"].attrs["units"] == "N"
    assert states.attrs["program"] == "Hovercraft"


def test_without_training_drives_no_posterior_is_written(tmp_path: Path) -> None:
    fitted().save(tmp_path / "run")
    assert contents(tmp_path / "run").keys() == FILES - {"posterior.nc"}


def test_a_run_is_not_overwritten_unless_forced(tmp_path: Path) -> None:
    fitted().save(tmp_path / "run", train=simulated(rows=4))
    before = contents(tmp_path)
    with pytest.raises(RunError, match="run exists"):
        fitted().save(tmp_path / "run")
    assert contents(tmp_path) == before
    fitted().save(tmp_path / "run", force=True)
    assert contents(tmp_path / "run").keys() == FILES - {"posterior.nc"}


def test_a_folder_that_cannot_be_made_is_an_error_of_the_run(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(RunError, match="cannot be written"):
        fitted().save(tmp_path / "file" / "run")


# --- the program's file -----------------------------------------------------------------------------------------------


def test_run_and_program_move_together(tmp_path: Path, copy: Path) -> None:
    (tmp_path / "a" / "models").mkdir(parents=True)
    file = Path(shutil.move(copy, tmp_path / "a" / "models"))
    fit = fitted(load_program(file))
    fit.save(tmp_path / "a" / "runs" / "one")
    (tmp_path / "a").rename(tmp_path / "b")
    assert torch.equal(Fit.load(tmp_path / "b/runs/one").program.mass, fit.program.mass)


def test_a_run_saved_and_read_by_relative_paths_is_found_from_anywhere(tmp_path: Path, monkeypatch, copy: Path) -> None:
    monkeypatch.chdir(tmp_path)
    fitted(load_program("hovercraft.py")).save("runs/one")
    assert json.loads(Path("runs/one/run.json").read_text())["program"]["file"] == os.path.join(
        "..", "..", "hovercraft.py"
    )
    monkeypatch.chdir(tmp_path / "runs")
    Fit.load("one")


def test_a_program_reached_through_a_link_is_found_again(tmp_path: Path, monkeypatch, copy: Path) -> None:
    (tmp_path / "deep" / "down").mkdir(parents=True)
    shutil.move(copy, tmp_path / "deep" / "down")
    (tmp_path / "link").symlink_to(tmp_path / "deep" / "down")
    monkeypatch.chdir(tmp_path / "link")
    fitted(load_program("hovercraft.py")).save("run")
    monkeypatch.chdir(tmp_path)
    Fit.load("link/run")
    Fit.load("deep/down/run")


def test_a_program_that_is_gone_is_asked_for(tmp_path: Path, copy: Path) -> None:
    fit = fitted(load_program(copy))
    fit.save(tmp_path / "run")
    moved = copy.rename(tmp_path / "boat.py")
    with pytest.raises(RunError, match=r"hovercraft\.py is gone: name it with --program PATH"):
        Fit.load(tmp_path / "run")
    for program in (f"{moved}:Hovercraft", load_program(HOVERCRAFT)):
        assert torch.equal(Fit.load(tmp_path / "run", program).program.mass, fit.program.mass)


def test_a_program_that_changed_is_refused_until_it_is_named(tmp_path: Path, copy: Path) -> None:
    fitted(load_program(copy)).save(tmp_path / "run")
    copy.write_text(copy.read_text() + "# a remark\n")
    with pytest.raises(RunError, match=r"hovercraft\.py changed since the fit"):
        Fit.load(tmp_path / "run")
    Fit.load(tmp_path / "run", copy)


def test_parameters_that_do_not_fit_the_program_are_named(tmp_path: Path, copy: Path) -> None:
    fitted(load_program(copy)).save(tmp_path / "run")
    changes = (
        ("self.mass", "self.weight", "mass_unconstrained, weight_unconstrained"),
        ("tensor([0.2, 0.2, 0.1])", "tensor(0.2)", "noise_unconstrained"),
    )
    for old, new, named in changes:
        copy.write_text(HOVERCRAFT.read_text().replace(old, new))
        with pytest.raises(RunError, match=f"do not fit model Hovercraft: {named}"):
            Fit.load(tmp_path / "run", copy)


def test_loading_another_program_of_the_folder_does_not_make_a_run_forget_its_own(tmp_path: Path, copy: Path) -> None:
    """As when the recipe, or the hand-written program to compare with, lies beside the program."""
    program = load_program(copy)
    (tmp_path / "boat.py").write_text(HOVERCRAFT.read_text())
    load_program(f"{tmp_path / 'boat.py'}:Hovercraft")
    fitted(program).save(tmp_path / "run")
    assert json.loads((tmp_path / "run/run.json").read_text())["program"]["class"] == "Hovercraft"
    Fit.load(tmp_path / "run")


class Sloop(type(example("hovercraft"))):
    """A program of a file that was imported, not loaded by path."""


def test_a_class_of_an_imported_file_is_found_again(tmp_path: Path) -> None:
    fit = fitted(Sloop())
    fit.save(tmp_path / "run")
    again = Fit.load(tmp_path / "run")
    assert type(again.program).__name__ == "Sloop" and torch.equal(again.program.mass, fit.program.mass)


def test_a_class_without_a_file_must_be_given_again(tmp_path: Path) -> None:
    names = {"Hovercraft": type(example("hovercraft"))}
    exec("class Dinghy(Hovercraft): pass", names)
    fit = fitted(names["Dinghy"]())
    fit.save(tmp_path / "run")
    assert json.loads((tmp_path / "run/run.json").read_text())["program"] is None
    with pytest.raises(RunError, match="came from no file"):
        Fit.load(tmp_path / "run")
    assert torch.equal(Fit.load(tmp_path / "run", names["Dinghy"]()).program.mass, fit.program.mass)


def test_a_class_inside_a_function_must_be_given_again(tmp_path: Path) -> None:
    class Raft(type(example("hovercraft"))):
        pass

    fit = fitted(Raft())
    fit.save(tmp_path / "run")
    with pytest.raises(SteadyError) as caught:
        Fit.load(tmp_path / "run")
    assert "program" in str(caught.value)
    assert torch.equal(Fit.load(tmp_path / "run", Raft()).program.mass, fit.program.mass)


# --- damage -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keep", [0, 5, 100, -1])
def test_parameters_cut_short_are_damaged(tmp_path: Path, keep: int) -> None:
    fitted().save(tmp_path / "run")
    file = tmp_path / "run" / "parameters.safetensors"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(RunError, match=r"parameters\.safetensors in .*run is damaged") as caught:
        Fit.load(tmp_path / "run")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "",
        '{"program": ',
        pytest.param("[]"),
        pytest.param("{}"),
        '{"program": null}',
        pytest.param("null"),
    ],
)
def test_a_damaged_record_is_an_error_of_the_run(tmp_path: Path, text: str) -> None:
    fitted().save(tmp_path / "run")
    (tmp_path / "run" / "run.json").write_text(text)
    with pytest.raises(RunError, match=r"run") as caught:
        Fit.load(tmp_path / "run")
    assert "\n" not in str(caught.value)


def test_what_is_no_run_is_an_error_of_the_run(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(RunError, match=r"is not a run: it has no run\.json"):
            Fit.load(folder)
    fitted().save(tmp_path / "run")
    (tmp_path / "run" / "parameters.safetensors").unlink()
    with pytest.raises(RunError, match=r"no file parameters\.safetensors in"):
        Fit.load(tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize("keep", [0, 50, -1])
def test_a_checkpoint_cut_short_is_damaged_and_says_so_in_one_line(tmp_path: Path, capsys, keep: int) -> None:
    run = tmp_path / "run"
    few = ("--guide", "bootstrap", "--particles", 10, "--steps", 2)
    command = ("fit", HOVERCRAFT, written(tmp_path / "t.csv"), *few, "--out", run)
    assert steady(*command) == 0
    file = run / "checkpoint.safetensors"
    file.write_bytes(file.read_bytes()[:keep])
    capsys.readouterr()
    assert steady(*command, "--resume") == 2
    assert capsys.readouterr().err.startswith("steady: checkpoint.safetensors in ")
    Fit.load(run)  # the finished run is still there


def test_a_failure_while_writing_leaves_no_torn_file(tmp_path: Path, monkeypatch) -> None:
    """What was written before is whole, and what was not is not there."""
    fitted().save(tmp_path / "run")
    before = contents(tmp_path)

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises((OSError, RunError)):
        fitted().save_into(tmp_path / "run")
    monkeypatch.undo()
    assert {name: content for name, content in contents(tmp_path).items() if name in before} == before
    Fit.load(tmp_path / "run")


def test_a_table_goes_through_parquet_and_csv_to_the_same_run(tmp_path: Path) -> None:
    runs = []
    for name in ("t.csv", "t.parquet"):
        write_table(simulated(rows=6), tmp_path / name)
        run = tmp_path / f"run.{name}"
        few = ("--guide", "bootstrap", "--particles", 10, "--draws", 2, "--steps", 2)
        assert steady("fit", HOVERCRAFT, tmp_path / name, *few, "--out", run) == 0
        runs.append(run)
    records = [json.loads((run / "run.json").read_text()) for run in runs]
    assert records[0]["table_sha256"] == records[1]["table_sha256"]
    assert (runs[0] / "parameters.safetensors").read_bytes() == (runs[1] / "parameters.safetensors").read_bytes()


def test_a_program_named_wrongly_is_an_error_of_the_program(tmp_path: Path) -> None:
    fitted().save(tmp_path / "run")
    with pytest.raises(ProgramError, match="no file"):
        Fit.load(tmp_path / "run", tmp_path / "nowhere.py")


def test_what_the_drives_determine_is_saved_and_read_and_its_damage_is_told(tmp_path: Path) -> None:
    matrix = torch.tensor([[4.0, 1.0], [1.0, 3.0]]).double()
    known = ParameterInformation(("mass", "inertia"), matrix, 0.25, frozenset(["a", "b"]))
    replace(fitted(), information=known).save(tmp_path / "run")
    again = Fit.load(tmp_path / "run").information
    assert again is not None and torch.equal(again.matrix, matrix)
    assert (again.names, again.gain, again.drives) == (known.names, known.gain, known.drives)
    file = tmp_path / "run" / "information.safetensors"
    for text in ({}, {"names": "[]", "gain": "NaN", "drives": "[]"}, {"names": '"ab"', "gain": "0", "drives": "[]"}):
        write_tensors(file, {"matrix": matrix}, text)
        with pytest.raises(RunError, match=r"information\.safetensors in .* is damaged"):
            Fit.load(tmp_path / "run")


def test_a_training_that_is_gone_on_with_leaves_nothing_of_what_was_known(tmp_path: Path) -> None:
    known = ParameterInformation(("mass",), torch.eye(1).double(), 0.0, frozenset())
    (tmp_path / "run").mkdir()
    replace(fitted(), information=known).save_into(tmp_path / "run")
    fitted().save_into(tmp_path / "run")
    assert Fit.load(tmp_path / "run").information is None
