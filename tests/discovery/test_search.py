"""What a search has found, and what it could have been as well."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from steady_ppl.discovery import candidates, search, search_state
from steady_ppl.discovery.candidates import MAX_NATS_BEHIND, leaders
from steady_ppl.discovery.noise_first import Suited
from steady_ppl.discovery.refits import Refit
from steady_ppl.discovery.search import Found
from steady_ppl.errors import FilterError


def test_a_class_begins_with_what_was_chosen():
    """Also where another gains more, whose own test says nothing."""

    class Stub:
        against_its_sign = False

        def __init__(self, name, total, explains=True):
            self.variant, self.total, self.is_explanation = SimpleNamespace(name=name), total, explains

    named = {"more": 10.5, "chosen": 10.0, "near": 8.5, "far": 7.0}
    more, chosen, near, far = (Stub(*pair) for pair in named.items())
    elsewhere = Stub("chosen", 9.9)  # itself, at another knee
    coloured = Stub("coloured", 900.0, explains=False)
    found = Found(chosen, [coloured, more, chosen, elsewhere, near, far], None)
    assert found.aliases == [chosen, more, near] and coloured not in found.rivals
    assert Found(coloured, [coloured, more], None).rivals == [coloured, more]


@pytest.mark.parametrize("first", [True, False])
def test_of_an_effect_on_measurements_the_two_columns_are_refitted_where_it_tells_most(first):
    def tested(name, form="push", p_value=1e-6, at=""):
        variant = SimpleNamespace(effect=SimpleNamespace(name=name, form=form), at=at)
        return SimpleNamespace(variant=variant, p_value=p_value, untestable=None, departure=False, is_curve=False)

    drags = [tested(f"drag_{axis}") for axis in range(3)]
    biases = [tested("sensor_bias", "measured", at=f"range_{column}") for column in range(30)]
    weak = tested("wind", p_value=0.5)
    ranked = [biases[0], drags[0], *biases[1:], *drags[1:], weak]
    correlations = torch.eye(len(ranked))
    correlations[0, ranked.index(biases[20])] = 0.95  # looks like the first
    chosen = leaders(SimpleNamespace(tested=ranked, correlations=correlations), first)
    best = [biases[0], drags[0], biases[1], biases[20], *drags[1:], *[weak] * first]
    assert chosen == best  # six at least in the first round, aliases beside them


class Chosen:
    """A candidate of so many nats, significant and judged."""

    is_judged, is_confirmed, against_its_sign = True, True, False

    def __init__(self, name, total, explains=True, profiled=()):
        self.name, self.total, self.is_explanation = name, total, explains
        self.refit, self.variant = (
            object.__new__(Refit),
            SimpleNamespace(name=name, profiled=profiled, effect=SimpleNamespace(name=name)),
        )

    def significant(self, critical):
        return self.total > 2


@pytest.mark.parametrize(
    ("totals", "expected"),
    [
        ({"coloured": (100.0, False), "drag": (30.0, True), "bias": (5.0, True)}, "drag"),
        ({"coloured": (100.0, False), "drag": (1.0, True)}, "coloured"),
        ({"coloured": (1.0, False), "drag": (1.0, True)}, None),
    ],
)
def test_coloured_noise_enters_where_nothing_else_is_significant(monkeypatch, totals, expected):
    candidates = [Chosen(name, *told) for name, told in totals.items()]
    screening = leading(monkeypatch, " ".join(totals))

    def refits(now, chosen, *_):
        return [one for one in candidates if one.name in [tested.variant.name for tested in chosen]]

    monkeypatch.setattr(search, "_refits", refits)
    found = search.Search(None, base=None, final=None, step=None, gained=0.0)
    assert search._add_best(found, screening, 1) == (expected is not None)
    assert [one.candidate.name for one in found.found] == ([expected] if expected else [])


def test_what_loses_or_imitates_sets_no_bar_for_what_is_fitted_after_it(monkeypatch):
    """Else a coloured noise that explains the drives it was fitted to has all physical effects given up."""

    def fitted(name, drives, held_out, explains=True):
        one = Chosen(name, held_out, explains)
        path, alone = SimpleNamespace(log_likelihood=torch.tensor([drives])), torch.tensor([held_out])
        for attribute, value in (
            ("maxima", [path]),
            ("held_out_alone", alone),
            ("folds", [SimpleNamespace(held_out=[0])]),
        ):
            object.__setattr__(one.refit, attribute, value)
        return one

    drag, broken = fitted("drag", 100.0, 90.0), fitted("broken", 1e6, -1e6)
    coloured = fitted("coloured", 900.0, 800.0, explains=False)
    bar = search._threshold([coloured, broken, drag])
    assert bar == search._threshold([drag]) and bar.drives == pytest.approx(100.0 - MAX_NATS_BEHIND)
    seen, kinds = [], {"coloured": "noise", "drag": "dynamics"}
    tested = [
        SimpleNamespace(variant=SimpleNamespace(label=n, effect=SimpleNamespace(verdict=k))) for n, k in kinds.items()
    ]
    monkeypatch.setattr(search, "attempts", lambda now, chosen, screening: seen.extend(chosen) or [])
    assert search._refits(None, tested, SimpleNamespace(tests=None), []) == []
    assert [one.variant.label for one in seen] == ["drag", "coloured"]


@pytest.mark.parametrize(("total", "expected"), [(25.0, "lever"), (20.0, "limit"), (9.0, "limit")])
def test_what_was_given_up_is_judged_after_all_where_it_is_ahead_of_what_a_filter_leaves(monkeypatch, total, expected):
    """It stayed behind a limit whose linearised log p(y) promises ten nats more than a filter finds."""
    limit, lever = Chosen("limit", 30.0), Chosen("lever", total)
    limit.is_confirmed = lever.is_judged = lever.is_confirmed = False
    lever.tested = "test"
    monkeypatch.setattr(Refit, "coefficient", lambda self, variant: 3.5)
    monkeypatch.setattr(search, "at_its_best_place", lambda now, candidate: candidate)
    asked = []

    def refit_with(now, variant, begin):
        asked.append((now, variant.name, begin))
        return "refit"

    def judge(now, tested, refit):
        assert (now, tested, refit) == ("now", "test", "refit")
        return Chosen("lever", total)

    def confirm(self, candidate):
        return Chosen(candidate.name, candidate.total - 10.0 * (candidate is limit))

    monkeypatch.setattr(search, "refit_with", refit_with)
    monkeypatch.setattr(search, "judged", judge)
    monkeypatch.setattr(search.ParticleJudge, "confirm", confirm)
    ranking = search.partial(search.first_enough, lambda c: c.total > 2)
    best, ranked = search._chosen(search.ParticleJudge("now"), [lever, limit], ranking)
    assert best.name == expected and best.total == max(20.0, total) and len(ranked) == 2
    assert asked == [("now", "lever", 3.5)] * (expected == "lever")


def test_a_knee_is_moved_beside_what_is_added_after_it(monkeypatch):
    knee, moved, later = (Chosen(name, 10.0, profiled={name: 1.0}) for name in ("knee", "moved", "later"))
    knee.tested = SimpleNamespace(at=lambda variant: variant)
    final = SimpleNamespace(name="knee", profiled={"knee": 2.0})
    moved.refit.__dict__["programs"] = ["moved"]
    monkeypatch.setattr(search_state, "attached", lambda program: [final] if program == "moved" else [])
    monkeypatch.setattr(search_state, "replace", lambda one, **to: SimpleNamespace(**{**vars(one), **to}))
    monkeypatch.setattr(candidates, "likelier_places", lambda base, begun, at: [(at, begun), (final, "fits")])
    monkeypatch.setattr(candidates, "judged_fits", lambda fits: moved.refit)
    first = search.Found(knee, [knee], None)
    found = search.Search(None, base=None, final=later.refit, step=None, gained=0.0, found=[first])
    search._place_again(found, first)
    assert found.final is moved.refit and found.found[0].candidate.tested is final


def test_what_imitates_anything_is_not_carried(monkeypatch):
    """It waits for the tests at the finer step."""
    monkeypatch.setattr(search, "_fitted_again", lambda now, one: one)
    monkeypatch.setattr(search, "attached", lambda program: [])
    monkeypatch.setattr(Refit, "program", None)
    base, coloured = object.__new__(Refit), Chosen("coloured", 30.0, explains=False)
    here = search.Search(base, base, base, None, 0.0)
    search._carry(here, [Found(coloured, [coloured], None)])
    assert not here.found


def test_what_is_carried_has_its_earlier_knees_moved_beside_it(monkeypatch):
    """Else what they leave at a wrong knee looks like something else: a sensor's scale, in a linear drive's log."""
    friction, drag = Chosen("friction", 30.0), Chosen("drag", 20.0)
    asked = []
    monkeypatch.setattr(search, "_fitted_again", lambda now, one: one)
    monkeypatch.setattr(search, "_place_again", lambda found, one: asked.append((one.candidate.name, len(found.found))))
    monkeypatch.setattr(search, "attached", lambda program: [])
    monkeypatch.setattr(Refit, "program", None)
    base = object.__new__(Refit)
    here = search.Search(base, base, base, None, 0.0)
    search._carry(here, [Found(friction, [friction], None), Found(drag, [drag], None)])
    assert asked == [("friction", 2)]


def leading(monkeypatch, names: str) -> SimpleNamespace:
    """Tests that put these effects first, by their names."""
    forms = {"coloured": "colour"}
    tested = [
        SimpleNamespace(variant=SimpleNamespace(name=name, effect=SimpleNamespace(form=forms.get(name, "push"))))
        for name in names.split()
    ]
    monkeypatch.setattr(search, "leaders", lambda tests, first: tested)
    return SimpleNamespace(tests=SimpleNamespace(p_value=0.0, critical=0.01, tested=[]))


@pytest.mark.parametrize(
    ("near", "enough", "groups"),
    [
        (None, "", ["lag drag wind", "", "coloured"]),
        (None, "wind", ["lag drag wind"]),
        ({"drag"}, "", ["lag drag", "wind", "coloured"]),
        ({"drag"}, "wind", ["lag drag", "wind"]),
        ({"drag"}, "drag", ["lag drag"]),
        (set(), "coloured", ["lag", "drag wind", "coloured"]),
    ],
)
def test_what_came_near_is_fitted_first_and_what_imitates_anything_last(monkeypatch, near, enough, groups):
    """At a finer step only what the coarser one or the tests point at, unless that is not enough."""
    screening, seen = leading(monkeypatch, "coloured lag drag wind"), []

    def refits(now, chosen, *_):
        names = [tested.variant.name for tested in chosen]
        seen.append(" ".join(names))
        return [Chosen(name, 9.0 if name == enough else 0.0) for name in names]

    monkeypatch.setattr(search, "_refits", refits)
    found = search.Search(None, base=None, final=None, step=None, gained=0.0)
    assert search._add_best(found, screening, 1, near) == bool(enough)
    assert seen == groups and [one.candidate.name for one in found.found] == enough.split()


@pytest.mark.parametrize(("curve", "expected"), [(100.0, None), (1.0, "coloured")])
def test_in_the_first_round_coloured_noise_waits_for_curves(monkeypatch, curve, expected):
    screening = leading(monkeypatch, "coloured lag")
    coloured = Chosen("coloured", 50.0, explains=False)
    monkeypatch.setattr(
        search, "_refits", lambda now, chosen, *_: [coloured for t in chosen if "col" in t.variant.name]
    )
    monkeypatch.setattr(search, "_curves", lambda found: [SimpleNamespace(total=curve)])
    monkeypatch.setattr(search.Search, "curve", property(lambda self: self.curves[0].total > 3 or None))
    found = search.Search(None, base=None, final=None, step=None, gained=0.0)
    assert search._add_best(found, screening, 0) == bool(expected)
    assert [one.candidate.name for one in found.found] == ([expected] if expected else [])


def quiet_round():
    tests = SimpleNamespace(p_value=0.5, tested=[], critical=0.01)
    return search.Round(SimpleNamespace(tests=tests), [], None)


@pytest.fixture
def asking(monkeypatch):
    """A search that has found a drag, beside which its step is too coarse, and how to say what its rounds come to."""
    base = SimpleNamespace(maxima=[SimpleNamespace(gained=0.0)], program=None)
    monkeypatch.setattr(search, "_require_resolved", lambda base: None)
    cleaned = (base, Suited(base, []), 2 * [SimpleNamespace(left=None)], base)
    monkeypatch.setattr(search, "without_outliers", lambda *_: cleaned)
    monkeypatch.setattr(search, "with_suitable_noise", lambda base, wanted, tails: Suited(base, []))
    monkeypatch.setattr(search, "_step_of", lambda refit: SimpleNamespace(too_coarse=False))
    monkeypatch.setattr(search, "first_refit", lambda *_, **__: base)
    monkeypatch.setattr(search, "with_substeps", lambda program, count: f"{count} substeps")
    found = [Found(Chosen("drag", 9.0), [], None)]
    coarse = search.Search(base, base, base, None, 0.0, found=found, rounds=[quiet_round()])
    coarse.asks = SimpleNamespace(suited=SimpleNamespace(substeps=4))

    def come_to(*outcomes):
        """Run the search, whose rounds come to these, one after another; it and how each was asked for."""
        left, asked = list(outcomes), []

        def rounds(fresh, settings, carried=(), *, looks_at_step=True):
            asked.append((settings.declared, [one.candidate.name for one in carried], looks_at_step, fresh.with_found))
            outcome = left.pop(0)
            if isinstance(outcome, BaseException):
                raise outcome
            return outcome

        monkeypatch.setattr(search, "_rounds", rounds)
        problem = SimpleNamespace(program=None, data=None, known_start=False)
        return search.search(problem, None, search.Settings(declared=None)), asked

    return coarse, come_to


def test_a_search_begins_again_at_the_step_for_which_what_was_found_asks(asking):
    coarse, come_to = asking
    finer = search.Search(None, None, None, None, 0.0)
    found, asked = come_to(coarse, finer)
    assert found is finer
    assert asked == [(None, [], True, None), ("4 substeps", ["drag"], False, coarse.asks)]


def test_where_finer_time_steps_fail_the_search_ends_at_its_own_step(asking, monkeypatch):
    coarse, come_to = asking
    ended = []
    monkeypatch.setattr(search, "_end", lambda found, settings: ended.append(found))
    found, _ = come_to(coarse, RuntimeError("the tide is out"))
    assert found is coarse and ended == [coarse] and found.is_complete
    assert found.notes == ["what was found was not looked at in finer time steps: RuntimeError: the tide is out"]


def test_an_interrupt_at_a_finer_time_step_leaves_the_coarser_search(asking):
    coarse, come_to = asking
    again = search.Search(None, None, None, None, 0.0)
    again.interrupt(search.LOOKING)
    for outcome in (again, KeyboardInterrupt(search.NOTHING_TESTED)):
        found, _ = come_to(coarse, outcome)
        assert found is coarse and found.interrupted == search.FINER and not found.is_complete
        assert found.notes[-1].startswith("what was found asks for 4 substeps a row")
    later = search.Search(None, None, None, None, 0.0)
    later.interrupt("fitting curves")
    coarse.interrupted = ""
    assert come_to(coarse, later)[0] is later


def test_an_interrupt_while_steps_are_compared_ends_the_search(monkeypatch):
    """Effects are tested then; no curve is fitted any more."""

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(search, "_add_all", lambda *_: None)
    monkeypatch.setattr(search, "_look_at_step", stopped)
    monkeypatch.setattr(search, "_end", lambda *_: pytest.fail("it goes on"))
    found = search._rounds(search.Search(None, None, None, None, 0.0, rounds=[quiet_round()]), None)
    assert found.interrupted == search.FINER and found.cut_short


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), RuntimeError("the tide is out")])
def test_what_was_found_stays_where_curves_cannot_be_fitted(monkeypatch, failure):
    def stopped(*_):
        raise failure

    monkeypatch.setattr(search, "_curves", stopped)
    found = search.Search(None, None, None, None, 0.0, rounds=2 * [quiet_round()])
    found.found = 2 * [Found(Chosen("drag", 9.0), [], None)]
    search._end(found, None)
    if isinstance(failure, KeyboardInterrupt):
        assert found.interrupted == "fitting curves"
    else:
        assert found.notes == ["curves and corrections were not looked at to the end: RuntimeError: the tide is out"]


def test_a_curve_is_asked_only_of_what_a_filter_has_left(monkeypatch):
    """Fitting one costs more than a filter."""
    drag, bias = Chosen("drag", 30.0), Chosen("bias", 9.0)
    drag.is_confirmed = bias.is_confirmed = False
    asked = []

    def admits(self, candidate):
        asked.append((candidate.name, candidate.is_confirmed))
        return True

    def confirm(self, candidate):
        return Chosen(candidate.name, 1.0 if candidate is drag else candidate.total)

    screening = leading(monkeypatch, "drag bias")
    monkeypatch.setattr(search.CurveJudge, "admits", admits)
    monkeypatch.setattr(search.ParticleJudge, "confirm", confirm)
    monkeypatch.setattr(search, "_refits", lambda *_: [drag, bias])
    found = search.Search(None, base=None, final=None, step=None, gained=0.0)
    assert search._add_best(found, screening, 1)
    assert [one.candidate.name for one in found.found] == ["bias"] and asked == [("bias", True)]


@pytest.mark.parametrize("outcome", [RuntimeError("the tide is out"), True, False])
def test_what_was_found_is_looked_at_in_finer_time_steps(monkeypatch, outcome):
    looked = []

    def step_of(refit, **watched):
        looked.append(watched["watched"])
        if isinstance(outcome, Exception):
            raise outcome
        return SimpleNamespace(too_coarse=outcome)

    monkeypatch.setattr(search, "_step_of", step_of)
    monkeypatch.setattr(search, "attached", lambda program: program)
    found = search.Search(None, None, SimpleNamespace(program=[SimpleNamespace(parameter="drag")]), None, 0.0)
    search._look_at_step(found)
    assert not looked  # nothing was found
    found.found = [Found(Chosen("drag", 9.0), [], None)]
    search._look_at_step(found)
    assert looked == [["drag"]] and (found.asks is not None) == (outcome is True)
    is_failed = isinstance(outcome, Exception)
    assert found.notes == is_failed * [search.NOT_FINER.format("RuntimeError: the tide is out")]


@pytest.mark.parametrize("asks", [True, False])
def test_curves_are_fitted_at_the_last_step_alone(monkeypatch, asks):
    found, done = search.Search(None, None, None, None, 0.0), []
    monkeypatch.setattr(search, "_add_all", lambda *_: done.append("add"))
    monkeypatch.setattr(search, "_look_at_step", lambda found: setattr(found, "asks", "step" if asks else None))
    monkeypatch.setattr(search, "_end", lambda *_: done.append("end"))
    assert search._rounds(found, None) is found
    assert done == ["add", *([] if asks else ["end"])]
    done.clear()
    assert search._rounds(search.Search(None, None, None, None, 0.0), None, looks_at_step=False) and len(done) == 2


@pytest.mark.parametrize(
    ("totals", "added"),
    [
        ({"drag": 10.0, "near": 28.0, "far": 99.0, "bias": 1.0}, [("near", ["near", "drag"])]),
        ({"drag": 10.0, "near": 9.0, "bias": 5.0}, [("drag", ["drag", "near"]), ("bias", ["bias"])]),
        ({"drag": 0.0, "near": 1.0, "bias": 0.0}, []),
    ],
)
def test_what_was_found_at_a_coarser_step_is_fitted_among_its_rivals_there(monkeypatch, totals, added):
    drag, near, far, bias, lag = (
        Chosen(*told) for told in (("drag", 30.0), ("near", 25.0), ("far", 9.0), ("bias", 20.0), ("lag", 40.0))
    )
    monkeypatch.setattr(search, "_fitted_again", lambda now, one: Chosen(one.name, totals[one.name]))
    monkeypatch.setattr(search, "attached", lambda program: [SimpleNamespace(name="lag")])
    monkeypatch.setattr(Refit, "program", None)
    base = object.__new__(Refit)
    here = search.Search(base, base, base, None, 0.0)
    carried = [Found(lag, [lag], None), Found(drag, [drag, near, far], None), Found(bias, [bias], None)]
    final = here.final
    search._carry(here, carried)
    assert [(one.candidate.name, [c.name for c in one.candidates]) for one in here.found] == added
    assert here.final is (here.found[-1].candidate.refit if added else final)
    befores = [final, *(one.candidate.refit for one in here.found)]
    assert all(one.without is before for one, before in zip(here.found, befores, strict=False))


@pytest.mark.parametrize("carried", [[], [Found(SimpleNamespace(is_explanation=True, refit=None), [], None)]])
def test_without_tests_of_what_was_carried_the_search_at_a_finer_step_fails(monkeypatch, carried):
    """An ordinary search takes back what was added last: its last tests are of the program that is left."""

    def screen(settings, now, index):
        if index:
            raise RuntimeError("the tide is out")
        return SimpleNamespace(tests=None)

    def add(found, screening, index, near):
        assert near == (set() if carried else None)
        found.found = [Found(SimpleNamespace(variant=SimpleNamespace(label="drag")), [], "base")]
        return True

    monkeypatch.setattr(search.Settings, "screen", screen)
    monkeypatch.setattr(search, "_add_best", add)
    monkeypatch.setattr(search, "_carry", lambda found, carried: None)
    found = search.Search(None, "base", "base", None, 0.0)
    if carried:
        with pytest.raises(RuntimeError, match="tide"):
            search._add_all(found, search.Settings(declared=None), carried)
    else:
        search._add_all(found, search.Settings(declared=None), carried)
        assert found.taken_back == {"drag": "RuntimeError: the tide is out"} and found.final == "base"


def test_programs_are_not_compared_where_rounding_moves_log_p_by_more_than_what_counts():
    def base(likely, dtype):
        drives = SimpleNamespace(labels=("early", "late"), measurements=torch.zeros(1, dtype=dtype))
        maximum = SimpleNamespace(log_likelihood=torch.tensor([-10.0, likely]))
        return SimpleNamespace(folds=[SimpleNamespace(drives=drives)], maxima=[maximum])

    with pytest.raises(FilterError, match=r"trajectory late: its log p\(y\) is -3e\+07 nats") as raised:
        search._require_resolved(base(-3e7, torch.float32))
    assert raised.value.trajectory == "late"
    search._require_resolved(base(-2e7, torch.float32))
    search._require_resolved(base(-3e7, torch.float64))
