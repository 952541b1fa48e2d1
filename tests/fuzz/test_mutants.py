"""A good file is spoiled, and every command that takes it: done, or a line that says why not, and nothing left behind.

pytest tests/fuzz -m slow                                     a few mutants of every file, through quick commands
pytest tests/fuzz -m "slow or exhaustive"                     every change of every file, through a command each
pytest tests/fuzz -m "slow or not slow" --hypothesis-profile long       200 of each, others each time
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import pytest
import torch
from good_files import CART, FEW, HOVER, SEARCH, TRAINING, Desk
from hypothesis import event, given, settings, strategies as st
from mutants import BYTES, Change, lay
from record_mutants import JSON, RECORD, TENSORS
from small import steady
from table_mutants import LOGS, PARQUET, TABLE
from text_mutants import DEFINITION, TOML, spellings
from trying import is_long, tried

Words = tuple[str, ...]
LONG = settings.get_current_profile_name() == "long"
CUT = {name: BYTES[name] for name in ("cut short", "a block lost", "a block twice", "empty", "a pipe", "junk")}


class Kind(NamedTuple):
    """A file that is spoiled, the changes that make sense of it, and the commands that take it."""

    file: str
    changes: Mapping[str, Change]
    commands: tuple[Words, ...]
    searched: bool = False  # whether it is of a search or a study

    def __repr__(self) -> str:
        return self.file


def commands(text: str, **names: str) -> tuple[Words, ...]:
    """The words of a command a line; cart, hovercraft, few and search stand for what is long."""
    names |= {"cart": CART, "hovercraft": HOVER, "few": " ".join(FEW), "search": " ".join(SEARCH)}
    return tuple(tuple(line.format(**names).split()) for line in text.splitlines() if line)


ON_TABLE = """
fit {program} {table} --guide bootstrap --particles 20 --draws 3 --steps 2 --out out/run
fit {program} {table} --recipe likelihood --out out/run
check {run} {table} --simulations 20 --json out/check.json --mask out/mask.csv
evaluate {run} {table} --particles 20 --rollouts 5 --json out/errors.json
states {run} {table} --draws 3 --particles 20 --out out/states.csv
prove {run} {other} {table} --json out/proof.json
report {run} {other} {table} --simulations 20 --out out/page.html
simulate {program} --controls {table} --out out/again.csv
data cut {table} --seconds 0.4 --out out/cut.csv
"""
MORE_OF_CART = """
fit {cart} v.csv --valid t.csv {few} --out out/run
fit {cart} t.csv --recipe svi --steps 2 --out out/run
fit {cart} t.csv --recipe fit-truth --steps 2 --out out/run
{search} out/run
discover before v.csv --valid t.csv --simulations 50 --out out/run
"""
MORE_OF_HOVERCRAFT = "fit {hovercraft} h.csv --known-start {few} --out out/run"
ON_PARQUET = """
fit {cart} t.parquet --recipe hand --out out/run
check before t.parquet --simulations 20 --json out/check.json
states before t.parquet --draws 3 --particles 20 --out out/states.parquet
"""
ON_RUN = """
check {run} t.csv --simulations 20 --json out/check.json
evaluate {run} after t.csv --particles 20 --rollouts 5
states {run} t.csv --draws 3 --particles 20 --out out/states.nc
prove after t.csv --oracle {run} --json out/proof.json
discover {run} t.csv --valid v.csv --simulations 50 --json out/found.json
report after {run} t.csv --simulations 20 --out out/page.html
add {run} stiffness=0.1 --out models/stiff.py
fit {cart} t.csv --recipe hand --force --out {run}
"""
ON_BAG = """
import-bag {bag} mapping.toml --out out/drives.csv
import-bag {bag}
"""
ON_LOG = """
import-log {log} {mapping} --out out/drives.parquet
import-log {log}
"""
ON_STUDY = """
study study.toml --workers 1 --out studied
plot-study studied --out out/study.png
"""
ON_PROGRAM = """
simulate {cart} --trajectories 2 --out out/drives.csv
effects {cart}
fit {cart} t.csv --recipe hand --out out/run
check before t.csv --simulations 20 --program {cart}
"""
OF_CART = {"program": CART, "table": "t.csv", "run": "before", "other": "after"}
OF_HOVERCRAFT = {"program": HOVER, "table": "h.csv", "run": "hover", "other": "hover_too"}
SHOWN = commands("report before t.csv --discovery found.json --simulations 20 --out out/page.html")
SEARCHED = commands("{search} searched --resume")
CHECKED = commands("check after t.csv --simulations 20 --json out/check.json")
RESUMED: tuple[Words, ...] = ((*TRAINING, "begun", "--resume"),)
RUN, STUDIED, PROGRAM = commands(ON_RUN, run="before"), commands(ON_STUDY), commands(ON_PROGRAM)
MAPPED, LOG = commands(ON_BAG, bag="mcap_file.mcap")[:1], commands("data alpha-truck logs --out out/logs.csv")
KINDS = (
    Kind("t.csv", TABLE | BYTES, commands(ON_TABLE + MORE_OF_CART, **OF_CART)),
    Kind("h.csv", TABLE, commands(ON_TABLE + MORE_OF_HOVERCRAFT, **OF_HOVERCRAFT)),
    Kind("t.parquet", PARQUET | BYTES, commands(ON_PARQUET)),
    Kind("before/run.json", RECORD | BYTES, RUN),
    Kind("before/parameters.safetensors", TENSORS | BYTES, RUN),
    Kind("before/posterior.nc", BYTES, RUN),
    Kind("after/information.safetensors", TENSORS | BYTES, CHECKED),
    Kind("begun/checkpoint.safetensors", TENSORS | BYTES, RESUMED),
    Kind("begun/run.json", JSON, RESUMED),
    Kind("searched/journal/000001.safetensors", TENSORS | BYTES, SEARCHED),
    Kind("searched/run.json", JSON, SEARCHED),
    Kind("found.json", JSON | BYTES, SHOWN, True),
    Kind("found/discovery.json", JSON, commands(ON_RUN, run="found"), True),
    Kind("ros1.bag", BYTES, commands(ON_BAG, bag="ros1.bag")),
    Kind("sqlite/sqlite.db3", BYTES, commands(ON_BAG, bag="sqlite")),
    Kind("mcap/mcap.mcap", BYTES, commands(ON_BAG, bag="mcap")),
    Kind("mcap_file.mcap", BYTES, commands(ON_BAG, bag="mcap_file.mcap")),
    Kind("sqlite/metadata.yaml", BYTES, commands(ON_BAG, bag="sqlite")),
    Kind("px4.ulg", BYTES, commands(ON_LOG, log="px4.ulg", mapping="px4-rover")),
    Kind("ardupilot.bin", BYTES, commands(ON_LOG, log="ardupilot.bin", mapping="mine.toml")),
    Kind("mine.toml", TOML | BYTES, commands(ON_LOG, log="ardupilot.bin", mapping="mine.toml")[:1]),
    Kind("mapping.toml", TOML | BYTES, MAPPED),
    Kind("boat_msgs/msg/Battery.msg", DEFINITION | BYTES, MAPPED),
    Kind("logs/vrpn-pose.csv", LOGS | BYTES, LOG),
    Kind("logs/vesc_drive.csv", LOGS | BYTES, LOG),
    Kind("study.toml", TOML | BYTES, commands("study study.toml --workers 1 --out out/study"), True),
    Kind("studied/study.json", JSON | BYTES, STUDIED, True),
    Kind("studied/results.parquet", PARQUET | BYTES, STUDIED, True),
    Kind(CART, CUT, PROGRAM),
)


def few(count: int) -> settings:
    """As many examples; as many as the profile says where one is named."""
    return settings(max_examples=settings.default.max_examples if LONG else count)


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
    warm(desk, words)
    lay(desk.place / kind.file, kind.changes[how](data.draw, (desk.good / kind.file).read_bytes()))
    ending, wrong = tried(desk, words)
    event(f"{kind.file}: exit code {ending.code}")
    assert wrong == [], f"{wrong}: steady {' '.join(words)}: {ending.error[-2000:]}"


def quick(kind: Kind) -> list[Words]:
    """The commands that end at once."""
    return [words for words in kind.commands if not is_long(words) or "--resume" in words]


QUICK = [kind for kind in KINDS if quick(kind) and not kind.searched]


def once(kind: Kind, number: int, how: str) -> Words:
    """The command of a change, in turn; those that take minutes only where bytes are spoiled, which most refuse."""
    several = kind.commands if how in BYTES else quick(kind) or kind.commands
    return several[number % len(several)]


ONCE = [
    pytest.param(kind, how, once(kind, number, how), id=f"{kind.file}-{how}")
    for kind in KINDS
    for number, how in enumerate(kind.changes)
]


@pytest.mark.slow
@pytest.mark.parametrize("kind", QUICK, ids=str)
@few(2)
@given(data=st.data())
def test_a_spoiled_file_is_read_or_refused_in_a_line(desk: Desk, kind: Kind, data: st.DataObject) -> None:
    how = data.draw(st.sampled_from(sorted(kind.changes)), "change")
    spoil(desk, kind, data, how, data.draw(st.sampled_from(quick(kind)), "command"))


@pytest.mark.exhaustive
@pytest.mark.parametrize(("kind", "how", "words"), ONCE)
@few(2)
@given(data=st.data())
def test_every_change_of_every_file(full_desk: Desk, kind: Kind, how: str, words: Words, data: st.DataObject) -> None:
    spoil(full_desk, kind, data, how, data.draw(st.sampled_from(kind.commands), "command") if LONG else words)


@pytest.mark.slow
@few(40)
@given(data=st.data())
def test_a_misspelt_command_is_done_or_refused_in_a_line(desk: Desk, data: st.DataObject) -> None:
    words = data.draw(spellings(data.draw(st.sampled_from([*PROGRAM, *RUN]), "command")))
    ending, wrong = tried(desk, words, strict=False)
    assert wrong == [], f"{wrong}: steady {words}\n{ending.error[-2000:]}"
