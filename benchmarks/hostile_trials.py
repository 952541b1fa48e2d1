"""Which mutants there are, and through which commands each of them goes."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from random import Random

import hostile_parquet
import hostile_tables
from hostile_bags import DEFINITION, TOML, TOML_ONCE
from hostile_bytes import BYTES, WHOLE, Spoil
from hostile_desk import FEW, SEARCH, TRAINING
from hostile_json import JSON, JSON_ONCE, TENSORS, TENSORS_ONCE
from hostile_spelling import SPELT

CART, HOVER = "models/linear_gaussian.py", "models/hovercraft.py"
Commands = Mapping[str, tuple[str, ...]]


@dataclass(frozen=True)
class Trial:
    """A mutant and a command that is given it.

    Attributes:
        kind: of input, for the table.
        file: the one that is spoiled, or is replaced by what a mutation makes of it.
        mutation: its name.
        number: of the mutants of that mutation.
        command: the name of the command in the table.
        words: the command.
        spoil: what makes the mutant.
    """

    kind: str
    file: str
    mutation: str
    number: int
    command: str
    words: tuple[str, ...]
    spoil: Spoil

    @property
    def mutant(self) -> str:
        """Its name, from which it can be made again."""
        return f"{self.file} {self.mutation} {self.number}"

    @property
    def name(self) -> str:
        """Of the trial."""
        return f"{self.mutant}: {self.command}"

    def make(self, folder: Path) -> None:
        """Spoil the file in a folder of good ones; the same mutant for every command."""
        self.spoil(folder / self.file, Random(zlib.crc32(self.mutant.encode())))


def on_table(table: str, program: str, run: str, others: tuple[str, ...]) -> Commands:
    """Every command that takes a table, with settings that make it short."""
    few = ("--guide", "bootstrap", "--particles", "20", "--draws", "3", "--steps", "2")
    return {
        "fit": ("fit", program, table, *few, "--out", "out/run"),
        "fit --recipe likelihood": ("fit", program, table, "--recipe", "likelihood", "--out", "out/run"),
        "check": ("check", run, table, "--simulations", "20", "--json", "out/check.json", "--mask", "out/mask.csv"),
        "evaluate": ("evaluate", run, table, "--particles", "20", "--rollouts", "5", "--json", "out/errors.json"),
        "states": ("states", run, table, "--draws", "3", "--particles", "20", "--out", "out/states.csv"),
        "prove": ("prove", run, *others, table, "--json", "out/proof.json"),
        "report": ("report", run, *others, table, "--simulations", "20", "--out", "out/page.html"),
        "simulate": ("simulate", program, "--controls", table, "--out", "out/again.csv"),
        "data cut": ("data", "cut", table, "--seconds", "0.4", "--out", "out/cut.csv"),
    }


CART_TABLE: Commands = {
    **on_table("t.csv", CART, "before", ("after",)),
    "fit --valid": ("fit", CART, "v.csv", "--valid", "t.csv", *FEW, "--out", "out/run"),
    "fit --recipe svi": ("fit", CART, "t.csv", "--recipe", "svi", "--steps", "2", "--out", "out/run"),
    "fit --recipe fit-truth": ("fit", CART, "t.csv", "--recipe", "fit-truth", "--steps", "2", "--out", "out/run"),
    "discover": (*SEARCH, "out/run"),
    "discover --valid": ("discover", "before", "v.csv", "--valid", "t.csv", "--simulations", "50", "--out", "out/run"),
}
HOVER_TABLE: Commands = {
    **on_table("h.csv", HOVER, "hover", ("hover_too",)),
    "fit --known-start": ("fit", HOVER, "h.csv", "--known-start", *FEW, "--out", "out/run"),
}
PARQUET: Commands = {
    "fit": ("fit", CART, "t.parquet", "--recipe", "hand", "--out", "out/run"),
    "check": ("check", "before", "t.parquet", "--simulations", "20", "--json", "out/check.json"),
    "states": ("states", "before", "t.parquet", "--draws", "3", "--particles", "20", "--out", "out/states.parquet"),
}


def on_run(run: str) -> Commands:
    """Every command that takes a run."""
    return {
        "check": ("check", run, "t.csv", "--simulations", "20", "--json", "out/check.json"),
        "evaluate": ("evaluate", run, "after", "t.csv", "--particles", "20", "--rollouts", "5"),
        "states": ("states", run, "t.csv", "--draws", "3", "--particles", "20", "--out", "out/states.nc"),
        "prove": ("prove", "after", "t.csv", "--oracle", run, "--json", "out/proof.json"),
        "discover": ("discover", run, "t.csv", "--valid", "v.csv", "--simulations", "50", "--json", "out/found.json"),
        "report": ("report", "after", run, "t.csv", "--simulations", "20", "--out", "out/page.html"),
        "add": ("add", run, "stiffness=0.1", "--out", "models/stiff.py"),
        "fit --force": ("fit", CART, "t.csv", "--recipe", "hand", "--force", "--out", run),
    }


RESUMED: Commands = {"fit --resume": (*TRAINING, "begun", "--resume")}
SEARCHED: Commands = {"discover --resume": (*SEARCH, "searched", "--resume")}
SHOWN: Commands = {
    "report --discovery": (
        *("report", "before", "t.csv", "--discovery", "found.json", "--simulations", "20", "--out", "out/page.html"),
    )
}
REPORTED: Commands = {name: on_run("found")[name] for name in ("report", "add", "check")}
LOGS: Commands = {"data alpha-truck": ("data", "alpha-truck", "logs", "--out", "out/logs.csv")}
STUDY: Commands = {"study": ("study", "study.toml", "--workers", "1", "--out", "out/study")}
STUDIED: Commands = {
    "study, gone on with": ("study", "study.toml", "--workers", "1", "--out", "studied"),
    "plot-study": ("plot-study", "studied", "--out", "out/study.png"),
}
PROGRAM: Commands = {
    "simulate": ("simulate", CART, "--trajectories", "2", "--out", "out/drives.csv"),
    "effects": ("effects", CART),
    "fit": ("fit", CART, "t.csv", "--recipe", "hand", "--out", "out/run"),
    "check --program": ("check", "before", "t.csv", "--simulations", "20", "--program", CART),
}


def on_bag(bag: str) -> Commands:
    """A bag read, and listed."""
    return {
        "import-bag": ("import-bag", bag, "mapping.toml", "--out", "out/drives.csv"),
        "import-bag (listing)": ("import-bag", bag),
    }


def _mutants(often: Mapping[str, Spoil], once: Mapping[str, Spoil], times: int) -> Iterator[tuple[str, int, Spoil]]:
    yield from ((name, number, spoil) for name, spoil in often.items() for number in range(times))
    yield from ((name, 0, spoil) for name, spoil in once.items())


def _pairs(times: int) -> Iterator[tuple[str, int, Spoil]]:
    """Two changes of a table at once."""
    changes = {**hostile_tables.CHANGES, **hostile_tables.ONCE}
    names, dice = sorted(changes), Random(0)
    for number in range(times):
        first, second = dice.sample(names, 2)
        spoil = hostile_tables.in_table(hostile_tables.two(changes[first], changes[second]))
        yield f"{first}, {second}", number, spoil


def trials() -> list[Trial]:
    """All of them, in an order that is always the same."""
    cells = {name: hostile_tables.in_table(change) for name, change in hostile_tables.CHANGES.items()}
    whole = {name: hostile_tables.in_table(change) for name, change in hostile_tables.ONCE.items()}
    tables = {**whole, **SPELT, **WHOLE}
    found: list[Trial] = []

    def add(kind: str, file: str, commands: Commands, mutants: Iterator[tuple[str, int, Spoil]]) -> None:
        for mutation, number, spoil in mutants:
            found.extend(Trial(kind, file, mutation, number, name, words, spoil) for name, words in commands.items())

    searching = {name: words for name, words in CART_TABLE.items() if words[0] == "discover"}
    add("table, CSV", "t.csv", {k: v for k, v in CART_TABLE.items() if k not in searching}, _mutants({}, tables, 1))
    add("table, CSV", "t.csv", on_table("t.csv", CART, "before", ("after",)), _mutants({**cells, **BYTES}, {}, 2))
    add("table, CSV", "t.csv", on_table("t.csv", CART, "before", ("after",)), _pairs(15))
    add("table, CSV", "t.csv", searching, _mutants({}, WHOLE, 1))
    add("table, CSV", "t.csv", {"discover": CART_TABLE["discover"]}, _mutants({}, whole, 1))
    add("table, CSV", "h.csv", HOVER_TABLE, _mutants(cells, whole, 1))
    add(
        "table, Parquet",
        "t.parquet",
        PARQUET,
        _mutants({**hostile_parquet.KINDS, **BYTES}, {**hostile_parquet.ONCE, **WHOLE}, 2),
    )
    add("run.json", "before/run.json", on_run("before"), _mutants({**JSON, **BYTES}, {**JSON_ONCE, **WHOLE}, 2))
    tensors = {**TENSORS, **BYTES}
    add(
        "parameters", "before/parameters.safetensors", on_run("before"), _mutants(tensors, {**TENSORS_ONCE, **WHOLE}, 1)
    )
    add("posterior.nc", "before/posterior.nc", on_run("before"), _mutants({}, WHOLE, 1))
    add("checkpoint", "begun/checkpoint.safetensors", RESUMED, _mutants(tensors, {**TENSORS_ONCE, **WHOLE}, 4))
    add("run.json", "begun/run.json", RESUMED, _mutants(JSON, JSON_ONCE, 4))
    add("journal", "searched/journal/000001.safetensors", SEARCHED, _mutants(tensors, {**TENSORS_ONCE, **WHOLE}, 4))
    add("run.json", "searched/run.json", SEARCHED, _mutants(JSON, JSON_ONCE, 4))
    add("discovery.json", "found.json", SHOWN, _mutants({**JSON, **BYTES}, {**JSON_ONCE, **WHOLE}, 8))
    add("discovery.json", "found/discovery.json", REPORTED, _mutants(JSON, JSON_ONCE, 2))
    for bag, file in BAGS.items():
        add(f"bag, {bag}", file, on_bag(file if "/" not in file else file.partition("/")[0]), _mutants(BYTES, WHOLE, 5))
    add("bag, metadata.yaml", "sqlite/metadata.yaml", on_bag("sqlite"), _mutants(BYTES, WHOLE, 3))
    mapping = {"import-bag": on_bag("mcap_file.mcap")["import-bag"]}
    add("mapping, TOML", "mapping.toml", mapping, _mutants({**TOML, **BYTES}, {**TOML_ONCE, **WHOLE}, 12))
    add("definition, .msg", "boat_msgs/msg/Battery.msg", mapping, _mutants({**DEFINITION, **BYTES}, WHOLE, 6))
    for log in ("vrpn-pose.csv", "vesc_drive.csv"):
        add("logs, CSV", f"logs/{log}", LOGS, _mutants({**LOG_CELLS, **BYTES}, {**SPELT, **WHOLE}, 2))
    add("study, TOML", "study.toml", STUDY, _mutants({**TOML, **BYTES}, {**TOML_ONCE, **WHOLE}, 8))
    add("study, JSON", "studied/study.json", STUDIED, _mutants({**JSON, **BYTES}, {**JSON_ONCE, **WHOLE}, 4))
    columns = {**hostile_parquet.KINDS, **BYTES}
    results = _mutants(columns, {**hostile_parquet.ONCE, **WHOLE}, 2)
    add("study, results", "studied/results.parquet", STUDIED, results)
    add("program, Python", CART, PROGRAM, _mutants({name: BYTES[name] for name in CUTS}, WHOLE, 3))
    return found


BAGS = {"ROS 1": "ros1.bag", "sqlite": "sqlite/sqlite.db3", "MCAP": "mcap/mcap.mcap", "MCAP alone": "mcap_file.mcap"}
CUTS = ("cut short", "a block lost", "a block twice")
LOG_CELLS = {
    name: hostile_tables.in_table(hostile_tables.CHANGES[name])
    for name in ("a cell", "cells", "a column lost", "a row cut")
}
