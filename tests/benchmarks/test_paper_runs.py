"""The benchmarks of the paper's tables, of their settings and of the unknown map, from drives to records."""

from __future__ import annotations

import json
import math
from pathlib import Path

import choose
import paper
import paper_methods
import pyro
import pyro.distributions as dist
import pytest
import torch
from experiments import LOGS, SIZES, hov, truck
from paper_methods import named
from paper_records import METHODS
from paper_tables import tables

from inference import hand
from models.hovercraft import HovercraftTruth
from models.paper import PaperHovercraft, PaperHovercraftTruth, PaperTruck
from steady_ppl import ExplicitEuler, simulate, stack
from steady_ppl.errors import FilterError

FEW = {"steps": 2, "validate_every": 2}


@pytest.fixture(autouse=True)
def few_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SIZES, "hov", (2, 2, 2))


# --- the paper's world and programs take its authors' step ------------------------------------------------------------


class AsPublished(HovercraftTruth):
    """What simulated Hov at commit 072b915, line by line."""

    def transition(self, state, control, time, step):
        left, right = control.unbind(-1)
        forward, lateral, yaw_rate = self.body_velocity(state)
        drag_forward, drag_lateral, drag_yaw = self.drag
        mean = stack(
            (left + right - drag_forward * forward * forward.abs()) / self.mass,
            -drag_lateral * lateral * lateral.abs() / self.mass,
            (right - left - drag_yaw * yaw_rate) / self.inertia,
        )
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        x, y, heading, vx, vy, yaw_rate = state.unbind(-1)
        forward, lateral, yaw = acceleration.unbind(-1)
        cos, sin = heading.cos(), heading.sin()
        return stack(
            x + vx * step,
            y + vy * step,
            heading + yaw_rate * step,
            vx + (cos * forward - sin * lateral) * step,
            vy + (sin * forward + cos * lateral) * step,
            yaw_rate + yaw * step,
        )


def test_hov_is_simulated_as_it_was_published_bit_for_bit() -> None:
    drives, published = hov(1)[0], simulate(AsPublished(), 16, seed=11, substeps=1)
    for part in ("time", "controls", "measurements", "states"):
        assert torch.equal(getattr(drives, part), getattr(published, part)), part


@pytest.mark.slow
def test_hov_is_that_of_the_code_that_made_the_tables() -> None:
    """The ends of the first drive of seed 1, as `hov(1)` had them at commit 072b915."""
    drive = hov(1, 16, 1, 1)[0]
    state = [-9.000018119812012, -2.318610668182373, 8.158830642700195, -1.148380994796753, 0.6281138062477112]
    state += [-0.1162877231836319]
    bearings = [-2.0772175788879395, -2.397874355316162, -0.5771541595458984, -1.278306007385254]
    few_ulps = {"rtol": 1e-5, "atol": 1e-5}  # of single precision, on processors that round elsewhere
    torch.testing.assert_close(drive.states[-1, 0], torch.tensor(state, dtype=torch.float64), **few_ulps)
    torch.testing.assert_close(drive.measurements[-1, 0], torch.tensor(bearings, dtype=torch.float64), **few_ulps)


@pytest.mark.slow
@pytest.mark.parametrize("experiment", ["hov", "hov+", "truck"])
@pytest.mark.parametrize("method", [*paper_methods.RECIPES])
def test_the_tables_fit_the_papers_programs(monkeypatch: pytest.MonkeyPatch, method: str, experiment: str) -> None:
    given = {}
    monkeypatch.setitem(paper_methods.RECIPES, method, lambda program, *_, **options: given.update(options, of=program))
    paper_methods.learnt(method, experiment, hov(1, 1, 1, 1), 1, {})
    vehicle = "Truck" if experiment == "truck" else "Hovercraft"
    expected = {"hand": f"Paper{vehicle}", "truth": "PaperHovercraftTruth"}.get(method, f"PaperNeural{vehicle}")
    for program, name in ((given["of"], expected), (given.get("hand"), f"Paper{vehicle}")):
        if program is not None:
            assert type(program).__name__ == name and isinstance(program, ExplicitEuler) and program.substeps == 1
    assert ("hand" in given) == (method == "fit-hand")


def test_the_papers_world_is_not_cut_into_finer_steps() -> None:
    drives = simulate(PaperHovercraftTruth(), 1, seed=1)
    position, velocity = drives.states[..., :2], drives.states[..., 3:5]
    torch.testing.assert_close(position[1:], position[:-1] + 0.1 * velocity[:-1], rtol=1e-5, atol=1e-5)


# --- from drives to records -------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("method", "settings"), [("hand", {}), ("fit-truth", FEW)])
def test_a_run_of_a_method(method: str, settings: dict, tmp_path: Path) -> None:
    made = json.loads(json.dumps(paper.judged(method, "hov", 1, settings, tmp_path, True, tmp_path)))
    made["set"] = named(method, "hov", 1, settings)
    assert made["kept_step"] == settings.get("steps") and ("steps=2" in made["set"]) == bool(settings)
    assert paper.said(made).startswith("forward 0.") and math.isfinite(made["bootstrap"]["log_likelihood"])
    text = tables([made], 1)
    assert f"| {METHODS[method]} | {made['forward']['location']:.4f} | " in text
    assert " of 1 equal" in text and "not held against" not in text and not list(tmp_path.iterdir())


def test_a_filter_that_fails_is_a_record_without_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise FilterError("every weight is zero")

    monkeypatch.setattr(paper_methods, "log_likelihood", broken)
    test = hov(1, 1, 1, 1)[2]
    found = paper_methods.by_bootstrap(hand.fit(PaperHovercraft(), test, known_start=True), test, particles=10)
    assert math.isnan(found["log_likelihood"]) and found["why_not"] == "every weight is zero"


@pytest.mark.slow
def test_settings_are_judged_by_held_out_drives(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made = choose.judged("fit-truth", "hov", 101, FEW, tmp_path)
    assert made["kept_step"] == 2 and math.isfinite(made["log_likelihood"])
    records = {named("fit-truth", "hov", seed, FEW): made for seed in (101, 102)}
    monkeypatch.setitem(choose.CANDIDATES, ("fit-truth", "hov"), [FEW])
    mean = f"{made['log_likelihood']:.2f}"
    assert f"| fit-truth | hov | steps 2, validate_every 2 | {mean} | {mean}, {mean} | 2, 2 |" in choose.table(records)


@pytest.mark.slow
@pytest.mark.skipif(not LOGS.is_dir(), reason="the AlphaTruck logs are not part of this repository")
def test_the_picture_of_velocities(tmp_path: Path) -> None:
    for name in ("first", "second"):
        hand.fit(PaperTruck(), truck(LOGS, 1)[0], known_start=True).save(tmp_path / name)
    file = paper.draw_velocities({name: tmp_path / name for name in ("first", "second")}, LOGS, tmp_path / "v.png")
    assert file.stat().st_size > 10_000
