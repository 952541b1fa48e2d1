"""The paper's tables: every published figure, ours beside it; no must is met by what was not run or is no number."""

from __future__ import annotations

import csv
import hashlib
import math
import subprocess
import sys
from pathlib import Path

import paper
import pytest
from choose import CANDIDATES, SEEDS, seeds, table
from paper_filters import filters
from paper_methods import named
from paper_musts import all_met, shown
from paper_records import EXPERIMENTS, METHODS, PUBLISHED
from paper_tables import tables


def record(method: str, seed: int, size: float, experiment: str = "hov+", **more: object) -> dict:
    groups = {"location": size, "angle": size / 10}
    figures = {metric: dict(groups) for metric in ("forward", "forward_mean", "state_estimation")}
    at = {"experiment": experiment, "method": method, "seed": seed, "set": f"{experiment} {method} {seed}"}
    return {**at, "seconds": 10.0, "log_likelihood": -size, **figures, **more}


def whole() -> list[dict]:
    """Three runs of each method of the musts, all of them good."""
    sizes = {"hand": 0.5, "fit-hand": 0.3, "fit-tv": 0.4, "svi": 0.04, "steady": 0.02, "fit-truth": 0.025}
    return [
        record(method, seed, size, experiment)
        for experiment in EXPERIMENTS
        for method, size in sizes.items()
        for seed in (1, 2, 3)
    ]


def named_as(outcome: str, records: list[dict], runs: int = 3) -> list[str]:
    return [line for line in shown(records, runs) if line.startswith(outcome)]


def of(records: list[dict], experiment: str, method: str) -> list[dict]:
    return [one for one in records if (one["experiment"], one["method"]) == (experiment, method)]


def test_every_cell_of_the_papers_tables_was_copied() -> None:
    with PUBLISHED.open() as file:
        rows = list(csv.DictReader(file))
    cells = {(row["metric"], row["group"], row["experiment"], row["method"]) for row in rows}
    assert len(cells) == len(rows) == 5 * len(EXPERIMENTS) * 6
    assert {row["method"] for row in rows} < set(METHODS) and {row["experiment"] for row in rows} == set(EXPERIMENTS)
    assert all(float(row["best"] or row["average"]) <= float(row["average"]) + 0.0005 for row in rows)  # rounded
    assert all((row["metric"] == "log_likelihood") >= bool(row["spread"]) for row in rows)


def test_the_published_digits_are_those_that_were_held_against_the_paper() -> None:
    with PUBLISHED.open() as file:
        content = "\n".join(sorted(",".join(row) for row in csv.reader(file)))
    digest = hashlib.sha256(content.encode()).hexdigest()
    assert digest == "f1bc1c1099dcca3735273facafb66c6aae657dac0cd7d4c7309d3fb05bfa1010"


def test_ours_are_means_spreads_and_the_best() -> None:
    text = tables([record("steady", 1, 0.1), record("steady", 2, 0.3), record("hand", 1, 0.5)], 2)
    part = text.split("## ")[3:]
    assert "| STEADY | – (0.0428 / 0.0140) | 0.2000 / 0.0200 (0.0382 / 0.0128) |" in text
    assert "| STEADY | – (0.380 / 0.033) | 0.200 / 0.020 (0.350 / 0.031) |" in text
    location, likelihood = part[0], next(one for one in part if one.startswith("log p(y)"))
    assert "| STEADY | – | 0.380 (0.375) | 0.200 ± 0.141 (0.100) | 0.350 (0.346) | – | 0.266 (0.258) |" in location
    assert "| Hand | – | 1.209 (1.168) | 0.500 (1 of 2) | 1.206 (1.145)" in location
    assert "-0.20 ± 0.14 (-0.10)" in likelihood
    assert "| STEADY, bootstrap" not in text


def test_the_spread_is_what_the_noise_adds_to_the_mean_roll_out() -> None:
    one = record("steady", 1, 0.5)
    one["forward_mean"] = {"location": 0.4, "angle": 0.03}
    text = tables([one], 1)
    location, angle = (part for part in text.split("## ") if part.startswith("Spread"))
    assert "| STEADY | – | – | 0.3000 | – | – | – |" in location and "| 0.0400 |" in angle


