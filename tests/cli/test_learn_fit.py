"""`steady fit` end to end, interrupted and resumed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from small import FEW, HOVERCRAFT, QUICK, contents, impossible, simulated, steady, without_progress, written

from steady_ppl import Fit, SMCGuide
from steady_ppl.runs.folder import run_folder

# --- fit --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("recipe", "options"),
    [("steady", FEW), ("hand", ()), ("fit-truth", ("--steps", 3))],
    ids=["steady", "hand", "truth"],
)
def test_fit_leaves_a_run_that_names_its_recipe(tmp_path: Path, work: Path, capsys, recipe: str, options) -> None:
    run = tmp_path / "runs" / "first"
    tables = (work / "train.csv", "--valid", work / "valid.parquet")
    assert steady("fit", HOVERCRAFT, *tables, "--recipe", recipe, *options, "--seed", 4, "--out", run) == 0
    assert capsys.readouterr().out.startswith(f"{run}: Hovercraft(mass=1.")
    record = json.loads((run / "run.json").read_text())
    assert (record["recipe"], record["status"], record["seed"]) == (recipe, "finished", 4)
    expected = {"parameters.safetensors", "posterior.nc", "run.json"}
    expected |= {"checkpoint.safetensors"} if options else set()
    assert set(contents(run)) == expected | ({"information.safetensors"} if recipe == "steady" else set())


def test_fit_tells_the_held_out_likelihood(tmp_path: Path, work: Path, capsys) -> None:
    tables = (work / "train.csv", "--valid", work / "valid.parquet")
    assert steady("fit", HOVERCRAFT, *tables, *FEW, "--out", tmp_path / "run") == 0
    (entry,) = json.loads((tmp_path / "run/run.json").read_text())["history"]
    assert f"held-out log p(y) of a trajectory {entry['log_likelihood']:.2f} → " in capsys.readouterr().out


def test_fit_says_that_nothing_is_held_out(tmp_path: Path, work: Path, capsys) -> None:
    assert steady("fit", HOVERCRAFT, work / "train.csv", *FEW, "--out", tmp_path / "run") == 0
    assert "\nsteady: no --valid table" in capsys.readouterr().err


def test_fit_accepts_the_guide_by_name(tmp_path: Path, work: Path) -> None:
    assert steady("fit", HOVERCRAFT, work / "train.csv", "--guide", "bootstrap", *FEW, "--out", tmp_path / "run") == 0


@pytest.mark.slow
def test_the_seed_decides_a_networks_first_weights_and_the_whole_fit(tmp_path: Path) -> None:
    program = f"{HOVERCRAFT.with_name('neural_vehicle.py')}:NeuralHovercraft"
    table = written(tmp_path / "t.csv", simulated(trajectories=2, rows=4))
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert steady("fit", program, table, *FEW, "--seed", seed, "--out", tmp_path / name) == 0
    a, b, c = ((tmp_path / name / "parameters.safetensors").read_bytes() for name in "abc")
    assert a == b != c


def test_force_overwrites_a_run_and_leaves_nothing_of_the_old_one(tmp_path: Path, work: Path) -> None:
    run = tmp_path / "run"
    assert steady("fit", HOVERCRAFT, work / "train.csv", *FEW, "--out", run) == 0
    assert steady("fit", HOVERCRAFT, work / "train.csv", "--recipe", "hand", "--force", "--out", run) == 0
    assert set(contents(run)) == {"parameters.safetensors", "posterior.nc", "run.json"}
    assert json.loads((run / "run.json").read_text())["recipe"] == "hand"


def test_a_forced_fit_that_fails_gives_the_old_run_back(tmp_path: Path, work: Path, refused) -> None:
    run, table = tmp_path / "run", written(tmp_path / "t.csv", impossible(simulated(), trajectory=1, row=3))
    assert steady("fit", HOVERCRAFT, work / "train.csv", *FEW, "--out", run) == 0
    refused(1, "every particle's weight is zero", "fit", HOVERCRAFT, table, *FEW, "--force", "--out", run)


def test_a_forced_fit_that_was_killed_leaves_the_old_run_to_the_next(tmp_path: Path, work: Path, refused) -> None:
    run = tmp_path / "run"
    assert steady("fit", HOVERCRAFT, work / "train.csv", "--recipe", "hand", "--out", run) == 0
    old = contents(run)
    with run_folder(run, force=True):
        assert contents(run / "previous") == old
        (run / "run.json").write_text("new")
    assert contents(run) == {"run.json": b"new"}
    (run / "previous").mkdir()  # as a kill leaves it
    for name, content in old.items():
        (run / "previous" / name).write_bytes(content)
        (run / name).write_text("half")
    table = written(tmp_path / "t.csv", impossible(simulated(), trajectory=1, row=3))
    assert steady("fit", HOVERCRAFT, table, *FEW, "--force", "--out", run) == 1
    assert contents(run) == old


def test_any_setting_of_a_recipe_can_be_set(tmp_path: Path, work: Path) -> None:
    run = tmp_path / "run"
    chosen = ("--set", "ramp=0.5", "--set", "betas=(0.8, 0.9)", "--set", "learning_rate=2e-2")
    assert steady("fit", HOVERCRAFT, work / "train.csv", *FEW, *chosen, "--out", run) == 0
    settings = json.loads((run / "run.json").read_text())["settings"]
    assert (settings["ramp"], settings["betas"], settings["learning_rate"]) == (0.5, [0.8, 0.9], 0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pair", "says"),
    [
        ("ramp", "expected NAME=VALUE"),
        ("=1", "expected NAME=VALUE"),
        ("pramp=1", "has no setting pramp; it has guide, particles"),
        ("particles=5", "particles is given twice"),
        ("seed=5", "has no setting seed"),
    ],
)
def test_a_setting_that_there_is_not_is_refused(tmp_path: Path, refused, pair: str, says: str) -> None:
    table = written(tmp_path / "t.csv")
    refused(2, says, "fit", HOVERCRAFT, table, *FEW, "--set", pair, "--out", tmp_path / "run")


def test_without_a_terminal_every_validation_is_a_line(tmp_path: Path, work: Path, capsys) -> None:
    tables = (work / "train.csv", "--valid", work / "valid.parquet")
    assert steady("fit", HOVERCRAFT, *tables, *FEW, "--set", "validate_every=2", "--out", tmp_path / "run") == 0
    first, last, *_ = capsys.readouterr().err.splitlines()
    assert first.startswith("step 2 of 3: loss ") and last.startswith("step 3 of 3: loss ")
    assert "ess" in first and "roots" in first and "log p(y)" in first


@pytest.mark.slow
def test_a_fit_in_a_shell_says_its_result_and_nothing_else(tmp_path: Path, work: Path) -> None:
    command = ("fit", HOVERCRAFT, work / "train.csv", "--recipe", "hand", "--out", tmp_path / "run")
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}  # where arviz notes that it has announced itself
    program = (sys.executable, "-m", "steady_ppl.cli.main")
    done = subprocess.run([*program, *command], capture_output=True, text=True, check=False, env=environment)
    assert (done.returncode, without_progress(done.stderr)) == (0, [])
    assert done.stdout == f"{tmp_path / 'run'}: Hovercraft(mass=1.5, inertia=1.5, noise=[0.2, 0.2, 0.1])\n"


# --- interrupted and resumed ------------------------------------------------------------------------------------------

LONGER = ("--guide", "bootstrap", "--particles", 20, "--draws", 3, "--steps", 26)


@pytest.fixture
def ctrl_c(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Makes the E step that is given by its number end in Ctrl-C, from now on."""
    refresh = SMCGuide.refresh

    def arm(at: int) -> None:
        count = iter(range(1_000_000))

        def interrupted(self, data, progress: float) -> dict[str, float]:
            if next(count) == at:
                raise KeyboardInterrupt
            return refresh(self, data, progress)

        monkeypatch.setattr(SMCGuide, "refresh", interrupted)

    return arm


