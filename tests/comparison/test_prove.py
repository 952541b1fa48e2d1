"""`prove`: right about a missing drag, silent where nothing changed, and every figure what it says."""

from __future__ import annotations

import json
import math
import textwrap
from dataclasses import replace

import numpy as np
import pytest
import torch
from examples import drives, example
from oracles import cart_parameters, kalman
from small import FEW, HOVERCRAFT, TRUTH, contents, finite, only_start, simulated, steady, written

import steady_ppl as st
from steady_ppl.comparison.prove import doubtful, prove
from steady_ppl.comparison.scores import Key
from steady_ppl.model.program import Program, for_program
from steady_ppl.utils.text import TEXT_WIDTH


def hovercraft(name: str = "hovercraft") -> Program:
    return example(name, torch.float32).requires_grad_(False)


@pytest.fixture(scope="module")
def truth() -> Program:
    """A hovercraft with plenty of drag."""
    program = hovercraft("hovercraft.py:HovercraftTruth")
    program.drag = torch.tensor([0.05, 0.1, 0.2])
    program.duration = 6.0
    return program


@pytest.fixture(scope="module")
def dragged(truth) -> st.Trajectories:
    return st.simulate(truth, 10, seed=2)


@pytest.fixture(scope="module")
def drag(dragged, truth):
    """The owner's program without drag, and the one that made the drives."""
    return prove({"before": hovercraft(), "after": truth}, dragged, known_start=True, truth="after")


@pytest.fixture(scope="module")
def carts(cart):
    """Drives with gaps and uneven steps, a cart that is right and one that is not."""
    data = drives(cart, 6, 41, gaps=True, seed=5)
    wrong = example("linear_gaussian").requires_grad_(False)
    wrong.damping = torch.tensor(0.1).double()
    return data, prove({"wrong": wrong, "right": cart}, data, known_start=False, truth="right")


def line(proof, name: str):
    (row,) = (row for row in proof.figures["rows"] if row["row"] == name)
    return row


def test_the_program_with_the_drag_is_proved_better(drag):
    against = line(drag, "after")["against_reference"]
    assert against["log_likelihood"]["interval"][0] > 0
    for errors in (against["measurement"]["rad"], *(against["state"][group] for group in ("location", "yaw_rate"))):
        assert errors["3 s"]["relative_interval"][1] < 0
    assert drag.figures["verdict"].startswith("after is better than before: log p(y) +")
    assert "3-s open-loop error −" in drag.figures["verdict"]
    assert line(drag, "before")["against_reference"] is None


def test_the_truth_is_near_the_noise_floor_and_covers_nine_in_ten(drag):
    truth, floor, before = (line(drag, name) for name in ("after", "noise floor", "before"))
    assert truth["measurement"]["rad"]["3 s"] == pytest.approx(floor["measurement"]["rad"]["3 s"], rel=0.25)
    assert truth["state"]["location"]["1 s"] == pytest.approx(floor["state"]["location"]["1 s"], rel=0.4)
    assert floor["coverage_90"]["3 s"] == pytest.approx(0.9, abs=0.02)
    assert before["coverage_90"]["3 s"] < 0.8 < truth["coverage_90"]["3 s"]
    assert floor["against_reference"] is None


def test_the_vehicle_that_keeps_its_velocity_loses(drag):
    against = line(drag, "constant velocity")["against_reference"]
    assert against["log_likelihood"]["interval"][1] < 0
    assert against["state"]["location"]["1 s"]["relative_interval"][0] > 0


@pytest.mark.slow
def test_a_reading_that_both_find_wrong_is_left_out_of_every_figure(drag, dragged, truth):
    row, drive = 30, 4
    spoiled = replace(dragged, measurements=dragged.measurements.clone())
    spoiled.measurements[row, drive, 2] += 2.5  # rad, 29 standard deviations
    rows = {"before": hovercraft(), "after": truth}
    found = prove(rows, spoiled, known_start=True, truth="after")
    (outlier,) = found.outliers.found
    assert (outlier.label, outlier.rows, outlier.columns) == (dragged.labels[drive], (row, row), ("y.bearing_2",))
    wrong = torch.zeros_like(dragged.observed)
    wrong[row, drive, 2] = True
    masked = prove(rows, dragged.without(wrong), known_start=True, truth="after")
    for name in rows:
        one, other = (line(proof, name)["measurement"]["rad"]["3 s"] for proof in (found, masked))
        assert one == pytest.approx(other, rel=1e-4)
    assert "1 reading left out as wrong" in str(found)
    assert [one["columns"] for one in found.figures["outliers"]] == [["y.bearing_2"]]
    assert not drag.outliers.found