def test_the_published_spread_is_shown() -> None:
    text = tables([])
    assert "| SVI | – | 25.9 | – | 31.4 | – | -21 ± 38 |" in text
    assert "| STEADY | – | 38.18 ± 0.04 | – | 39.141 ± 0.027 | – | 33.4 ± 0.2 |" in text


def test_runs_that_lack_or_failed_are_seen() -> None:
    failed = [
        {"set": "hov+ steady 2 batch=32", "version": "1", "failed": "DataError: of\ntwo lines"},
        {"set": "truck fit-tv 1", "version": "1", "failed": "ValueError: no"},
    ]
    text = tables([record("steady", 1, 0.1), record("hand", 1, 0.5), record("hand", 2, 0.7), *failed])
    assert "| 0.100 (1 of 3) | 0.350 (0.346) |" in text and "| 0.600 ± 0.141 (0.500) (2 of 3) |" in text
    assert "| FitTV | – | 1.67 (1.381) | – | 1.54 (1.355) | – (0 of 3) | 0.510 (0.504) |" in text
    assert "- hov+ steady 2 batch=32: DataError: of two lines\n- truck fit-tv 1: ValueError: no\n" in text
    whole_text = tables(whole())
    assert " of 3)" not in whole_text and "failed" not in whole_text


def test_musts_that_were_not_run_are_not_met() -> None:
    assert not all_met([], 3) and shown([], 3)[0] == "74 musts: 0 met, 0 MISSED, 74 not run"
    assert all_met(whole(), 3) and shown(whole(), 3) == ["74 musts: 74 met, 0 MISSED, 0 not run"]
    no_truck = [one for one in whole() if one["experiment"] != "truck"]
    assert not all_met(no_truck, 3)
    assert named_as("not run", no_truck) == [
        "not run: Truck, STEADY better than Hand (STEADY: 0 of 3 runs, Hand: 0 of 3 runs)",
        "not run: Truck, STEADY better than FitHand (STEADY: 0 of 3 runs, FitHand: 0 of 3 runs)",
        "not run: Truck, STEADY better than FitTV (STEADY: 0 of 3 runs, FitTV: 0 of 3 runs)",
        "not run: Truck, STEADY better than SVI (STEADY: 0 of 3 runs, SVI: 0 of 3 runs)",
        "not run: Truck, STEADY within one sd of published (STEADY: 0 of 3 runs)",
        "not run: Truck, SVI no worse than published (SVI: 0 of 3 runs)",
    ]
    assert all(f"- {line}" in tables(no_truck) for line in shown(no_truck, 3))


@pytest.mark.parametrize("method", ["hand", "fit-hand", "fit-tv", "svi", "steady", "fit-truth"])
def test_a_run_that_lacks_or_failed_leaves_its_musts_not_run(method: str) -> None:
    records = [one for one in whole() if (one["experiment"], one["method"], one["seed"]) != ("hov+", method, 2)]
    assert any(f"{METHODS[method]}: 2 of 3 runs" in line for line in named_as("not run", records))
    failed = {"set": f"hov+ {method} 2", "version": "1", "failed": "why"}
    assert not all_met([*records, failed], 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("experiment", "method", "metric", "said"),
    [
        ("hov", "steady", "forward", "STEADY better than Hand, forward location: STEADY {}, Hand 0.5000"),
        ("truck", "fit-tv", "forward", "STEADY better than FitTV, forward angle: STEADY 0.0020, FitTV {}"),
        ("hov+", "steady", "forward", "STEADY better than published, forward location: STEADY {}, published 0.0382"),
        ("truck", "steady", "state_estimation", "STEADY within one sd of published, state estimation location: "),
        ("truck", "svi", "state_estimation", "SVI no worse than published, state estimation location: SVI {}, publi"),
        ("hov+", "fit-truth", "forward", "FitTruth near the true program, forward location: FitTruth {}, must be at"),
    ],
)
@pytest.mark.parametrize("bad", [math.nan, 0.9])
def test_a_figure_that_is_bad_or_nan_misses_its_must(
    experiment: str, method: str, metric: str, said: str, bad: float
) -> None:
    records = whole()
    assert named_as("MISSED", records) == []
    for one in of(records, experiment, method):
        one[metric] = dict.fromkeys(("location", "angle"), -bad if method == "fit-tv" else bad)
    figure = f"{-bad if method == 'fit-tv' else bad:.4f}"
    missed = named_as("MISSED", records)
    assert any(line.startswith(f"MISSED {EXPERIMENTS[experiment]}, {said.format(figure)}") for line in missed)
    assert not all_met(records, 3) and all(f"- {line}" in tables(records) for line in missed)


