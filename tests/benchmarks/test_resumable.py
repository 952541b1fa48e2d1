"""A benchmark's records: what is done stays, what failed is tried again, another source's are refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import resumable


def counted(place: Path, number: int) -> dict:
    """Fails the first time for odd numbers; leaves a mark each time that it is run."""
    marks = place / f"{number}"
    times = int(marks.read_text()) if marks.exists() else 0
    marks.write_text(str(times + 1))
    if number % 2 and not times:
        raise ValueError("odd")
    return {"square": number**2}


def test_a_job_that_is_done_is_not_run_again_and_one_that_failed_is(tmp_path: Path) -> None:
    file = tmp_path / "results" / "records.jsonl"
    jobs = {str(number): (tmp_path, number) for number in range(4)}
    first = resumable.run(counted, jobs, file, version="a", said=lambda record: f"{record['square']}")
    assert {r["set"]: r.get("square", r.get("failed")) for r in first} == {
        "0": 0,
        "1": "ValueError: odd",
        "2": 4,
        "3": "ValueError: odd",
    }
    again = resumable.run(counted, jobs, file, version="a")
    assert {r["set"]: r["square"] for r in again} == {"0": 0, "1": 1, "2": 4, "3": 9}
    assert [(tmp_path / name).read_text() for name in jobs] == ["1", "2", "1", "2"]
    assert len(file.read_text().splitlines()) == 6
    few = resumable.run(counted, {"2": (tmp_path, 2)}, file, version="a")
    assert few == [{"set": "2", "version": "a", "square": 4}]


def test_a_record_that_was_cut_off_is_run_again(tmp_path: Path) -> None:
    file = tmp_path / "records.jsonl"
    resumable.run(counted, {"0": (tmp_path, 0), "2": (tmp_path, 2)}, file, version="a", workers=1)
    file.write_text(file.read_text()[:-5])
    again = resumable.run(counted, {"0": (tmp_path, 0), "2": (tmp_path, 2)}, file, version="a")
    assert {r["set"]: r["square"] for r in again} == {"0": 0, "2": 4}
    assert (tmp_path / "0").read_text() == "1" and (tmp_path / "2").read_text() == "2"
    assert [json.loads(line)["set"] for line in file.read_text().splitlines()] == ["0", "2"]


def test_records_of_another_source_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "records.jsonl"
    file.write_text(json.dumps({"set": "1", "version": "a"}) + "\n")
    with pytest.raises(SystemExit, match=r"another version of the source \(a\): move it away"):
        resumable.run(counted, {}, file, version="b")


@pytest.mark.slow
def test_a_digest_is_of_what_is_imported_and_of_files(tmp_path: Path) -> None:
    file = tmp_path / "settings.py"
    file.write_text("1")
    room = Path(resumable.__file__).parent
    before = resumable.digest(room, files=[file])
    assert before == resumable.digest(room, files=[file]) != resumable.digest(files=[file])
    file.write_text("2")
    assert before != resumable.digest(room, files=[file])
