"""Other people's files: a run folder brings no code along, leads nowhere else, and says nothing to the terminal."""

from __future__ import annotations

import ast
import hashlib
import json
import os
from pathlib import Path

import pytest
from small import HIDDEN, HOVERCRAFT, contents, steady, written

import steady_ppl as st
from steady_ppl.utils.files import hidden_beside

PACKAGE = Path(st.__file__).parent
PAYLOAD = "from pathlib import Path\nPath({mark!r}).touch()\n"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run whose program is the checkout's."""
    assert (
        steady("fit", HOVERCRAFT, written(tmp_path / "train.csv"), "--recipe", "hand", "--out", tmp_path / "run") == 0
    )
    return tmp_path / "run"


def payload(file: Path, mark: Path) -> Path:
    """A program that works, and leaves a mark when it is executed."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(HOVERCRAFT.read_text() + "\n" + PAYLOAD.format(mark=str(mark)))
    return file


def rerecorded(run: Path, **changes: object) -> None:
    record = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps({**record, **changes}))


def named(run: Path, file: Path, name: str | None = None) -> None:
    """Let a run's record name a file as its program."""
    source = {"class": "Hovercraft", "file": name or os.path.relpath(file, run)}
    rerecorded(run, program={**source, "sha256": hashlib.sha256(file.read_bytes()).hexdigest()})


def commands(run: Path, table: Path, out: Path) -> list[tuple]:
    return [
        ("check", run, table),
        ("evaluate", run, table),
        ("prove", run, run.with_name("again"), table),
        ("report", run, table, "--out", out / "page.html"),
        ("states", run, table, "--out", out / "states.csv"),
        ("discover", run, table),
        ("add", run, "--out", out / "added.py"),
    ]


def test_a_run_of_a_newer_version_says_so_to_every_command(run, tmp_path, capsys):
    table = tmp_path / "train.csv"
    assert json.loads((run / "run.json").read_text())["format"] == 1
    rerecorded(run, format=2, status=["what it would be then"])
    every = [*commands(run, table, tmp_path), ("fit", HOVERCRAFT, table, "--out", run, "--resume")]
    (run / "checkpoint.safetensors").touch()
    for command in every:
        assert steady(*command) == 2
        said = capsys.readouterr().err
        assert "newer steady-ppl" in said and "number 2" in said and "up to 1" in said, command
    assert not list(tmp_path.glob("*.html")) and not list(tmp_path.glob("added.py"))


@pytest.mark.slow
@pytest.mark.parametrize("place", ["run/mine.py", "run/deep/mine.py", "other/mine.py"])
def test_no_command_executes_a_program_that_came_with_a_run(tmp_path: Path, capsys, run: Path, place: str) -> None:
    mark, file = tmp_path / "executed", payload(tmp_path / place, tmp_path / "executed")
    if place.startswith("other"):  # another run folder beside this one
        (tmp_path / "other" / "run.json").write_text("{}")
    named(run, file)
    before = contents(tmp_path)
    for command in commands(run, tmp_path / "train.csv", tmp_path):
        assert steady(*command) == 2, command
        assert "nothing that comes with one is executed" in capsys.readouterr().err
    assert not mark.exists() and contents(tmp_path) == before


def test_links_and_detours_into_a_run_are_seen_through(tmp_path: Path, run: Path) -> None:
    mark, file = tmp_path / "executed", payload(tmp_path / "run" / "mine.py", tmp_path / "executed")
    (tmp_path / "outside.py").symlink_to(file)
    (tmp_path / "door").symlink_to(run)
    for name in ("../outside.py", "../door/mine.py", str(file), str(tmp_path / "outside.py"), "../run/../run/mine.py"):
        named(run, file, name)
        for opened in (run, tmp_path / "door"):
            with pytest.raises(st.RunError, match="nothing that comes with one is executed"):
                st.Fit.load(opened)
    assert not mark.exists()