def figures(run: Path) -> dict[str, object]:
    """What two equal runs have in common: their parameters bit for bit and the record, places apart."""
    record = json.loads((run / "run.json").read_text())
    record["program"].pop("file")
    record["command"] = record["command"].replace(str(run), "RUN")
    return {"parameters": (run / "parameters.safetensors").read_bytes(), "record": record}


@pytest.mark.slow
def test_an_interrupted_run_is_usable_and_resumes_to_the_uninterrupted_one(tmp_path: Path, capsys, ctrl_c) -> None:
    table, valid = written(tmp_path / "t.csv"), written(tmp_path / "v.csv", simulated(seed=1))
    run, whole = tmp_path / "run", tmp_path / "whole"
    neural = f"{HOVERCRAFT.with_name('neural_vehicle.py')}:NeuralHovercraft"
    command = ("fit", neural, table, "--valid", valid, *LONGER)
    assert steady(*command, "--out", whole) == 0
    ctrl_c(25)
    assert steady(*command, "--out", run) == 1
    assert "interrupted" in capsys.readouterr().err
    assert json.loads((run / "run.json").read_text())["status"] == "interrupted"
    assert steady("evaluate", run, valid, *QUICK) == 0
    ctrl_c(1_000_000)
    assert steady(*command, "--resume", "--out", run) == 0
    assert figures(run) == figures(whole)


