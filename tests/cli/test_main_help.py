"""The command line as a person meets it: help in one screen, examples that parse, quiet, JSON, completion."""

from __future__ import annotations

import json
import shlex
import tomllib
from pathlib import Path

import pytest
import typer
from small import TRUTH, steady, written

from steady_ppl.cli import main as command_line
from steady_ppl.cli.main import app, main

LINES, COLUMNS = 24, 80


@pytest.fixture(autouse=True)
def _narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    monkeypatch.setenv("TERMINAL_WIDTH", str(COLUMNS))


def test_help_fits_one_screen_and_cuts_no_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert steady("--help") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= LINES and max(map(len, lines)) <= COLUMNS
    assert not any(line.endswith("...") for line in lines if "ARGS" not in line)
    assert all(any(one.short_help in line for line in lines) or one.hidden for one in app.registered_commands)


@pytest.mark.parametrize("command", app.registered_commands, ids=lambda command: command.name)
def test_every_command_has_examples_that_parse(command, capsys: pytest.CaptureFixture[str]) -> None:
    name = command.name
    assert steady(name, "--help") == 0
    said = capsys.readouterr().out
    parser = typer.main.get_command(app).commands[name]
    examples = [line.removeprefix("  ") for line in command.epilog.splitlines()[2:]]
    assert examples and all(line in said for line in examples)
    for example in "\n".join(examples).replace("\\\n", " ").splitlines():
        program, found, *words = shlex.split(example.partition(" | ")[0])
        assert (program, found) == ("steady", name)
        words = [word for word in words[: (*words, ">").index(">")] if word not in command_line.GLOBAL_OPTIONS]
        parser.make_context(name, words)


def test_the_example_of_a_log_parses(capsys: pytest.CaptureFixture[str]) -> None:
    assert steady("data", "alpha-truck", "--help") == 0
    assert "steady data alpha-truck alpha_truck/train --out train.csv" in capsys.readouterr().out


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert steady("--version") == 0
    said = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]["version"]
    assert capsys.readouterr().out == f"steady-ppl {said}\n"


def test_nothing_is_coloured(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (("--help",), ("fit", "--help"), ("fit",), ("nonsense",)):
        steady(*words)
    said = capsys.readouterr()
    assert "\x1b" not in said.out + said.err


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    assert (
        steady("fit", TRUTH, written(folder / "t.csv"), "--recipe", "hand", "--known-start", "--out", folder / "r") == 0
    )
    return folder


@pytest.mark.slow
def test_json_can_be_printed_and_then_nothing_else_is(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert steady("check", run / "r", run / "t.csv", "--simulations", 20, "--json", "-") == 0
    assert json.loads(capsys.readouterr().out)["program"] == "HovercraftTruth"
    assert steady("evaluate", run / "r", run / "t.csv", "--rollouts", 2, "--particles", 20, "--json", "-") == 0
    assert json.loads(capsys.readouterr().out)["runs"][0]["recipe"] == "hand"


@pytest.mark.slow
def test_quiet_says_results_and_errors_but_no_notes(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("simulate", TRUTH, "--effect", "yaw_bias", "--trajectories", 2, "--out", run / "biased.csv")
    capsys.readouterr()
    assert steady(*words) == 0
    assert "yaw_bias = 0.04 rad/s² (typical)" in capsys.readouterr().err
    for quiet in ("-q", "--quiet"):
        assert steady(*words, quiet) == 0 and steady(quiet, *words) == 0
    assert capsys.readouterr() == ("", "")
    assert steady("check", run / "r", run / "nowhere.csv", "--quiet") == 2
    assert "there is no such file" in capsys.readouterr().err


def test_the_mask_and_the_figures_are_different_files(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    same = run / "same.csv"
    assert steady("check", run / "r", run / "t.csv", "--mask", same, "--json", same) == 2
    assert "name another file" in capsys.readouterr().err and not same.exists()


def test_words_are_completed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("_STEADY_COMPLETE", "complete_bash")
    for words, expected in (("steady pro", ["prove"]), ("steady fit --recipe fit-t", ["fit-tv", "fit-truth"])):
        monkeypatch.setenv("COMP_WORDS", words)
        monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
        with pytest.raises(SystemExit):
            main([])
        assert capsys.readouterr().out.split() == expected
