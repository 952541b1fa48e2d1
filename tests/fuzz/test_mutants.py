"""A good file is spoiled, and every command that takes it: done, or a line that says why not, and nothing left behind.

pytest tests/fuzz                                             a few mutants of every file, through quick commands
pytest tests/fuzz -m slow                                     every change of every file, through every command
pytest tests/fuzz -m "slow or not slow" --hypothesis-profile long       as many as the profile says, others each time
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import pytest
import torch
from good_files import CART, FEW, HOVER, SEARCH, TRAINING, Desk
from hypothesis import event, given, settings, strategies as st
from mutants import BYTES, Change, Mutant
from record_mutants import JSON, RECORD, TENSORS
from small import steady
from table_mutants import LOGS, PARQUET, TABLE
from text_mutants import DEFINITION, TOML, spellings
from trying import is_long, tried

Words = tuple[str, ...]
CUT = {name: BYTES[name] for name in ("cut short", "a block lost", "a block twice", "empty", "a pipe", "junk")}


class Kind(NamedTuple):
    """A file that is spoiled, the changes that make sense of it, and the commands that take it."""

    file: str
    changes: Mapping[str, Change]
    commands: tuple[Words, ...]
    searched: bool = False  # whether it is of a search or a study

    def __repr__(self) -> str:
        return self.file


def on_table(table: str, program: str, run: str, *others: str) -> tuple[Words, ...]:
    """Every command that takes a table, with settings that make it short."""
    few = ("--guide", "bootstrap", "--particles", "20", "--draws", "3", "--steps", "2")
    return (
        ("fit", program, table, *few, "--out", "out/run"),
        ("fit", program, table, "--recipe", "likelihood", "--out", "out/run"),
        ("check", run, table, "--simulations", "20", "--json", "out/check.json", "--mask", "out/mask.csv"),
        ("evaluate", run, table, "--particles", "20", "--rollouts", "5", "--json", "out/errors.json"),
        ("states", run, table, "--draws", "3", "--particles", "20", "--out", "out/states.csv"),
        ("prove", run, *others, table, "--json", "out/proof.json"),
        ("report", run, *others, table, "--simulations", "20", "--out", "out/page.html"),
        ("simulate", program, "--controls", table, "--out", "out/again.csv"),
        ("data", "cut", table, "--seconds", "0.4", "--out", "out/cut.csv"),
    )


def on_run(run: str) -> tuple[Words, ...]:
    """Every command that takes a run."""
    return (
        ("check", run, "t.csv", "--simulations", "20", "--json", "out/check.json"),
        ("evaluate", run, "after", "t.csv", "--particles", "20", "--rollouts", "5"),
        ("states", run, "t.csv", "--draws", "3", "--particles", "20", "--out", "out/states.nc"),
        ("prove", "after", "t.csv", "--oracle", run, "--json", "out/proof.json"),
        ("discover", run, "t.csv", "--valid", "v.csv", "--simulations", "50", "--json", "out/found.json"),
        ("report", "after", run, "t.csv", "--simulations", "20", "--out", "out/page.html"),
        ("add", run, "stiffness=0.1", "--out", "models/stiff.py"),
        ("fit", CART, "t.csv", "--recipe", "hand", "--force", "--out", run),
    )


def on_bag(bag: str) -> tuple[Words, ...]:
    """A bag read, and listed."""
    return ("import-bag", bag, "mapping.toml", "--out", "out/drives.csv"), ("import-bag", bag)


MORE_OF_CART: tuple[Words, ...] = (
    ("fit", CART, "v.csv", "--valid", "t.csv", *FEW, "--out", "out/run"),
    ("fit", CART, "t.csv", "--recipe", "svi", "--steps", "2", "--out", "out/run"),
    ("fit", CART, "t.csv", "--recipe", "fit-truth", "--steps", "2", "--out", "out/run"),
    (*SEARCH, "out/run"),
    ("discover", "before", "v.csv", "--valid", "t.csv", "--simulations", "50", "--out", "out/run"),
)
PARQUETS: tuple[Words, ...] = (
    ("fit", CART, "t.parquet", "--recipe", "hand", "--out", "out/run"),
    ("check", "before", "t.parquet", "--simulations", "20", "--json", "out/check.json"),
    ("states", "before", "t.parquet", "--draws", "3", "--particles", "20", "--out", "out/states.parquet"),
)
KNOWN_START: Words = ("fit", HOVER, "h.csv", "--known-start", *FEW, "--out", "out/run")
RESUMED: Words = (*TRAINING, "begun", "--resume")
SEARCHED: Words = (*SEARCH, "searched", "--resume")
SHOWN: Words = (
    *("report", "before", "t.csv", "--discovery", "found.json"),
    "--simulations",
    "20",
    "--out",
    "out/p.html",
)
STUDY: Words = ("study", "study.toml", "--workers", "1", "--out")
STUDIED: tuple[Words, ...] = ((*STUDY, "studied"), ("plot-study", "studied", "--out", "out/study.png"))
LOG: Words = ("data", "alpha-truck", "logs", "--out", "out/logs.csv")
PROGRAM: tuple[Words, ...] = (
    ("simulate", CART, "--trajectories", "2", "--out", "out/drives.csv"),
    ("effects", CART),
    ("fit", CART, "t.csv", "--recipe", "hand", "--out", "out/run"),
    ("check", "before", "t.csv", "--simulations", "20", "--program", CART),
)
KINDS = (
    Kind("t.csv", TABLE | BYTES, (*on_table("t.csv", CART, "before", "after"), *MORE_OF_CART)),
    Kind("h.csv", TABLE, (*on_table("h.csv", HOVER, "hover", "hover_too"), KNOWN_START)),
    Kind("t.parquet", PARQUET | BYTES, PARQUETS),
    Kind("before/run.json", RECORD | BYTES, on_run("before")),
    Kind("before/parameters.safetensors", TENSORS | BYTES, on_run("before")),
    Kind("before/posterior.nc", BYTES, on_run("before")),
    Kind("begun/checkpoint.safetensors", TENSORS | BYTES, (RESUMED,)),
    Kind("begun/run.json", JSON, (RESUMED,)),
    Kind("searched/journal/000001.safetensors", TENSORS | BYTES, (SEARCHED,)),
    Kind("searched/run.json", JSON, (SEARCHED,)),
    Kind("found.json", JSON | BYTES, (SHOWN,), True),
    Kind("found/discovery.json", JSON, on_run("found"), True),
    Kind("ros1.bag", BYTES, on_bag("ros1.bag")),
    Kind("sqlite/sqlite.db3", BYTES, on_bag("sqlite")),
    Kind("mcap/mcap.mcap", BYTES, on_bag("mcap")),
    Kind("mcap_file.mcap", BYTES, on_bag("mcap_file.mcap")),
    Kind("sqlite/metadata.yaml", BYTES, on_bag("sqlite")),
    Kind("mapping.toml", TOML | BYTES, on_bag("mcap_file.mcap")[:1]),
    Kind("boat_msgs/msg/Battery.msg", DEFINITION | BYTES, on_bag("mcap_file.mcap")[:1]),
    Kind("logs/vrpn-pose.csv", LOGS | BYTES, (LOG,)),
    Kind("logs/vesc_drive.csv", LOGS | BYTES, (LOG,)),
    Kind("study.toml", TOML | BYTES, ((*STUDY, "out/study"),), True),
    Kind("studied/study.json", JSON | BYTES, STUDIED, True),
    Kind("studied/results.parquet", PARQUET | BYTES, STUDIED, True),
    Kind(CART, CUT, PROGRAM),
)
ALL = {words for kind in KINDS for words in kind.commands}


def few(count: int) -> settings:
    """As many examples; as many as the profile says where one is named."""
    asked = settings.default.max_examples
    return settings(max_examples=count if settings.get_current_profile_name() == "repeated" else asked)


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Desk]:
    """On one thread: a child that is forked from several waits for the others, which it has not."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield Desk(tmp_path_factory.mktemp("fuzz"))
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def full_desk(desk: Desk) -> Desk:
    desk.add_searches()
    return desk


