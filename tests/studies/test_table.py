"""What is kept of a study: a row a job, whole and harmless."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from small_studies import row, written

from steady_ppl.errors import RunError
from steady_ppl.studies.executors import Local
from steady_ppl.studies.job import OUTDATED
from steady_ppl.studies.plan import STUDY_RECORD, read_plan, record_plan, recorded_plan
from steady_ppl.studies.runner import run_study
from steady_ppl.studies.table import ARRIVED, EARLIER, TABLE, StudyTable, read_results, study_table


def test_a_result_is_there_at_once_and_the_later_one_of_a_job_counts(tmp_path: Path):
    with study_table(tmp_path) as table:
        table.add(row("a", "failed", reason="no"))
        table.add(row("b", figure=2.0))
        assert set(read_results(tmp_path)["key"]) == {"a", "b"} and not (tmp_path / TABLE).exists()
        table.merge()
        table.add(row("a", figure=1.0))
        with pytest.raises(RunError, match="another process"), study_table(tmp_path):
            pass
    found = pd.read_parquet(tmp_path / TABLE).set_index("key")
    assert found["outcome"].to_dict() == {"a": "done", "b": "done"} and found["figure"].to_dict() == {
        "a": 1.0,
        "b": 2.0,
    }
    assert [file.name for file in tmp_path.iterdir()] == [TABLE]


def test_what_came_before_a_kill_is_not_lost(tmp_path: Path):
    (tmp_path / ARRIVED).mkdir()
    StudyTable(tmp_path).add(row("a"))  # nobody merges it
    with study_table(tmp_path) as table:
        table.add(row("b"))
    assert set(pd.read_parquet(tmp_path / TABLE)["key"]) == {"a", "b"}


def test_a_damaged_table_is_said(tmp_path: Path):
    (tmp_path / TABLE).write_bytes(b"PAR1 no")
    with pytest.raises(RunError, match="is damaged"):
        read_results(tmp_path)
    pd.DataFrame({"a": [1]}).to_parquet(tmp_path / TABLE)
    with pytest.raises(RunError, match="no table of a study"):
        read_results(tmp_path)


def test_a_column_of_several_kinds_is_text(tmp_path: Path):
    with study_table(tmp_path) as table:
        table.add(row("a", **{"settings.rate": 1, "settings.steps": 3}))
        table.add(row("b", **{"settings.rate": "auto", "settings.steps": 3.5}))
        table.add(row("c", **{"settings.rate": True}))
    found = pd.read_parquet(tmp_path / TABLE).set_index("key")
    assert found["settings.rate"].to_dict() == {"a": "1", "b": "auto", "c": "True"}
    assert found["settings.steps"].tolist()[:2] == [3.0, 3.5] and pd.isna(found.loc["c", "settings.steps"])


def test_a_setting_of_several_kinds_is_the_same_text_before_and_after_a_stop(tmp_path: Path):
    name = "settings.lag"
    for words in ({"a": 3, "b": None, "c": "auto"}, {"d": 3, "e": "auto"}):
        with study_table(tmp_path) as table:
            for key, value in words.items():
                table.add(row(key, **({} if value is None else {name: value})))
                table.merge()
    found = pd.read_parquet(tmp_path / TABLE).set_index("key")[name].dropna()
    assert found.to_dict() == {"a": "3", "c": "auto", "d": "3", "e": "auto"}


@pytest.mark.parametrize(
    "damage",
    [
        {"key": [[1]]},
        {"key": ["a"], "outcome": ["done"], "settings.a": [[1]]},
        {"key": ["a"], "outcome": [1]},
        {"outcome": ["done"]},
    ],
)
def test_a_table_of_other_columns_is_said(tmp_path: Path, damage: dict):
    pd.DataFrame(damage).to_parquet(tmp_path / TABLE)
    with pytest.raises(RunError, match="no table of a study"):
        read_results(tmp_path)


def test_text_that_is_none_and_foreign_metadata_are_said(tmp_path: Path):
    broken = pa.Array.from_buffers(pa.string(), 1, pa.array([b"\xff\xfe"]).buffers())
    pq.write_table(pa.table({"key": broken, "outcome": ["done"]}), tmp_path / TABLE)
    with pytest.raises(RunError, match="is damaged"):
        read_results(tmp_path)
    table = pa.table({"key": ["a"], "outcome": ["done"]}).replace_schema_metadata(
        {"pandas": '{"index_columns": ["z"]}'}
    )
    pq.write_table(table, tmp_path / TABLE)
    assert read_results(tmp_path)["key"].tolist() == ["a"]


def test_a_pipe_and_a_link_to_nothing_are_no_table(tmp_path: Path):
    (tmp_path / TABLE).symlink_to(tmp_path / "nothing")
    with pytest.raises(RunError, match="is damaged"):
        read_results(tmp_path)
    (tmp_path / TABLE).unlink()
    os.mkfifo(tmp_path / TABLE)
    with pytest.raises(RunError, match="is a pipe"):
        read_results(tmp_path)


def test_a_link_is_not_followed_and_what_is_not_the_studys_stays(tmp_path: Path):
    others, out = tmp_path / "others", tmp_path / "out"
    for folder in (others, out):
        folder.mkdir()
    pd.DataFrame([row("z")]).to_parquet(others / "mine.parquet")
    (out / ARRIVED).symlink_to(others)
    with pytest.raises(RunError, match="is a link"), study_table(out):
        pass
    (out / ARRIVED).unlink()
    (out / "begun").symlink_to(others)
    assert run_study(replace(read_plan(written(tmp_path)), jobs=()), out, Local(1)) == 0
    (out / ARRIVED).mkdir()
    (out / ARRIVED / "notes.txt").touch()
    with study_table(out) as table:
        table.add(row("a"))
    assert (out / ARRIVED / "notes.txt").exists() and (others / "mine.parquet").exists()


def test_a_damaged_record_and_one_of_a_newer_version_are_said(tmp_path: Path):
    record_plan(read_plan(written(tmp_path)), tmp_path)
    record = json.loads((tmp_path / STUDY_RECORD).read_text())
    assert recorded_plan(tmp_path) == read_plan(tmp_path / "study.toml")
    (tmp_path / STUDY_RECORD).write_text(json.dumps(record | {"picture": record["picture"] | {"y": []}}))
    with pytest.raises(RunError, match="damaged: picture.y has 0 columns"):
        recorded_plan(tmp_path)
    (tmp_path / STUDY_RECORD).write_text(json.dumps(record | {"format": 99}))
    with pytest.raises(RunError, match="written by a newer steady-ppl: its form is number 99"):
        recorded_plan(tmp_path)


def test_results_of_jobs_that_are_no_longer_asked_for_are_set_aside_and_come_back(tmp_path: Path):
    with study_table(tmp_path) as table:
        for key in "abc":
            table.add(row(key, figure=1.0))
        table.keep({"a", "d"})
        assert set(read_results(tmp_path)["key"]) == {"a"} and set(pd.read_parquet(tmp_path / EARLIER)["key"]) == {
            "b",
            "c",
        }
        table.add(row("b", figure=2.0))
        table.keep({"a", "b", "c"})
    found = pd.read_parquet(tmp_path / TABLE).set_index("key")["figure"].to_dict()
    assert found == {"a": 1.0, "b": 2.0, "c": 1.0}


def test_what_is_merged_while_it_is_read_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with study_table(tmp_path) as table:
        for key in "ab":
            table.add(row(key))
        read = pq.read_table

        def meanwhile(file: Path, **words: object) -> object:
            monkeypatch.undo()
            table.merge()
            return read(file, **words)

        monkeypatch.setattr("pyarrow.parquet.read_table", meanwhile)
        assert set(read_results(tmp_path)["key"]) == {"a", "b"}


def test_a_folder_of_another_study_is_left_alone(tmp_path: Path):
    plan, out = read_plan(written(tmp_path)), tmp_path / "out"
    run_study(replace(plan, jobs=()), out, Local(1))
    with pytest.raises(RunError, match="holds another study, 'Small': choose another folder"):
        run_study(replace(plan, title="Other", jobs=()), out, Local(1))


@pytest.mark.exhaustive
def test_files_that_had_changed_are_tried_again_by_the_same_command(tmp_path: Path):
    plan, out = read_plan(written(tmp_path)), tmp_path / "out"
    plan = replace(plan, jobs=plan.jobs[:2])
    with study_table(out) as table:
        table.add(row(plan.jobs[0].key, "failed", reason=OUTDATED, seconds=0.0))
        table.add(row(plan.jobs[1].key, "failed", reason="no"))
    assert run_study(plan, out, Local(1)) == 1
    assert read_results(out)["outcome"].tolist() == ["failed", "done"]
