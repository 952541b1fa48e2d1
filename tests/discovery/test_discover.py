"""A search where a drag is missing and one where nothing is: what `discover` names, says and keeps."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from planted_drives import DRIVES, SETS, discovered, owner, tables, with_effects
from small import finite

import steady_ppl as st
from steady_ppl.discovery.discover import _note_of_one_drive
from steady_ppl.discovery.finding import _Spreads


@pytest.fixture(scope="module")
def dragged() -> st.Discovery:
    return discovered("quadratic_drag=0.05")


@pytest.fixture(scope="module")
def clean() -> st.Discovery:
    return discovered()


def test_what_it_fits_says_how_well_the_drives_tell_it(dragged, tmp_path):
    train, valid = tables(with_effects(owner(), "quadratic_drag=0.05"))
    for fit in (dragged.before, dragged.after):
        known = fit.information
        assert known is not None and known.suits(fit.program)
        assert known.has_seen(st.for_program(fit.program, train)) and known.has_seen(st.for_program(fit.program, valid))
        assert known.gain < 0.5  # nats: the mean of two folds' fits is nearly that to all of their drives
    known = dragged.after.information
    sd = known.matrix.inverse().diagonal().sqrt()[known.names.index("quadratic_drag")]
    assert float(sd) == pytest.approx(dragged.findings[0].sd[0], rel=0.3)  # which is of a fit to each fold
    dragged.after.save(tmp_path / "run")
    again = st.Fit.load(tmp_path / "run").information
    assert again is not None and torch.equal(again.matrix, known.matrix) and again.drives == known.drives


def test_a_missing_drag_is_found_with_its_coefficient(dragged):
    assert dragged.verdict == "dynamics" and dragged.p_value < 0.05
    (finding,) = dragged.findings
    assert finding.aliases[0] == "quadratic_drag" and finding.confidence > 0.8
    assert abs(finding.coefficient[0] - 0.05) < 4 * finding.sd[0]
    low, high = finding.interval[0]
    assert low < finding.coefficient[0] < high
    assert high - low == pytest.approx(2 * 1.645 * finding.sd[0], rel=1e-3)


def test_the_error_falls_and_the_noise_with_it(dragged):
    before, after = dragged.figures["before"], dragged.figures["after"]
    assert after["log_likelihood"] > before["log_likelihood"] + 2
    assert after["measurement"]["rad"]["3 s"] < 0.9 * before["measurement"]["rad"]["3 s"]
    noise = [max(side["scales"]["channels"].values()) for side in (before, after)]
    assert noise[0] > 1.5 * noise[1]


def test_the_improved_fit_has_the_effect_and_can_be_kept(dragged, tmp_path):
    program = dragged.after.program
    assert float(program.quadratic_drag.detach()) == pytest.approx(dragged.findings[0].coefficient[0])
    dragged.after.save(tmp_path / "run")
    again = st.Fit.load(tmp_path / "run")
    assert float(again.program.quadratic_drag.detach()) == pytest.approx(dragged.findings[0].coefficient[0])


def test_clean_drives_give_none_and_say_what_could_have_been_seen(clean):
    assert clean.verdict == "none" and clean.p_value > 0.05
    assert clean.findings == [] and clean.shape is None and clean.figures["effect"] is None
    limits = {one["effect"]: one["detection_limit"] for one in clean.figures["candidates"]}
    assert 0 < limits["linear_drag"] < 0.2 and 0 < limits["bearing_bias"] < 0.1
    assert len(limits["slope"]) == 2
    assert clean.figures["before"] == clean.figures["after"]


def test_a_gain_of_one_drive_is_said_to_be(dragged):
    (found,) = dragged.search.found
    assert _note_of_one_drive(found) == ""
    gain = torch.zeros(2 * DRIVES)
    gain[13] = 9.0
    alone = replace(found, candidate=replace(found.candidate, gain=gain))
    assert _note_of_one_drive(alone).startswith("without training trajectory 4 nothing would be left")


def test_what_was_found_comes_first_among_the_candidates(dragged):
    assert dragged.figures["candidates"][0]["effect"] == "quadratic_drag"
    assert dragged.figures["candidates"][1]["heldout_gain"] is not None


def test_what_cannot_be_tested_says_why(clean):
    notes = {one["effect"]: one["note"] for one in clean.figures["candidates"]}
    assert notes["process_noise:yaw"] == "the fitted noise against the declared"


@pytest.mark.slow
def test_a_run_that_has_an_effect_is_searched_for_the_next_one(dragged, tmp_path):
    dragged.after.save(tmp_path / "run")
    train, valid = tables(with_effects(owner(), "quadratic_drag=0.05"))
    again = st.discover(st.Fit.load(tmp_path / "run"), train, valid, simulations=SETS)
    assert "quadratic_drag" not in [finding.variant.name for finding in again.findings]
    assert again.before.known_start


SCHEMA = {
    "verdict": str,
    "p_value": float,
    "effect": (str, type(None)),
    "class": list,
    "confidence": (float, type(None)),
    "candidates": list,
    "shape": (dict, type(None)),
    "next_run": (dict, type(None)),
    "before": dict,
    "after": dict,
}
CANDIDATE = {
    "effect": str,
    "kind": str,
    "statistic": float,
    "p_value": float,
    "coefficient": (float, list, type(None)),
    "sd": (float, list, type(None)),
    "unit": str,
    "detection_limit": (float, list, type(None)),
    "heldout_gain": (float, type(None)),
    "heldout_gain_ci": (list, type(None)),
}


def test_the_figures_keep_to_the_schema(dragged, clean):
    for found in (dragged, clean):
        figures = json.loads(json.dumps(found.figures, allow_nan=False))
        assert finite(figures)
        for key, kind in SCHEMA.items():
            assert isinstance(figures[key], kind), key
        assert figures["verdict"] in ("none", "dynamics", "actuator", "sensor", "noise", "other")
        for candidate in figures["candidates"]:
            for key, kind in CANDIDATE.items():
                assert isinstance(candidate[key], kind), (candidate["effect"], key)
        names = [candidate["effect"] for candidate in figures["candidates"]]
        assert len(names) == len(set(names))


def test_the_text_says_the_verdict_first(dragged, clean):
    assert str(dragged).startswith("The dynamics lack quadratic_drag = 0.0")
    assert "a = -c v |v|" in str(dragged) and "open-loop error −" in str(dragged)
    assert str(clean).startswith("No effect is missing as far as these trajectories can tell (p = ")
    assert all(len(line) <= 125 for line in str(dragged).splitlines())


def test_the_sd_of_an_effect_whose_program_was_not_tested_is_what_is_observed_there(dragged):
    (finding,) = dragged.findings
    untested = replace(dragged.search, rounds=dragged.search.rounds[:1])
    assert _Spreads(untested)(finding.variant) == pytest.approx(finding.sd, rel=0.3)
    maximum = replace(dragged.search.final.maxima[0], information=torch.zeros(0, 0))
    by_draws = replace(untested, final=replace(dragged.search.final, maxima=[maximum]))
    tested = dragged.search.found[0].candidate.tested
    assert _Spreads(by_draws)(finding.variant) == pytest.approx(tested.sd * dragged.search.final.first_share**0.5)


@pytest.mark.parametrize("failure", [None, ZeroDivisionError("of the program's own")])
def test_where_nothing_can_be_observed_a_note_says_whose_intervals_these_are(dragged, monkeypatch, failure):
    def observed(*_):
        if failure:
            raise failure

    monkeypatch.setattr("steady_ppl.discovery.finding.observed", observed)
    (finding,) = dragged.findings
    untested = replace(dragged.search, rounds=dragged.search.rounds[:1], notes=[])
    spread = _Spreads(untested)
    assert spread(finding.variant).tolist() == spread(finding.variant).tolist()
    assert (spread(finding.variant) > 0).all()
    (note,) = untested.notes
    assert note.endswith("ZeroDivisionError: of the program's own" if failure else "it diverges beside what was found")