def warm(desk: Desk, words: Words, done: set[Words] = set()) -> None:  # noqa: B006
    """The command on good files first: what is imported and compiled then is not the mutant's fault."""
    if words not in done:
        with contextlib.chdir(desk.place):
            assert steady(*words) == 0, words
        desk.tidy()
        done.add(words)


def spoil(desk: Desk, kind: Kind, data: st.DataObject, how: str, words: Words) -> None:
    """Spoil a file, run a command, and see that nothing is wrong."""
    content = (desk.good / kind.file).read_bytes()
    warm(desk, words)
    mutant = Mutant(how, kind.changes[how](data.draw, content))
    mutant.lay(desk.place / kind.file)
    ending, wrong = tried(desk, words)
    event(f"{kind.file}: exit code {ending.code}")
    assert wrong == [], f"{wrong}: steady {' '.join(words)}, {mutant}\n{ending.error[-2000:]}"


def drawn(data: st.DataObject, kind: Kind, quick: bool) -> Words:
    return data.draw(st.sampled_from([words for words in kind.commands if not (quick and is_long(words))]), "command")


def quick(kind: Kind) -> list[Words]:
    """The commands that end at once."""
    return [words for words in kind.commands if not is_long(words) or "--resume" in words]


QUICK = [kind for kind in KINDS if quick(kind) and not kind.searched]
ONCE = [
    pytest.param(kind, how, kind.commands[i % len(kind.commands)], id=f"{kind.file}-{how}")
    for kind in KINDS
    for i, how in enumerate(kind.changes)
]


@pytest.mark.parametrize("kind", QUICK, ids=str)
@few(8)
@given(data=st.data())
def test_a_spoiled_file_is_read_or_refused_in_a_line(desk: Desk, kind: Kind, data: st.DataObject) -> None:
    how = data.draw(st.sampled_from(sorted(kind.changes)), "change")
    spoil(desk, kind, data, how, data.draw(st.sampled_from(quick(kind)), "command"))


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "how", "words"), ONCE)
@few(2)
@given(data=st.data())
def test_every_change_of_every_file(full_desk: Desk, kind: Kind, how: str, words: Words, data: st.DataObject) -> None:
    spoil(full_desk, kind, data, how, words)


@few(40)
@given(data=st.data())
def test_a_misspelt_command_is_done_or_refused_in_a_line(desk: Desk, data: st.DataObject) -> None:
    words = data.draw(spellings(data.draw(st.sampled_from([*PROGRAM, *on_run("before")]), "command")))
    ending, wrong = tried(desk, words, strict=False)
    assert wrong == [], f"{wrong}: steady {words}\n{ending.error[-2000:]}"
