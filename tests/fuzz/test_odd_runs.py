"""Odd run folders by hand: records, parameters, checkpoints and discoveries of another form are refused in a line."""

from __future__ import annotations

import json
import os
import shutil
import struct
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from examples import MODELS
from record_mutants import at, places
from report_pages import FOUND, two_run_report
from small import FEW, steady

import steady_ppl as st
from steady_ppl.discovery.result import read_discovery
from steady_ppl.errors import RunError
from steady_ppl.utils.tensor_files import read_tensors, write_tensors

CART = MODELS / "linear_gaussian.py"


@pytest.fixture
def copy(tmp_path: Path, cart_run: Path) -> Path:
    """Of the cart's run, which names its program from where it now lies."""
    place = tmp_path / "run"
    shutil.copytree(cart_run, place)
    record = json.loads((place / "run.json").read_text())
    record["program"]["file"] = os.path.relpath(CART, place)
    (place / "run.json").write_text(json.dumps(record))
    return place


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda record: record.update(program=3), "program is 3, expected names and values"),
        (lambda record: record["program"].pop("class"), "program has no class"),
        (lambda record: record.update(seed=-1), "seed is -1, expected a whole number"),
        (lambda record: record.update(notes=[None]), "notes[0] is None, expected text"),
        (lambda record: record.update(effects="wind"), "effects is 'wind', expected a list"),
        (lambda record: record.pop("history"), "it has no history"),
        (lambda record: record.update(recipe=["\x1b[2J"]), "recipe is "),
    ],
)
def test_a_record_of_another_form_is_refused(copy: Path, table: Path, refused, change, says: str) -> None:
    record = json.loads((copy / "run.json").read_text())
    change(record)
    (copy / "run.json").write_text(json.dumps(record))
    refused(2, says, "evaluate", copy, table)


@pytest.mark.parametrize("text", ["[" * 100_000, "", "3", "\ud83d", '{"a": ' + "9" * 10_000 + "}"])
def test_a_record_that_is_no_json_is_refused(copy: Path, table: Path, refused, text: str) -> None:
    (copy / "run.json").write_bytes(text.encode(errors="surrogatepass"))
    refused(2, "run.json is damaged", "evaluate", copy, table)


def test_parameters_of_which_a_bit_has_turned_are_refused(copy: Path, table: Path, refused) -> None:
    file = copy / "parameters.safetensors"
    good = file.read_bytes()
    file.write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
    refused(2, "its numbers are not those that were written", "evaluate", copy, table)
    file.write_bytes(struct.pack("<Q", 2**63) + good[8:])
    refused(2, "is damaged", "evaluate", copy, table)


def test_parameters_that_are_not_finite_are_refused(tmp_path: Path, cart_run: Path) -> None:
    fit = st.Fit.load(cart_run)
    with torch.no_grad():
        next(fit.program.parameters()).fill_(torch.nan)
    fit.save(tmp_path / "run")
    with pytest.raises(RunError, match="are not finite: fit again"):
        st.Fit.load(tmp_path / "run")


def test_a_run_in_which_a_folder_takes_a_files_place_is_not_overwritten(copy: Path, table: Path, refused) -> None:
    (copy / "run.json").unlink()
    (copy / "run.json").mkdir()
    refused(2, "run.json is a folder", "fit", CART, table, "--recipe", "hand", "--force", "--out", copy)


def test_a_checkpoint_of_another_form_is_refused(tmp_path: Path, table: Path, refused) -> None:
    run = tmp_path / "run"
    assert steady("fit", CART, table, *FEW, "--out", run) == 0
    tensors, text = read_tensors(run / "checkpoint.safetensors")
    resumed = ("fit", CART, table, *FEW, "--out", run, "--resume")
    slot = next(name for name in tensors if name.startswith("optimizer/") and tensors[name].dim() == 0)
    for other, said, says in (
        ({"odd/name": torch.zeros(1)}, {}, "no checkpoint has odd/name"),
        ({slot.replace("/0/", "/77/"): torch.zeros(1)}, {}, "the optimiser has no"),
        ({"averaged/gain": torch.zeros(7)}, {}, "the averaged parameters are others"),
        ({}, {"step": '"one"'}, "step is 'one', expected a whole number"),
        ({}, {"history": "{"}, "is no JSON"),
    ):
        write_tensors(run / "checkpoint.safetensors", tensors | other, text | said)
        refused(2, says, *resumed)


def test_a_discovery_of_another_form_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "found.json"
    said = FOUND | {"candidates": [], "effects": []}
    for change, says in (
        ({}, None),
        ({"candidates": [3]}, "candidates[0] is 3, expected names and values"),
        ({"doubts": None}, "doubts is None, expected a list"),
        ({"shape": {"channel": "yaw"}}, "shape has no variable"),
    ):
        file.write_text(json.dumps(said | change))
        if says is None:
            assert read_discovery(file) == said
            continue
        with pytest.raises(RunError) as caught:
            read_discovery(file)
        assert says in str(caught.value)


WIND = {"effect": "wind", "coefficient": [1.0, -0.5]}
ALONE = {"sd": [0.1, 0.2], "detection_limit": [0.3, 0.6], "heldout_gain_ci": [1.0, 3.0]}
FULL = FOUND | {
    "doubts": ["a doubt"],
    "effects": [*FOUND["effects"], FOUND["effects"][0] | WIND | {"interval_90": [[0.8, 1.2], [-0.9, -0.1]]}],
    "candidates": [*FOUND["candidates"], FOUND["candidates"][0] | WIND | ALONE],
    "shape": {"channel": "yaw", "variable": "speed", "points": [0, 1], "curve": [0, 2], "band": [0.1, 0.1]},
    "next_run": {"between": ["wind", "drag"], "way": "round", "separation": 3.0, "usual": 1.0},
}
ANY_LENGTH = ("candidates", "effects", "class", "doubts", "notes", "between", "detection_limit")


LISTS = [place for place in places(FULL) if isinstance(at(FULL, place), list)]


@pytest.mark.slow
@pytest.mark.parametrize("place", [pytest.param(place, id=".".join(map(str, place))) for place in LISTS])
@pytest.mark.parametrize("longer", [False, True])
def test_a_list_of_another_length_is_refused_or_shown(tmp_path: Path, place: tuple[Any, ...], longer: bool) -> None:
    found, file = deepcopy(FULL), tmp_path / "found.json"
    part = at(found, place)
    part.append(part[-1]) if longer else part.pop()
    file.write_text(json.dumps(found))
    if place[-1] in ANY_LENGTH:
        assert read_discovery(file) == found
        assert replace(two_run_report(), discovery=found).html
    else:
        with pytest.raises(
            RunError, match=r"is not what `steady discover` writes: (candidates|effects|shape)"
        ) as caught:
            read_discovery(file)
        assert "\n" not in str(caught.value)
