"""Cases of other people's data: what they are asked for, from what commands said."""

from __future__ import annotations

from pathlib import Path

import others
import pytest
from small import MODELS, simulated, written

EFFECT = {"effect": "cubic_stiffness", "coefficient": [3.6], "interval_90": [[3.4, 3.9]]}
NOISE = {"effect": "measurement_noise", "coefficient": [0.4], "interval_90": [[0.3, 0.5]]}


@pytest.mark.parametrize(
    ("effects", "met"),
    [
        ([EFFECT], [True, True]),
        ([EFFECT, NOISE | {"correction": True}], [True, True]),
        ([EFFECT, NOISE], [True, False]),
        ([], [False, True]),
    ],
)
def test_a_spring_is_asked_for_and_no_noise_but_as_a_correction(effects: list[dict], met: list[bool]) -> None:
    asked = list(others.CASES["silverbox"].asked({"discover": {"effects": effects}}))
    assert [one.is_met for one in asked] == met
    assert not met[0] or asked[0].value == "3.6 [3.4, 3.9]"


def test_progress_is_no_answer() -> None:
    said = "steady: scoring steps … 2 min gone by, about 4 min left steady: finding paths … 14 s gone by steady: done"
    assert others.PROGRESS.sub("", said) == "steady: done"


@pytest.mark.exhaustive
def test_commands_run_in_the_folder_of_a_case_and_one_that_fails_is_no_answer(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "cart").mkdir()
    (tmp_path / "cart" / "cart.py").write_text((MODELS / "linear_gaussian.py").read_text())
    written(tmp_path / "cart" / "train.csv", simulated("linear_gaussian", trajectories=2, rows=9))

    def asked(said):
        yield others.Asked("a damping", said["fit"], "damping=" in said["fit"])
        yield others.Asked("no such file", said["missing"], "no such file" in said["missing"])
        yield others.Asked("what never ran", said["never"], True)

    commands = {"fit": "fit cart.py {train} --recipe hand --out {out}/fit", "missing": "check {out}/fit none.csv"}
    monkeypatch.setitem(others.CASES, "cart", others.Case(commands | {"never": "effects cart.py"}, asked))
    record = others.work("cart", str(tmp_path), 50) | {"set": "cart"}
    assert [one["is_met"] for one in record["asked"]] == [False] and "'never'" in record["asked"][0]["value"]
    assert set(record["cost"]) == {"fit"} and record["cost"]["fit"]["peak"] > 50
    assert "| cart | an answer |" in others.page([record]) and "| **no** |" in others.page([record])
