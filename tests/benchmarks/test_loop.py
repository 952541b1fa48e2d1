"""What the benchmark of the loop measures, and the table that it makes."""

from __future__ import annotations

import os
from pathlib import Path

import loop
import pytest
from loop_steps import STEPS, Step, cases, sized, words_of


def runs(*seconds: float, said: str = "found") -> list[dict]:
    return [{"wall": wall, "cpu": wall / 2, "peak": 100.0, "said": said} for wall in seconds]


def record(step: str, **engines: list[dict] | str) -> dict:
    return {"set": f"16x101 {step}", "commits": {"new": "a", "old": "b"}, "runs": engines}


def test_a_size_is_drives_and_rows() -> None:
    assert sized("64x301").arguments[1:] == ("64", "301") and sized("64x301").name == "64x301"
    for wrong in ("64", "x301", "0x101", "16x1", "16x101x2"):
        with pytest.raises(SystemExit, match="a size is DRIVESxROWS"):
            sized(wrong)


def test_a_case_whose_data_are_absent_says_so(tmp_path: Path) -> None:
    assert {case.name: case.is_absent for case in cases(tmp_path)} == {"boat": False, "truck": True, "mrclam": True}
    (tmp_path / "cases" / "mrclam").mkdir(parents=True)
    assert {case.name for case in cases(tmp_path) if case.is_absent} == {"truck"}


def test_every_step_can_be_run_and_what_it_needs_makes_a_run() -> None:
    for case in (sized("16x101"), *cases(Path())):
        for step in case.steps:
            assert set(STEPS[step].needs) <= set(case.steps)
            assert all(STEPS[need].makes for need in STEPS[step].needs)
            assert not any("{" in word for word in words_of(STEPS[step], case, 3)[2:])
    boat = cases(Path())[0]
    assert words_of(STEPS["fit"], boat, 3)[-5:] == ["--seed", "3", "--force", "--out", "before"]
    assert "--known-start" in words_of(STEPS["fit"], sized("16x101"), 3)
    assert words_of(Step("of its own", "{program}", "pass"), boat, 3) == ["-c", "pass", boat.program]


def test_a_process_is_measured_and_its_fault_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    environ = loop.environment(tmp_path, tmp_path)
    assert "OMP_NUM_THREADS" not in environ and environ["PYTHONPATH"] == str(tmp_path)
    source = "import time; kept = b'1' * 2**26; time.sleep(.05); print('one\\n two')"
    found = loop.measured(["-c", source], tmp_path, environ)
    assert found["said"] == "one two" and found["wall"] > 0.05 and found["cpu"] > 0 and 64 < found["peak"] < 2000
    part = loop.measured(["-c", """print('{"wall": 5, "cpu": 4}')"""], tmp_path, environ)
    assert (part["wall"], part["cpu"]) == (5, 4) and 0 < part["process"] < 5
    with pytest.raises(RuntimeError, match="exit code 1: nothing to add"):
        loop.measured(["-c", "import sys; sys.exit('nothing to add')"], tmp_path, environ)


def test_busy_loops_end_with_the_block() -> None:
    with loop.busy(2) as ids:
        os.kill(ids[0], 0)
        os.kill(ids[1], 0)
    for number in ids:
        with pytest.raises(ProcessLookupError):
            os.kill(number, 0)


def test_a_row_has_the_cold_run_the_median_of_the_warm_ones_and_ratios_old_to_new() -> None:
    new, old = runs(8, 1, 2, 9), runs(4, 3, 3, 3)
    assert loop.row(record("fit", new=new)) == "| 16x101 | fit by likelihood | 8.00 (4.00) | 2.00 (1.00) | 100 |"
    ratios = " | 0.50 | 0.50 | 1.50 | 1.50 | 1.00 | "
    assert loop.row(record("fit", new=new, old=old)).endswith(f"100{ratios} |")
    assert loop.row(record("fit", new=new, old=runs(4, 3, said="none"))).endswith(f"100{ratios}other words |")
    assert loop.row(record("fit", new=new, old="no such option")).endswith("100 | old: no such option |")
    assert loop.row(record("fit", new=runs(8))).count("8.00 (4.00)") == 2  # no warm run
    assert loop.row({"set": "16x101 fit", "failed": "why"}) == "| 16x101 | fit by likelihood | why |"


def test_a_table_has_what_was_skipped() -> None:
    text = loop.table([record("help", new=runs(8, 1), old=runs(8, 1))], ["truck is skipped."], True, 2)
    assert text.startswith("Commits: new a, old b; 2 busy loops beside") and text.endswith("\n\ntruck is skipped.\n")
    assert "| old/new: cold | cold CPU | warm | warm CPU | peak | says |" in text
