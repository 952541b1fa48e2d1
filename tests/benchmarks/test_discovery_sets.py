"""The discovery benchmark's sets are what they say they are, and its rivals see what they should where it is easy."""

import json
import math
from collections import Counter
from pathlib import Path

import discovery_scores
import discovery_sets
import numpy as np
import pytest
import torch
from discovery_limits import plantings, with_effects
from discovery_sets import BenchmarkSet, benchmark_sets, owner, quick, tables
from scipy import stats

from steady_ppl import for_program
from steady_ppl.effects import chosen_variant, find, parsed
from steady_ppl.likelihood.parameters import elements

EVERY = benchmark_sets()
STORED = Path(discovery_sets.__file__).with_name("results") / "discovery.jsonl"


def limits_of(text, known=()):
    """How many detection limits an effect is, at the place where it is planted."""
    name, at, options, value = parsed(text)
    (limit,) = [p.limit for p in plantings(name) if parsed(p.written)[:3] == (name, at, options)]
    change = np.array(value) - find(name, owner(known)).null
    return float(np.linalg.norm(change / np.array(limit)))


def test_the_sets_are_the_same_every_time_and_unlike_each_other():
    assert benchmark_sets() == EVERY
    assert len({one.name for one in EVERY}) == len({one.seed for one in EVERY}) == len(EVERY) <= 600


def test_every_stratum_has_its_sets():
    counts = Counter(one.stratum for one in EVERY)
    assert (counts["clean"], counts["pair"], counts["withheld"]) == (200, 30, 60)
    single = Counter(one.planted[0].partition(":")[0] for one in EVERY if one.stratum == "single")
    assert set(discovery_sets.EFFECTS) == set(single)
    assert min(planting.limit[0] for planting in plantings("coloured_noise")) > 10  # no drive shows it: it is below 1
    assert set(single.values()) == {discovery_sets.SINGLE}


@pytest.mark.parametrize(("stratum", "low", "high"), [("single", 1, 6), ("pair", 3, 6), ("withheld", 2, 6)])
def test_sizes_lie_within_the_stratum(stratum, low, high):
    sizes = [limits_of(text) for one in EVERY if one.stratum == stratum for text in one.effects]
    assert low * 0.999 <= min(sizes) and max(sizes) <= high * 1.001  # they are written with four digits


def test_large_sizes_are_those_that_are_clearly_felt_and_exceed_six_limits():
    for one in (one for one in EVERY if one.stratum == "large"):
        (text,) = one.effects
        effect, value = find(parsed(text)[0], owner()), np.array(parsed(text)[3])
        felt = np.linalg.norm(np.array(effect.typical) - effect.null)
        assert np.linalg.norm(value - effect.null) == pytest.approx(felt, rel=1e-3)
        assert limits_of(text) > 6 or effect.components  # a vector points anywhere


@pytest.mark.slow
def test_no_size_is_more_than_a_vehicle_can_show():
    for text in (text for one in EVERY for text in one.effects):
        effect, value = find(parsed(text)[0], owner()), np.array(parsed(text)[3])
        most = discovery_sets.CAPS.get(effect.name, effect.limit)
        assert np.linalg.norm(value - effect.null) <= most * 1.001
        assert not effect.sign or bool((value > 0).all())


def test_every_effect_applies_to_the_program_that_lacks_it():
    one_of_each = {one.effects[0].rpartition("=")[0]: one for one in EVERY if one.effects}
    for one in one_of_each.values():
        program = with_effects(owner(one.known), one.effects)
        name, at, options, value = parsed(one.effects[0])
        variant = chosen_variant(owner(one.known), name, at, **options)
        assert one.planted[0] == variant.name
        assert torch.allclose(getattr(program, variant.parameter).detach().flatten(), torch.tensor(value))


def test_a_pair_has_two_effects_that_can_be_told_apart():
    for one in (one for one in EVERY if one.stratum == "pair"):
        first, second = one.planted
        assert first.partition(":")[0] != second.partition(":")[0]
        assert discovery_sets.alike(first, second) < discovery_sets.DISTINCT


def test_what_is_withheld_is_what_is_planted():
    withheld = [one for one in EVERY if one.stratum == "withheld"]
    assert all(one.withheld == (one.planted[0].partition(":")[0],) for one in withheld)
    unlike = [discovery_sets.best_alias(one.planted[0]) < 0.7 for one in withheld]
    assert sum(unlike) == 30
    assert not any(one.withheld for one in EVERY if one.stratum != "withheld")


def test_wind_comes_with_the_drag_through_which_it_acts():
    windy = [one for one in EVERY if "wind" in one.planted]
    assert windy and all(one.known == ("quadratic_drag=0.06",) for one in windy)
    assert owner(windy[0].known).quadratic_drag.item() == pytest.approx(parsed(windy[0].effects[0])[2]["drag"])


