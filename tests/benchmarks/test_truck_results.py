"""The page on the real truck says what the records say."""

from __future__ import annotations

import json
import statistics
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RECORDS = [json.loads(line) for line in (ROOT / "benchmarks" / "results" / "truck.jsonl").read_text().splitlines()]
PAGE = (ROOT / "docs" / "truck.md").read_text()
PATHS = [record for record in RECORDS if record["part"] == "path"]
assert PATHS
PLANTED = [record for record in RECORDS if record["part"] == "planted"]


@pytest.fixture(scope="module")
def benchmark():
    import truck

    return truck


def of(program: str) -> list[dict]:
    runs = sorted((record for record in RECORDS if record.get("program") == program), key=lambda run: run["draw"])
    assert [run["draw"] for run in runs] == [1, 2, 3, 4, 5]
    return runs


def short(value: float, places: int) -> str:
    return f"{value:.{places}f}".replace("-", "−").replace("0.", ".", 1) if abs(value) < 1 else f"{value:.{places}f}"


@pytest.mark.parametrize(
    "program", ["hand", "fitted", "network", "network, Euler", "discovered", "hybrid", "discovered, Euler"]
)
def test_the_table_is_the_mean_of_five_draws(program: str) -> None:
    (row,) = (line for line in PAGE.splitlines() if line.startswith(f"| {program} |"))
    for group in ("forward", "forward_mean"):
        of_authors = statistics.fmean(run["authors_starts"][group]["location"] for run in of(program))
        assert short(of_authors, 4) in row.split("|")[-2]
    for group, places in (("forward", 4), ("forward_mean", 4), ("state_estimation", 3)):
        for what in ("location", "angle"):
            mean = statistics.fmean(run[group][what] for run in of(program))
            assert short(mean, places) in row, (group, what)
    likelihood = [run["log_likelihood"] for run in of(program)]
    assert f"{statistics.fmean(likelihood):.2f} ± {short(statistics.stdev(likelihood), 2)}" in row


@pytest.mark.parametrize(
    ("program", "other"),
    [
        *((program, other) for program in ("discovered", "hybrid") for other in ("hand", "network")),
        ("discovered", "discovered, Euler"),
        ("network, Euler", "network"),
    ],
)
def test_gains_are_of_the_same_draws(program: str, other: str) -> None:
    gains = [a["log_likelihood"] - b["log_likelihood"] for a, b in zip(of(program), of(other), strict=True)]
    assert f"{short(statistics.fmean(gains), 2)} ± {short(statistics.stdev(gains), 2)}" in PAGE


def test_what_is_left_to_the_networks_is_the_mean_of_five_draws() -> None:
    for program in ("network", "hybrid"):
        left = [
            statistics.fmean(values) for values in zip(*(run["network"]["network"] for run in of(program)), strict=True)
        ]
        assert ", ".join(short(value, 2) for value in left[:2]) + " m/s²" in PAGE
        assert f"{short(left[2], 2)} rad/s²" in PAGE


NAMES = ("lever", "slip")
NUMBERS = {
    "lever at 1.3 m/s": (lambda numbers: numbers["lever"], 0.265),
    "lever at standstill": (lambda numbers: numbers["lever"] - 1.3 * numbers["slip"], 0.372),
    "slip": (lambda numbers: numbers["slip"], -0.082),
    "crab": (lambda numbers: numbers["crab"], -0.013),
}


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_beside_motion_capture_are_of_five_draws(name: str) -> None:
    number, motion_capture = NUMBERS[name]
    found = [number(run["parameters"]) for run in of("discovered")]
    (row,) = (line for line in PAGE.splitlines() if line.startswith(f"| {name} |"))
    assert f"{short(statistics.fmean(found), 3)} ± {short(statistics.stdev(found), 3)}" in row
    assert short(motion_capture, 3) in row
    if name.startswith("lever"):
        assert all(abs(value - motion_capture) < 0.05 for value in found)
    if name == "slip":
        assert max(found) < 0


def test_lever_and_slip_were_moved_to_their_likeliest_values() -> None:
    for run in of("discovered"):
        assert {name: run["parameters"][name] for name in NAMES} == pytest.approx(run["likeliest"]["values"])
    slips = [run["likeliest"]["conditional_sds"]["slip"] for run in of("discovered")]
    assert f"to {short(min(slips), 3)} to {short(max(slips), 3)} s a draw" in PAGE


def test_the_page_says_which_musts_are_missed(benchmark) -> None:
    lines, good = benchmark.table_of([record for record in RECORDS if record["part"] == "table"])
    missed = [line for line in lines if "MISSED" in line]
    assert not good and [line.partition(":")[0] for line in missed] == [
        "discovered forward_mean location",
        "discovered forward location",
    ]
    assert "from centred starts neither does" in PAGE


def test_every_fault_of_full_size_is_found(benchmark) -> None:
    assert benchmark.planted_of(PLANTED)[1]


@pytest.mark.parametrize("path", PATHS, ids=[f"draw {path['draw']}" for path in PATHS])
def test_the_page_has_every_step_of_every_path(path: dict) -> None:
    for step in path["steps"]:
        if not (step["added"] or step is path["steps"][0]):
            continue
        test = step["test"]
        cells = [
            f"{short(test['forward']['location'], 3)} / {short(test['forward']['angle'], 3)}",
            f"{short(test['forward_mean']['location'], 3)} / {short(test['forward_mean']['angle'], 3)}",
            f"{test['log_likelihood']:.2f}",
        ]
        (row,) = (line for line in PAGE.splitlines() if f"| {' | '.join(cells)} |" in line)
        for effect in step["added"]:
            assert f"`{effect['effect']}`" in row
            for value in effect["coefficient"]:
                assert short(float(f"{value:.3g}"), 3 if abs(value) < 1 else 2).rstrip("0") in row


def test_the_page_counts_the_faults_that_were_found(benchmark) -> None:
    from truck_planted import FAULTS, is_right

    for fault, about in FAULTS.items():
        (row,) = (line for line in PAGE.splitlines() if line.startswith(f"| {about.text} |"))
        for share in (1.0, 0.5):
            runs = [record for record in PLANTED if (record["fault"], record["share"]) == (fault, share)]
            if runs:
                assert f"{sum(map(is_right, runs))} of {len(runs)}" in row