def test_a_program_with_heavy_tails_is_asked_about_every_reading(dragged, truth):
    spoiled = replace(dragged, measurements=dragged.measurements.clone())
    spoiled.measurements[30, 4, 2] += 2.5
    tailed = truth.with_effect("heavy_tails", 0.3)
    found = prove({"before": truth, "after": tailed}, spoiled, known_start=True, with_constant_velocity=False)
    assert not found.outliers.found
    assert line(found, "after")["against_reference"]["log_likelihood"]["difference"] > 5


def test_different_priors_of_the_start_are_noted(truth):
    boat = example("gps_boat", torch.float32).requires_grad_(False)
    data = st.simulate(boat, 5, seed=1).without_truth()
    seeing = example("gps_boat", torch.float32).requires_grad_(False)
    seeing.start = "first measurements"
    rows = {"declared": boat, "seeing": seeing}
    found = prove(rows, data, known_start=False, with_constant_velocity=False, horizons=(1.0,))
    assert [note for note in found.notes if note.startswith("seeing and declared have different priors of the start")]


def test_the_noise_scales_are_the_programs(drag):
    scales = line(drag, "after")["scales"]
    assert scales["channels"] == pytest.approx({"forward [m/s²]": 0.08, "lateral [m/s²]": 0.08, "yaw [rad/s²]": 0.05})
    assert scales["measurements"] == pytest.approx({f"bearing_{i} [rad]": math.radians(5) for i in range(4)})


def test_the_same_program_twice_differs_by_nothing(dragged):
    found = prove({"one": hovercraft(), "two": hovercraft()}, dragged, known_start=True, with_constant_velocity=False)
    against = line(found, "two")["against_reference"]
    changes = [against["log_likelihood"], *against["coverage_90"].values()]
    changes += [c for kind in ("measurement", "state") for errors in against[kind].values() for c in errors.values()]
    assert len(changes) > 10
    assert all(change["difference"] == 0 and change["interval"] == [0, 0] for change in changes)
    expected = "two is not shown to be better than one: log p(y) +0.0 nats a trajectory"
    assert found.figures["verdict"].startswith(expected)


def test_a_particle_filter_agrees_on_a_linear_program_and_nearly_on_bearings(drag, carts):
    assert [line(carts[1], name)["neglected"] for name in ("wrong", "right")] == pytest.approx([0, 0], abs=0.02)
    for name in ("before", "after"):
        assert 0 < abs(line(drag, name)["neglected"]) < 0.3
    assert line(drag, "noise floor")["neglected"] is None
    assert not [note for note in drag.notes if "particle" in note]


def test_a_drive_that_the_linearised_program_misjudges_is_named(drag, dragged):
    left = torch.zeros(len(dragged))
    left[3], left[7] = -4.0, 2.5
    rows = {"after": replace(drag.rows["after"], neglected=left)}
    assert doubtful(rows, dragged) == [
        "after: on trajectory 4 a particle filter's log p(y) is 4.0 nats below the linearised model's "
        "(1 other likewise): look at it before you trust the table"
    ]
    left[5] = torch.nan
    says = "on trajectory 6 a particle filter's log p(y) is not comparable with the linearised"
    assert says in doubtful(rows, dragged)[0]
    rows = {"after": replace(drag.rows["after"], neglected="it broke down")}
    assert doubtful(rows, dragged)[0].endswith("can be trusted: it broke down")


@pytest.mark.parametrize("horizon", ["1 s", "3 s"])
def test_an_error_is_that_of_kalmans_states_rolled_out_row_by_row(cart, carts, horizon):
    data, found = carts
    exact, values = kalman(data, cart_parameters(cart)), {name: float(v) for name, v in cart_parameters(cart).items()}
    rows, measured, estimated = found.horizons[horizon], [], []
    assert rows * found.step == pytest.approx(float(horizon[0]), abs=found.step / 2)
    for drive in range(len(data)):
        for first in range(int(data.lengths[drive]) - rows):
            position, velocity = exact.means[first, drive].tolist()
            for row in range(first, first + rows):
                step, push = float(data.steps[row, drive]), float(data.controls[row, drive, 0])
                acceleration = values["gain"] * push - values["damping"] * velocity
                position += step * velocity + step**2 / 2 * acceleration
                velocity += step * acceleration
            if bool(data.observed[first + rows, drive, 0]):
                measured.append(float(data.measurements[first + rows, drive, 0]) - position)
            estimated.append(float(data.states[first + rows, drive, 1]) - velocity)
    row = line(found, "right")
    assert row["measurement"]["m"][horizon] == pytest.approx(np.sqrt(np.mean(np.square(measured))))
    assert row["state"]["velocity"][horizon] == pytest.approx(np.sqrt(np.mean(np.square(estimated))))