def test_one_nan_among_three_runs_misses_as_well() -> None:
    records = whole()
    of(records, "truck", "steady")[1]["forward"]["location"] = math.nan
    assert len(named_as("MISSED", records)) == 5 and "nan ± nan" in tables(records)


def test_the_published_average_must_be_passed_on_truck_within_one_sd_of_ours() -> None:
    records = whole()
    for experiment in ("hov", "truck"):
        for one, away in zip(of(records, experiment, "steady"), (-0.02, 0.0, 0.02), strict=True):
            one["forward"]["location"] = {"hov": 0.0428, "truck": 0.200}[experiment] + 0.01 + away
        for one in of(records, experiment, "svi"):
            one["forward"]["location"] = {"hov": 0.093, "truck": 0.44}[experiment]
    (missed,) = named_as("MISSED", records)
    assert missed == "MISSED Hov, STEADY better than published, forward location: STEADY 0.0528, published 0.0428"
    for one in of(records, "truck", "steady"):
        one["forward"]["location"] += 0.0101
    assert "MISSED Truck, STEADY within one sd of published, forward location: STEADY 0.2201, published 0.2" in (
        named_as("MISSED", records)
    )


def checked(method: str, nats: float, location: float, angle: float = 0.0, seed: int = 1) -> dict:
    """A run with a bootstrap that is so far away."""
    one = record(method, seed, 0.3)
    errors = {"location": 0.3 + location, "angle": 0.03 + angle}
    return one | {"bootstrap": {"log_likelihood": one["log_likelihood"] - nats, "state_estimation": errors}}


@pytest.mark.parametrize(
    ("nats", "location", "angle"),
    [(0.6, 0, 0), (-0.6, 0, 0), (0, 0.02, 0), (0, -0.02, 0), (0, 0, 0.002), (math.nan, 0, 0), (0, 0, math.nan)],
)
def test_a_bootstrap_that_differs_is_shown_with_its_figures(nats: float, location: float, angle: float) -> None:
    lines = list(filters([checked("hand", 0.4, 0.01, 0.001), checked("steady", nats, location, angle)]))
    assert lines[0] == "1 of 2 equal" and len(lines) == 2
    likelihood, place, direction = -0.3 - nats, 0.3 + location, 0.03 + angle
    assert lines[1] == (
        "NOT EQUAL Hov+, STEADY, run 1: -0.30 nats, 0.3000 m, 0.0300 rad, "
        f"by the bootstrap {likelihood:.2f} nats, {place:.4f} m, {direction:.4f} rad"
    )


def test_runs_without_a_bootstrap_are_named() -> None:
    records = [checked("hand", 0.0, 0.0), record("hand", 2, 0.5), record("steady", 1, 0.1)]
    lines = [
        "1 of 1 equal",
        "not held against the bootstrap: Hov+, Hand, run 2",
        "not held against the bootstrap: Hov+, STEADY, run 1",
    ]
    assert list(filters(records)) == lines and all(f"- {line}\n" in tables(records) for line in lines)
    assert "within 0.5 nats of log p(y) and 5 % of both" in tables(records)


def test_where_one_run_differs_all_are_shown_by_the_bootstrap_and_marked() -> None:
    same, apart = checked("hand", 0.0, 0.002, seed=1), checked("hand", 1.0, 0.1, 0.01, seed=2)
    text = tables([same, apart, checked("steady", 0.0, 0.001)], 2)
    location, angle, forward, *_ = text.split("## ")[3:]
    assert "| 0.351 ± 0.069 (0.302)ᵇ |" in location and "| 0.300 (1 of 2) |" in location
    assert "| 0.0350 ± 0.0071 (0.0300)ᵇ |" in angle
    assert "| Hand | – (1.209 / 0.601) | 0.351 / 0.035ᵇ (1.206 / 0.550) |" in text
    assert "ᵇ" not in forward and "-0.80 ± 0.71 (-0.30)ᵇ" in text