@pytest.mark.slow
def test_tables_are_the_same_every_time_and_differ_from_each_other():
    chosen = next(one for one in EVERY if one.planted == ("actuator_lag",))
    train, valid, test = tables(chosen)
    assert (len(train), len(valid), len(test)) == (16, 16, 32)
    assert all(table.time.shape[0] == 101 and torch.isfinite(table.states).all() for table in (train, valid, test))
    assert torch.equal(train.measurements, tables(chosen)[0].measurements)
    assert not torch.equal(train.controls, valid.controls) and not torch.equal(valid.controls, test.controls[:, :16])
    for_program(owner(), train)  # it has all that the owner's program reads


def test_the_owner_knows_the_noise_and_learns_everything():
    program = owner()
    assert torch.allclose(program.noise, torch.tensor([0.08, 0.08, 0.05]))
    assert len(elements(program)) == 5


def test_the_quick_benchmark_has_some_of_every_stratum():
    few = quick()
    assert 20 <= len(few) <= 28 and len({one.name for one in few}) == len(few)
    assert {one.stratum for one in few} == {"clean", "single", "large", "pair", "withheld"}


def sharp(known=()):
    """The owner's program with a sensor and a motion so exact that differentiating poses must work."""
    program = owner(known)
    program.bearing_sd, program.noise = math.radians(0.02), torch.tensor([0.004, 0.004, 0.0025])
    return program


@pytest.mark.exhaustive
@pytest.mark.parametrize("rival", ["pysindy", "weak pysindy", "stepwise"])
def test_regressions_find_a_strong_effect_in_exact_measurements(rival, monkeypatch):
    pytest.importorskip("pysindy")
    from discovery_rivals import RIVALS

    monkeypatch.setattr(discovery_sets, "owner", sharp)
    monkeypatch.setattr("discovery_rivals.WINDOWS", (15,))
    strong = BenchmarkSet("strong", "single", ("quadratic_drag=0.06",), 77)
    drives = [table.subset(range(10)) for table in tables(strong)[:2]]
    (ranking,) = RIVALS[rival](drives, sharp()).values()
    assert ranking.detected and ranking.effects[0] == "quadratic_drag"


@pytest.mark.slow
def test_rivals_leave_out_what_is_withheld(monkeypatch):
    pytest.importorskip("pysindy")
    from discovery_rivals import RIVALS

    monkeypatch.setattr("discovery_rivals.WINDOWS", (31,))
    drives = [table.subset(range(4)) for table in tables(EVERY[0])[:2]]
    (ranking,) = RIVALS["stepwise"](drives, owner(), withheld=["quadratic_drag"]).values()
    assert "quadratic_drag" not in ranking.effects and "linear_drag" in ranking.effects


@pytest.mark.exhaustive
def test_what_rivals_say_can_be_stored():
    pytest.importorskip("pysindy")
    from discovery_rivals import RIVALS, fitted

    drives = [table.subset(range(5)) for table in tables(EVERY[0])[:2]]
    base = fitted(drives, owner(), True)
    for rival in ("smoothed residuals", "innovations"):
        for ranking in RIVALS[rival](drives, owner(), known_start=True, base=base).values():
            assert json.loads(json.dumps([ranking.effects[:3], ranking.detected]))[1] in (True, False)


# --- the stored results -----------------------------------------------------------------------------------------------


def records(name: str) -> list[dict]:
    return [json.loads(line) for line in STORED.with_stem(name).read_text().splitlines()]


@pytest.fixture(scope="module", params=["discovery", "discovery-continuous"])
def stored(request: pytest.FixtureRequest) -> list[dict]:
    """The records in worlds that take the program's own step, and in finer ones."""
    return records(request.param)


def test_every_set_has_its_record_by_one_engine(stored):
    assert [record["set"] for record in stored if "failed" in record] == []
    assert {record["set"] for record in stored} == {one.name for one in EVERY} and len(stored) == len(EVERY)
    assert len({record["version"] for record in stored}) == 1


def test_p_values_of_clean_sets_are_uniform_and_one_in_twenty_is_accused(stored):
    clean = [record for record in stored if record["stratum"] == "clean"]
    assert stats.kstest([record["p_value"] for record in clean], "uniform").pvalue > 0.01
    accused = stats.binomtest(sum(record["verdict"] != "none" for record in clean), len(clean))
    low, high = accused.proportion_ci(0.95, "exact")
    assert low <= 0.05 <= high


@pytest.mark.parametrize("name", ["discovery", "discovery-continuous"])
def test_the_stored_table_is_that_of_the_records(name):
    page = STORED.with_stem(name).with_suffix(".md").read_text()
    assert page.startswith(discovery_scores.scores_table(records(name)))


def test_the_stored_comparison_is_that_of_the_records():
    beside = STORED.with_stem("discovery-rivals")
    rivals = [json.loads(line) for line in beside.read_text().splitlines()]
    assert len(rivals) == 140 and not any("failed" in record for record in rivals)
    assert beside.with_suffix(".md").read_text() == discovery_scores.rivals_table(records("discovery"), rivals)