def test_log_p_y_and_one_step_coverage_are_kalmans(cart, carts):
    data, found = carts
    exact = kalman(data, cart_parameters(cart))
    seen = data.observed[1:, :, 0]
    spread = (exact.predicted_covariances[1:, :, 0, 0] + cart.measurement_sd**2).sqrt()
    inside = (data.measurements[1:, :, 0] - exact.predicted_means[1:, :, 0]).abs() < 1.644854 * spread
    row = line(found, "right")
    assert row["log_likelihood"] == pytest.approx(float(exact.log_likelihood.mean()))
    assert row["coverage_90"]["one step"] == pytest.approx(float(inside[seen].double().mean()))


def test_a_whole_turn_of_the_true_heading_changes_no_error(dragged):
    program = hovercraft()
    data = for_program(program, dragged)
    turned = data.states.clone()
    turned[..., 2] += 2 * math.pi * (torch.arange(len(data)) % 3)
    one, other = (
        prove({"a": program, "b": program}, table, known_start=True, with_constant_velocity=False)
        for table in (data, replace(data, states=torch.cat([data.states[:1], turned[1:]])))
    )
    for key in (Key("state", "angle", 10), Key("state", "location", 10)):
        assert other.rows["a"].sums[key].value == pytest.approx(one.rows["a"].sums[key].value, rel=1e-4)


@pytest.mark.slow
def test_an_added_effect_is_named():
    truth = hovercraft().with_effect("linear_drag", 0.5).requires_grad_(False)
    truth.duration = 4.0
    data = st.simulate(truth, 8, seed=1)
    found = prove({"before": hovercraft(), "after": truth}, data, known_start=True, with_constant_velocity=False)
    assert found.figures["verdict"].startswith("Adding linear_drag")
    assert " helps: log p(y) +" in found.figures["verdict"]
    back = prove({"before": truth, "after": hovercraft()}, data, known_start=True, with_constant_velocity=False)
    assert back.figures["verdict"].startswith("after is worse than before: log p(y) −")


def test_another_reference_turns_the_signs(dragged, truth):
    found = prove(
        {"before": hovercraft(), "after": truth},
        dragged,
        known_start=True,
        reference="after",
        with_constant_velocity=False,
    )
    assert line(found, "before")["against_reference"]["log_likelihood"]["interval"][1] < 0
    assert found.figures["verdict"].startswith("before is worse than after")


@pytest.mark.slow
def test_without_true_states_there_are_no_errors_of_states(dragged, truth):
    found = prove({"before": hovercraft(), "after": truth}, only_start(dragged), known_start=True)
    assert line(found, "after")["state"] == {} and "location" not in str(found)
    assert line(found, "after")["measurement"]["rad"].keys() == {"one step", "1 s", "3 s"}


def test_figures_are_plain_and_finite(drag, carts):
    for found in (drag, carts[1]):
        assert finite(found.figures)
        assert json.loads(json.dumps(found.figures, allow_nan=False)) == found.figures


def test_the_text_fits_a_hundred_columns_and_says_units(drag, carts):
    for found in (drag, carts[1]):
        text = str(found)
        assert " ".join(text.split()).startswith(found.figures["verdict"])
        assert max(map(len, text.splitlines())) <= 100
    assert "location [m]" in str(drag) and "log p(y) [nats]" in str(drag) and "forward [m/s²]" in str(drag)


def test_a_program_that_blows_up_has_gaps_and_a_note(cart):
    class Explosive(type(cart)):
        def transition(self, state, control, time, step):
            moved = super().transition(state, control, time, step)
            return moved * torch.where(moved.abs() > 3, torch.inf, 1.0).to(moved)

    data = drives(cart, 6, 41)
    found = prove({"calm": cart, "wild": Explosive().double().requires_grad_(False)}, data, known_start=True)
    assert finite(found.figures) and any(note.startswith("wild diverges") for note in found.figures["notes"])
    assert "–" in str(found)


