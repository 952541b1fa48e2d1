"""What is drawn of a study."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from small_studies import STUDY, written

from steady_ppl.errors import UsageError
from steady_ppl.studies.job import IN_LIMITS
from steady_ppl.studies.pictures import study_picture
from steady_ppl.studies.plan import Picture, read_plan


def test_what_failed_is_in_the_picture_and_names_are_no_formulas(tmp_path: Path):
    plan = read_plan(written(tmp_path, STUDY.replace('"learned"', r'"\u001b[2J$\\frac{{$"')))
    rows = [job.columns | {"outcome": "done", "log_likelihood": 1e300 if job.seed == 1 else 1.0} for job in plan.jobs]
    failed = [one for one in rows if one.get("settings.validation_particles") == 60]
    for one in failed:
        one |= {"outcome": "failed", "reason": "no", "log_likelihood": None}
    figure = study_picture(plan, pd.DataFrame(rows))
    figure.savefig(tmp_path / "study.png")
    (axes,) = figure.axes
    said = [text.get_text() for text in figure.legends[0].get_texts()]
    assert any("2 of 4 failed" in one for one in said) and not any("\x1b" in one for one in said)
    (crosses,) = [line for line in axes.lines if line.get_marker() == "x"]
    assert crosses.get_xdata().tolist() == [60.0]


def test_crosses_of_methods_that_fail_at_the_same_place_are_all_seen(tmp_path: Path):
    method = STUDY[STUDY.index('[[method]]\nname = "learned"') : STUDY.index("[picture]")]
    plan = read_plan(written(tmp_path, STUDY.replace("[picture]", f"{method.replace('learned', 'again')}[picture]")))
    rows = [job.columns | {"outcome": "done", "log_likelihood": 1.0} for job in plan.jobs]
    for one in rows:
        tried = one.get("settings.validation_particles")
        if tried == 60 or (tried == 50 and one["method"] == "again"):
            one |= {"outcome": "failed", "reason": "no", "log_likelihood": None}
    (axes,) = study_picture(plan, pd.DataFrame(rows)).axes
    first, second = [line.get_xydata().tolist() for line in axes.lines if line.get_marker() == "x"]
    assert first == [[60.0, 0.98]] and second == [[50.0, 0.98], [60.0, 0.94]]


def test_of_settings_that_were_tried_the_best_on_held_out_drives_is_drawn(tmp_path: Path):
    text = STUDY.replace("train = 2", "train = [2, 4]").replace("settings.validation_particles", "data.train", 1)
    text = text.replace("y = [", 'chosen_by = "valid_log_likelihood"\ny = [')
    plan = read_plan(written(tmp_path, text[: text.index("published")]))
    rows = []
    for job in plan.jobs:
        more, tried = job.data["train"] == 4, job.settings.get("validation_particles", 0)
        held_out = tried if more else -tried
        rows.append(job.columns | {"outcome": "done", "valid_log_likelihood": held_out, "log_likelihood": float(tried)})
        if tried == 60 and not more:
            rows[-1] |= {"valid_log_likelihood": 99.0}
            if job.seed == 2:  # better where it did not fail
                rows[-1] |= {"outcome": "failed", "valid_log_likelihood": None, "log_likelihood": None}
        if tried == 50 and more and job.seed == 2:  # a seed that only these settings have come to, and a large one
            rows[-1] |= {"valid_log_likelihood": 1000.0}
    rows = [
        one
        for one in rows
        if not (one.get("settings.validation_particles") == 60 and one["data.train"] == 4 and one["seed"] == 2)
    ]
    (axes,) = study_picture(plan, pd.DataFrame(rows)).axes
    found = {str(bars.get_label()): bars.lines[0].get_ydata().tolist() for bars in axes.containers}
    assert found == {"as declared": [0.0, 0.0], "learned": [50.0, 60.0]}


def test_a_picture_needs_its_columns(tmp_path: Path):
    plan = read_plan(written(tmp_path))
    rows = [job.columns | {"outcome": "done", "log_likelihood": 1.0} for job in plan.jobs]
    figure = study_picture(plan, pd.DataFrame(rows))
    (axes,) = figure.axes
    assert axes.get_xlabel() == "settings.validation_particles" and axes.get_ylabel() == "log_likelihood"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["as declared", "published", "learned"]
    alone = replace(plan, picture=replace(plan.picture, leave_out=["as declared"], published={}))
    assert [text.get_text() for text in study_picture(alone, pd.DataFrame(rows)).legends[0].get_texts()] == ["learned"]
    with pytest.raises(UsageError, match="no job of the study is done"):
        study_picture(plan, pd.DataFrame({"key": []}))
    with pytest.raises(UsageError, match="no column log_likelihood"):
        study_picture(plan, pd.DataFrame(rows).drop(columns="log_likelihood"))
    with pytest.raises(UsageError, match="column log_likelihood of the table holds no numbers"):
        study_picture(plan, pd.DataFrame(rows).assign(log_likelihood="much"))
    with pytest.raises(UsageError, match=r"no \[picture\]"):
        study_picture(replace(plan, picture=None), pd.DataFrame(rows))


def test_a_power_curve_begins_with_drives_that_lack_nothing(tmp_path: Path):
    picture = Picture(x=IN_LIMITS, y=["found"])
    plan = replace(read_plan(written(tmp_path)), picture=picture)
    sizes, found = (0.0, 0.0, 0.4, 1.0, 25.0, float("nan")), (False, True, False, True, True, True)
    rows = [
        {"key": job.key, "method": "it", "outcome": "done", IN_LIMITS: size, "found": one}
        for job, size, one in zip(plan.jobs, sizes, found, strict=True)
    ]
    rows[3] |= {"outcome": "failed", IN_LIMITS: None, "found": None}
    figure = study_picture(plan, pd.DataFrame(rows))
    (axes,) = figure.axes
    (bars,) = axes.containers
    said = {text.get_text() for text in figure.legends[0].get_texts()}
    assert said == {"it", "it: 1 of 6 failed", "it: 1 of 6 without a detection limit"}
    assert axes.get_yscale() == "linear"
    assert bars.lines[0].get_xydata().tolist() == [[0.0, 0.5], [0.4, 0.0], [25.0, 1.0]]


def test_a_power_curve_is_of_one_way_of_searching(tmp_path: Path):
    plan = replace(read_plan(written(tmp_path)), picture=Picture(x=IN_LIMITS, y=["found"]))
    asked = {"outcome": "done", IN_LIMITS: 1.0}
    searches = [(drives, effect) for effect in ("linear_drag=1", "wind=1") for drives in (2, 16)]
    rows = [
        {"key": job.key, "method": "it", "data.train": drives, "data.effect": effect, "found": drives == 16} | asked
        for job, (drives, effect) in zip(plan.jobs, searches, strict=False)
    ]
    (axes,) = study_picture(plan, pd.DataFrame(rows)).axes
    found = {str(bars.get_label()): bars.lines[0].get_ydata().tolist() for bars in axes.containers}
    assert found == {"it, train 2": [0.0], "it, train 16": [1.0]}


def test_a_method_may_have_another_name_in_the_picture(tmp_path: Path):
    labels = 'labels = {{learned = "by its likelihood"}}\npublished'
    plan = read_plan(written(tmp_path, STUDY.replace("published", labels, 1)))
    rows = [job.columns | {"outcome": "done", "log_likelihood": 1.0} for job in plan.jobs]
    (legend,) = study_picture(plan, pd.DataFrame(rows)).legends
    assert [text.get_text() for text in legend.get_texts()] == ["as declared", "published", "by its likelihood"]