def test_where_the_bootstrap_differs_a_must_is_judged_by_its_figures() -> None:
    records = whole()
    one = of(records, "truck", "steady")[0]
    same = {"log_likelihood": one["log_likelihood"], "state_estimation": dict(one["state_estimation"])}
    one["bootstrap"] = same
    assert all_met(records, 3)
    one["bootstrap"] = {"log_likelihood": -50.0, "state_estimation": {"location": 4.8, "angle": 0.002}}
    assert ("MISSED Truck, STEADY better than Hand, state estimation location: STEADY 1.6133, Hand 0.5000") in named_as(
        "MISSED", records
    )
    assert "NOT EQUAL Truck, STEADY, run 1" in tables(records)


@pytest.mark.parametrize("method", ["steady", "svi"])
def test_a_bootstrap_that_breaks_down_is_said_and_meets_no_must(method: str) -> None:
    records = whole()
    none = {"location": math.nan, "angle": math.nan}
    of(records, "hov", method)[1]["bootstrap"] = {
        "log_likelihood": math.nan,
        "state_estimation": none,
        "why_not": "every weight is zero",
    }
    assert named_as("MISSED", records)
    assert "by the bootstrap nothing (every weight is zero)" in tables(records)


def test_a_quick_run_judges_nothing() -> None:
    text = tables([record("steady", 1, 0.6), record("hand", 1, 0.5)], 1, quick=True)
    assert "A quick run judges nothing" in text and "MISSED" not in text and " met" not in text


@pytest.mark.parametrize(
    ("found", "quick", "code"),
    [
        ("all", False, 0),
        ("all", True, 0),
        ("none", False, 1),
        ("none", True, 0),
        ("missed", False, 1),
        ("missed", True, 0),
        ("failed", False, 1),
        ("failed", True, 1),
    ],
)
def test_the_exit_code(
    found: str, quick: bool, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    records = whole() if found != "none" else []
    if found == "missed":
        of(records, "hov+", "fit-truth")[0]["forward"]["angle"] = math.nan
    if found == "failed":
        records.append({"set": "hov truth 1", "version": "1", "failed": "why"})
    (tmp_path / "quick").mkdir()
    monkeypatch.setattr(paper, "run", lambda *_, **__: records)
    told = ["--out", str(tmp_path), "--data", str(tmp_path), *(["--quick"] if quick else [])]
    monkeypatch.setattr(sys, "argv", ["paper.py", *told])
    assert paper.main() == code
    assert ("judges nothing" in capsys.readouterr().out) == quick
    assert ("- hov truth 1: why" in (tmp_path / ("quick" if quick else "") / "paper.md").read_text()) == (
        found == "failed"
    )


@pytest.mark.slow
def test_the_benchmark_starts() -> None:
    command = [sys.executable, PUBLISHED.parent / "paper.py", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "usage: paper.py" in done.stdout


def test_settings_that_failed_or_are_not_fitted_to_every_draw_have_no_mean() -> None:
    first, second = (CANDIDATES["svi", "hov"][i] for i in (0, 1))
    one, other = SEEDS["hov"]
    fitted = {"log_likelihood": 370.0, "kept_step": 5, "seconds": 2.0}
    both = {named("svi", "hov", seed, first): fitted for seed in (one, other)}
    assert "| 370.00 | 370.00, 370.00 | 5, 5 | 2, 2 |" in table(both)
    failed = both | {named("svi", "hov", one, first): {"failed": "why"}}
    assert "| – | failed, 370.00 | failed, 5 | failed, 2 |" in table(failed)
    assert "| – | 370.00 | 5 | 2 |" in table({named("svi", "hov", other, second): fitted})


def test_settings_that_tied_are_judged_by_more_draws() -> None:
    first, second = ((one, seeds("svi", "truck", one)) for one in CANDIDATES["svi", "truck"][:2])
    assert first[1] == (11, 12, 13, 14) and second[1] == (11, 12)
    fitted = {"log_likelihood": 370.0, "kept_step": 5, "seconds": 2.0}
    two = {named("svi", "truck", seed, settings): fitted for settings, _ in (first, second) for seed in (11, 12)}
    assert "| svi | truck | defaults | – |" in table(two) and "| first_kl_weight 1 | 370.00 |" in table(two)