def test_runs_of_different_starts_are_judged_without(cart):
    data = drives(cart, 5, 12)
    fits = {name: st.Fit(cart, "hand", known_start=name == "known") for name in ("known", "unknown")}
    found = prove(fits, data)
    assert not found.known_start and any("known start" in note for note in found.notes)
    assert prove({"one": fits["known"], "two": fits["known"]}, data).known_start


def test_what_cannot_be_proved_is_refused(cart):
    data, rows = drives(cart, 5, 12), {"one": cart, "two": cart}
    with pytest.raises(st.DataError, match="got 4 trajectories: .* at least 5"):
        prove(rows, data.subset(range(4)))
    with pytest.raises(st.DataError, match="nothing to compare"):
        prove(rows, replace(data, observed=torch.zeros_like(data.observed)))
    with pytest.raises(st.DataError, match="no x. columns"):
        prove(rows, data.without_truth(), known_start=True)
    with pytest.raises(st.UsageError, match="got 1 model"):
        prove({"one": cart}, data)
    with pytest.raises(st.UsageError, match="there is no row 'three'; the rows are one, two"):
        prove(rows, data, truth="three")
    with pytest.raises(st.UsageError, match="cannot be called 'noise floor'"):
        prove(rows | {"noise floor": cart}, data)
    with pytest.raises(st.UsageError, match="different measurements cannot be compared"):
        prove({"one": cart, "two": example("pendulum").requires_grad_(False)}, data)


def test_a_program_that_cannot_be_linearised_is_named(cart):
    class Heavy(type(cart)):
        def transition(self, state, control, time, step):
            import pyro
            import pyro.distributions as dist

            position, velocity = state.unbind(-1)
            acceleration = pyro.sample("acceleration", dist.StudentT(3.0, 0.0 * velocity, self.noise))
            return st.stack(position + velocity * step, velocity + acceleration * step)

    rows = {"cart": cart, "heavy": Heavy().double().requires_grad_(False)}
    with pytest.raises(st.UsageError, match="heavy: prove needs models that can be linearised: .*StudentT"):
        prove(rows, drives(cart, 5, 12))


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_writes_figures_and_a_picture(tmp_path, work, capsys):
    table = written(tmp_path / "test.csv", simulated(trajectories=6, rows=33, seed=4))
    files = "--json", tmp_path / "proof.json", "--picture", tmp_path / "proof.png"
    runs = work / "hand", work / "steady"
    assert steady("prove", *runs, table, "--oracle", work / "hand", "--truth", TRUTH, *files) == 0
    content = json.loads((tmp_path / "proof.json").read_text())
    assert content["runs"] == {"hand": str(runs[0]), "steady": str(runs[1]), "oracle": str(runs[0])}
    named = [row["row"] for row in content["rows"]]
    assert named == ["hand", "steady", "oracle", "truth", "constant velocity", "last measurement", "noise floor"]
    assert (tmp_path / "proof.png").read_bytes().startswith(b"\x89PNG")
    assert capsys.readouterr().out.startswith(textwrap.fill(content["verdict"], TEXT_WIDTH))
    assert steady("prove", *runs, table, "--json", "-") == 0
    assert json.loads(capsys.readouterr().out)["reference"] == "hand"


def test_the_command_refuses_without_touching_a_file(tmp_path, work, refused, capsys):
    few, table = work / "train.csv", written(tmp_path / "test.csv", simulated(trajectories=5))
    kept = tmp_path / "proof.json"
    kept.write_text("the old one")
    runs = work / "hand", work / "steady"
    refused(2, "got 3 trajectories", "prove", *runs, few, "--json", kept)
    refused(2, "at least one RUN and then a TABLE", "prove", table)
    refused(2, "ends in one of", "prove", *runs, table, "--picture", tmp_path / "proof.nonsense", "--json", kept)
    refused(2, "cannot be told apart", "prove", work / "hand", work / "hand", table)
    refused(2, "got 1 model", "prove", work / "hand", table)
    refused(2, "--program is given 1 times for 2 runs", "prove", *runs, table, "--program", TRUTH)
    before = contents(tmp_path)
    assert steady("prove", *runs, table, "--json", tmp_path / "nowhere" / "proof.json") == 2
    assert "cannot be written" in capsys.readouterr().err and contents(tmp_path) == before