def test_a_program_that_came_with_a_run_is_executed_where_the_person_names_it(tmp_path: Path, run: Path) -> None:
    mark, file = tmp_path / "executed", payload(tmp_path / "run" / "mine.py", tmp_path / "executed")
    named(run, file)
    assert st.Fit.load(run, f"{file}:Hovercraft").recipe == "hand" and mark.exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    "program",
    [
        {"class": "/../run/mine.py:Hovercraft", "file": "../own.py"},
        {"class": "Hovercraft", "file": "../own\0.py"},
        {"class": "Hovercraft", "file": 3},
        {"class": None, "file": "../own.py"},
        {"file": "../own.py"},
        "../own.py",
        ["../own.py"],
    ],
    ids=["path in class", "zero", "number", "no class", "class missing", "text", "list"],
)
def test_a_record_that_names_its_program_strangely_is_damaged(tmp_path: Path, run: Path, program) -> None:
    own = payload(tmp_path / "own.py", tmp_path / "executed")
    payload(run / "mine.py", tmp_path / "executed")
    if isinstance(program, dict):
        program = {"sha256": hashlib.sha256(own.read_bytes()).hexdigest(), **program}
    rerecorded(run, program=program)
    with pytest.raises(st.RunError, match=r"run\.json is damaged: (it does not say which model|program)"):
        st.Fit.load(run)
    assert not (tmp_path / "executed").exists()


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["__import__('os').system('true')", "wind:__import__=1:x", "linear_drag:x=(1,2)"])
def test_effects_of_a_record_are_names_of_the_catalogue(run: Path, effect: str) -> None:
    rerecorded(run, effects=[effect])
    with pytest.raises(st.UsageError, match="effect|coefficient"):
        st.Fit.load(run)


# --- links ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["previous", "journal"])
def test_overwriting_a_run_removes_nothing_behind_a_link(tmp_path: Path, refused, run: Path, name: str) -> None:
    other = tmp_path / "precious"
    assert steady("fit", HOVERCRAFT, tmp_path / "train.csv", "--recipe", "hand", "--out", other) == 0
    (run / name).symlink_to(other)
    refused(2, "is a link", "fit", HOVERCRAFT, tmp_path / "train.csv", "--recipe", "hand", "--out", run, "--force")


def test_a_file_of_a_run_that_is_a_link_is_replaced_not_written_through(tmp_path: Path, run: Path) -> None:
    precious = tmp_path / "precious.txt"
    precious.write_text("kept")
    for name in ("run.json", "parameters.safetensors", hidden_beside(Path("run.json")).name):
        (run / name).unlink(missing_ok=True)
        (run / name).symlink_to(precious)
    assert steady("fit", HOVERCRAFT, tmp_path / "train.csv", "--recipe", "hand", "--out", run, "--force") == 0
    assert precious.read_text() == "kept" and not (run / "run.json").is_symlink()


def test_a_lock_that_is_a_link_is_not_followed(tmp_path: Path, run: Path) -> None:
    precious = tmp_path / "precious.txt"
    precious.write_text("kept")
    (run / ".lock").symlink_to(precious)
    steady("fit", HOVERCRAFT, tmp_path / "train.csv", "--recipe", "hand", "--out", run, "--force")
    assert precious.read_text() == "kept"


# --- the terminal -----------------------------------------------------------------------------------------------------


def test_a_terminal_is_told_nothing_by_names(tmp_path: Path, capsys) -> None:
    text = written(tmp_path / "plain.csv").read_text().replace("\n0,", f"\nfirst{HIDDEN},").replace("\r", "")
    table = tmp_path / "table.csv"
    table.write_text(text.replace("\n1,", f"\n{HIDDEN},"), newline="")
    run = tmp_path / "run"
    assert steady("fit", HOVERCRAFT, table, "--recipe", "hand", "--out", run) in (0, 2)
    steady("fit", HOVERCRAFT, tmp_path / "plain.csv", "--recipe", "hand", "--out", run, "--force")
    rerecorded(run, notes=[f"note {HIDDEN}"], recipe=f"hand{HIDDEN}")
    for command in commands(run, table, tmp_path):
        steady(*command)
    steady("check", tmp_path / f"no{HIDDEN}", table)
    steady("check", run, tmp_path / f"no{HIDDEN}.csv", "--debug")
    said = "".join(capsys.readouterr())
    assert not set(said) & (set(HIDDEN) - set("[2J]0;owned31m")), said
    assert "\\x1b[2J" in said


def test_nothing_else_prints() -> None:
    """One place to look at: what prints in another way would have to be made printable again."""
    for file in sorted(PACKAGE.rglob("*.py")):
        calls = [n for n in ast.walk(ast.parse(file.read_text())) if isinstance(n, ast.Call)]
        prints = [c.lineno for c in calls if isinstance(c.func, ast.Name) and c.func.id == "print"]
        writes = [
            c.lineno for c in calls if ast.unparse(c.func) in ("sys.stdout.write", "sys.stderr.write", "typer.echo")
        ]
        place = file.relative_to(PACKAGE).as_posix()
        assert not writes and (not prints or place in ("utils/text.py", "cli/progress.py")), (file, prints, writes)