@pytest.mark.slow
def test_a_run_interrupted_twice_stays_usable(tmp_path: Path, capsys, ctrl_c) -> None:
    command = ("fit", HOVERCRAFT, written(tmp_path / "t.csv"), *FEW, "--out", tmp_path / "run")
    ctrl_c(1)
    assert steady(*command) == 1
    ctrl_c(0)
    assert steady(*command, "--resume") == 1
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "interrupted"
    Fit.load(tmp_path / "run")


@pytest.mark.slow
def test_a_run_interrupted_before_its_first_checkpoint_can_be_resumed(tmp_path: Path, capsys, ctrl_c) -> None:
    command = ("fit", HOVERCRAFT, written(tmp_path / "t.csv"), *FEW[:-1], 5)
    assert steady(*command, "--out", tmp_path / "whole") == 0
    ctrl_c(3)
    assert steady(*command, "--out", tmp_path / "run") == 1
    assert "--resume" in capsys.readouterr().err
    ctrl_c(1_000_000)
    assert steady(*command, "--resume", "--out", tmp_path / "run") == 0
    assert figures(tmp_path / "run") == figures(tmp_path / "whole")


def test_ctrl_c_before_the_training_leaves_no_run(tmp_path: Path, monkeypatch, refused) -> None:
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("steady_ppl.Program.prepare", interrupted)
    table = written(tmp_path / "t.csv")
    refused(1, "interrupted", "fit", HOVERCRAFT, table, *FEW, "--out", tmp_path / "run")


def test_a_run_killed_outright_is_refused_in_one_line_and_resumes(tmp_path: Path, refused, ctrl_c) -> None:
    run, table = tmp_path / "run", written(tmp_path / "t.csv")
    ctrl_c(1)
    assert steady("fit", HOVERCRAFT, table, *FEW, "--out", run) == 1
    record = json.loads((run / "run.json").read_text())
    begun = {key: value for key, value in record.items() if key not in ("settings", "history", "notes", "kept_step")}
    (run / "run.json").write_text(json.dumps({**begun, "status": "training"}))  # as after a power cut while resuming
    refused(2, "run", "evaluate", run, table)
    (run / "parameters.safetensors").unlink()  # as after a power cut in the first training
    refused(2, "run", "evaluate", run, table)
    ctrl_c(1_000_000)
    assert steady("fit", HOVERCRAFT, table, *FEW, "--resume", "--out", run) == 0
    assert json.loads((run / "run.json").read_text())["status"] == "finished"


@pytest.mark.slow
def test_resume_needs_the_same_everything(tmp_path: Path, refused) -> None:
    table, other = written(tmp_path / "t.csv"), written(tmp_path / "o.csv", simulated(seed=9))
    program, run = tmp_path / "hovercraft.py", tmp_path / "run"
    program.write_text(HOVERCRAFT.read_text())
    assert steady("fit", program, table, "--valid", table, *FEW, "--out", run) == 0

    def resume(says: str, model=program, train=table, valid=("--valid", table), options=FEW) -> None:
        refused(2, f"the same {says}", "fit", model, train, *valid, *options, "--resume", "--out", run)

    resume("options", options=(*FEW[:-1], 9))
    resume("options", options=FEW[:-2])
    resume("training table", train=other)
    resume("--valid table", valid=("--valid", other))
    resume("--valid table", valid=())
    resume("seed", options=(*FEW, "--seed", 1))
    resume("known_start", options=(*FEW, "--known-start"))
    resume("recipe", options=("--recipe", "fit-truth", "--steps", 3))
    resume("model", model=f"{program}:HovercraftTruth")
    program.write_text(program.read_text().replace("tensor(1.5)", "tensor(1.6)"))
    resume("model")


def test_a_recipe_that_keeps_no_checkpoint_cannot_be_resumed(work: Path, refused) -> None:
    command = ("fit", HOVERCRAFT, work / "train.csv", "--recipe", "hand", "--resume", "--out", work / "hand")
    refused(2, "no file checkpoint.safetensors", *command, folder=work)