@pytest.mark.slow
def test_a_table_that_a_run_was_fitted_to_proves_nothing(tmp_path, work, capsys):
    table = written(tmp_path / "test.csv", simulated(trajectories=5, rows=33, seed=4))
    for name, how in (("seen", FEW), ("given", ("--recipe", "hand"))):
        assert steady("fit", HOVERCRAFT, table, *how, "--known-start", "--out", tmp_path / name) == 0
    capsys.readouterr()
    assert steady("prove", tmp_path / "given", tmp_path / "seen", table) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "note: seen was fitted to this very table" in said and "given was fitted" not in said


def by_particles(proof, name: str, change: float | str):
    """A proof in which a particle filter sees so many nats more a drive than the linearised program."""
    row = proof.rows[name]
    sums = {key: value for key, value in row.sums.items() if key.kind != "log_likelihood_by_particles"}
    if isinstance(change, str):
        return replace(proof, rows=proof.rows | {name: replace(row, sums=sums, neglected=change)})
    likely = row.sums[Key("log_likelihood", "", 0)]
    sums[Key("log_likelihood_by_particles", "", 0)] = replace(likely, total=likely.total + change)
    left = torch.full((len(likely.total),), change, dtype=torch.float64)
    return replace(proof, rows=proof.rows | {name: replace(row, sums=sums, neglected=left)})


def test_particles_rule_where_they_see_log_p_y_otherwise(drag) -> None:
    gain = line(drag, "after")["against_reference"]["log_likelihood"]["difference"]
    said = by_particles(drag, "after", -gain - 50.0).figures["verdict"]
    assert said.startswith("after fits worse and predicts better than before: log p(y) by particles (linearised +")
    assert "−50.0 nats a trajectory" in said
    assert "particles" not in by_particles(drag, "after", 0.5).figures["verdict"]
    assert (
        by_particles(drag, "after", 20.0).figures["verdict"].startswith("after is better than before: log p(y) by par")
    )


@pytest.mark.parametrize("who", ["before", "after"])
def test_a_program_that_no_filter_follows_is_named_in_the_sentence(drag, who: str) -> None:
    found = by_particles(drag, who, "its weights blew up")
    assert f"no particle filter follows {who}, so that log p(y) says nothing" in found.figures["verdict"]
    assert found.figures["verdict"].startswith("after is better than before: ")  # by its predictions
    infinite = by_particles(drag, who, math.nan)
    assert "by particles log p(y) is not finite" in infinite.figures["verdict"]


@pytest.mark.parametrize(
    "factor", [0.02, *(pytest.param(one, marks=pytest.mark.slow) for one in (0.03, 0.05, 0.1, 0.2))]
)
def test_programs_that_lose_to_what_knows_nothing_are_said_to_be_no_models(dragged, factor: float) -> None:
    wrong, worse = hovercraft(), hovercraft()
    wrong.mass, worse.mass = (torch.tensor(1.5 * size) for size in (factor, 0.8 * factor))
    found = prove({"before": worse, "after": wrong}, dragged, known_start=True)
    assert found.figures["verdict"].startswith("Neither before nor after is yet a model: 3 s ahead both err more than ")
    only = prove({"before": hovercraft(), "after": wrong}, dragged, known_start=True)
    assert only.figures["verdict"].startswith("after is not yet a model: 3 s ahead it errs more than ")
    back = prove({"before": wrong, "after": hovercraft()}, dragged, known_start=True)
    assert "yet a model" not in back.figures["verdict"]


def test_the_last_measurement_is_a_row_of_its_own(drag, dragged) -> None:
    row = line(drag, "last measurement")
    rows, values = drag.horizons["1 s"], for_program(hovercraft(), dragged).measurements.double()
    apart = torch.remainder(values[rows:] - values[:-rows] + math.pi, 2 * math.pi) - math.pi
    assert row["measurement"]["rad"]["1 s"] == pytest.approx(float(apart.square().mean().sqrt()), rel=1e-5)
    assert row["log_likelihood"] is None and row["scales"] == {"channels": {}, "measurements": {}}
    with pytest.raises(st.UsageError, match="last measurement"):
        prove({"before": hovercraft(), "last measurement": hovercraft()}, dragged)


def test_times_ahead_may_be_asked_for(dragged) -> None:
    found = prove({"a": hovercraft(), "b": hovercraft()}, dragged, known_start=True, horizons=[0.5, 2.0])
    assert list(found.horizons) == ["one step", "0.5 s", "2 s"]
    assert "2-s open-loop error" in found.figures["verdict"]
