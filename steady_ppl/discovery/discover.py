"""Learn which physical effect a program lacks, after a look at what the search needs; a search can be resumed."""

import copy
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch

from steady_ppl.comparison.prove import doubtful, prove
from steady_ppl.comparison.scores import MIN_DRIVES
from steady_ppl.data.table import refuse_long
from steady_ppl.data.trajectories import Trajectories, concatenated
from steady_ppl.discovery.candidates import TIE_NATS
from steady_ppl.discovery.finding import NextRun, corrections, findings, next_run, shape_of
from steady_ppl.discovery.fitting import ByDraws
from steady_ppl.discovery.refits import Refit, with_states_of
from steady_ppl.discovery.result import Discovery
from steady_ppl.discovery.search import Settings, search
from steady_ppl.discovery.search_state import MAX_EFFECTS, Found, Search
from steady_ppl.effects import catalogue, of_name, record, restore, written_class
from steady_ppl.effects.declaration import VERDICT_OF_FORM
from steady_ppl.errors import DataError, FilterError, UsageError
from steady_ppl.gaussian.linearize import require_linear
from steady_ppl.kernels.rows import fallback_notes, kernel_failures
from steady_ppl.likelihood.information import ParameterInformation, information_of_fit
from steady_ppl.likelihood.outliers import find_outliers
from steady_ppl.likelihood.parameters import elements
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import with_substeps
from steady_ppl.runs.diagnostics import diagnose_units
from steady_ppl.runs.fit import Fit
from steady_ppl.runs.folder import JOURNAL, require_same, run_folder, write_record
from steady_ppl.runs.recipes import begun_record
from steady_ppl.training.loop import Trained
from steady_ppl.utils.cores import one_thread
from steady_ppl.utils.journal import journal
from steady_ppl.utils.progress import stages
from steady_ppl.utils.random import seeded
from steady_ppl.utils.text import reason_of

Later = TypeVar("Later")

MAX_UNREPORTED_GAIN = 10.0  # nats that fitting a run further may gain before it is said
MIN_SETS = 50  # simulated sets for the calibration
COMPARING, PROPOSING = "comparing before and after", "looking for a better next trajectory"
NOT_CONVERGED = "the model's own fit has not converged: no ranking below is to be trusted"


@one_thread()
def discover(
    program: Program | Fit,
    train: Trajectories,
    valid: Trajectories | None = None,
    *,
    known_start: bool | None = None,
    mix: bool = False,
    declared: Program | None = None,
    simulations: int = 200,
    withheld: Sequence[str] = (),
    only: Sequence[str] = (),
    seed: int = 0,
) -> Discovery:
    """Find the physical effects that a program lacks.

    Every effect of the catalogue is tested at once and the test calibrated by simulated trajectories; the leaders are
    fitted and chosen by log p(y) of trajectories that they were not fitted to; so on until the tests are quiet. An
    interrupt (Ctrl-C) after the first tests ends the search with what it has found, and `search.interrupted` says so.

    Args:
        program: a program or a fit of one, with normal noise and at most some dozens of learnable numbers; it is not
            changed, and fitted first.
        train: trajectories to test and fit.
        valid: trajectories to choose by; every second trajectory of `train` when None.
        known_start: take the first row's x. columns as the exact start; a fit's own setting when None.
        mix: put both tables together and keep every second trajectory to choose by; for tables that are not alike, one
            of them with rougher trajectories.
        declared: the program with the noise scales that its owner believes; the program's class afresh when a fit is
            given, else `program`.
        simulations: sets of trajectories for the calibration, at least 50.
        withheld: names of effects to leave out of the catalogue.
        only: the kinds of effects to look for (dynamics, actuator, sensor, noise); all of them where none is named.
        seed: of the simulated sets.

    Raises:
        UsageError: a network, a program that cannot be linearised, too few simulations, no such effect to leave out, no
            such kind, or one table to mix.
        DataError: too few trajectories, no known start, or controls that identify nothing.
        FilterError: the program cannot be fitted.

    Example:
        >>> import steady_ppl as st  # doctest: +SKIP
        >>> print(st.discover(st.load_program("mine.py"), st.read_table("drives.csv")))  # doctest: +SKIP
    """
    for what, names, kind in (("withheld", withheld, "effects"), ("only", only, "kinds")):
        if isinstance(names, str):
            raise UsageError(f"{what} is a list of {kind}, got {names!r}")
    for name in withheld:
        of_name(name)
    kinds = dict.fromkeys(VERDICT_OF_FORM.values())
    for name in only:
        if name not in kinds:
            raise UsageError(f"no kind of effects {name!r}; there are {', '.join(kinds)}")
    is_fitted = isinstance(program, Fit) and program.recipe != "hand"
    if isinstance(program, Fit):
        known_start = program.known_start if known_start is None else known_start
        declared = declared or _as_written(program.program)
        program = program.program
    known_start = bool(known_start)
    program = copy.deepcopy(program).cpu()
    declared = copy.deepcopy(declared or program).cpu()
    settings = Settings(declared, simulations, seed=seed, withheld=withheld, only=only)
    if not any(map(settings.wants, catalogue(program))):
        kind = f"of {' and '.join(only)} that" if only else "that"
        raise UsageError(f"nothing to look for: no effect {kind} is not withheld applies to the model")
    notes: list[str] = []
    if mix:
        if valid is None:
            raise UsageError("mix puts two tables together: name the second one (--valid)")
        train, valid = concatenated(train=train, valid=valid), None
    if valid is None:
        if len(train) < 2 * MIN_DRIVES:
            raise DataError(
                f"{len(train)} trajectories are too few: {2 * MIN_DRIVES} are needed, half of them to choose by, "
                "because the unit that is resampled is the trajectory"
            )
        valid = train.subset(range(1, len(train), 2))
        train = train.subset(range(0, len(train), 2))
        kept = f"{len(valid)} of the {len(train) + len(valid)} trajectories were kept to choose by"
        notes.append(f"the tables were mixed: {kept}" if mix else f"no validation trajectories were given: {kept}")
    problem, choosing = (Problem.of_table(program, table, known_start) for table in (train, valid))
    require_searchable(problem, choosing.data, simulations)
    with stages(("", 8), (COMPARING, 1), (PROPOSING, 1)) as begin:
        begin()
        with seeded(seed, "search"), kernel_failures() as why:
            found = _searched(problem, choosing.data, settings)
        begin()
        shape = shape_of(found, program)
        effects = corrections(found) if shape else findings(found)
        better = found.curve.refit if found.curve else found.final
        assert isinstance(better, Refit)
        rows = {"before": found.as_it_stands.judges.programs[0], "after": better.judges.programs[0]}
        judges = found.base.folds[0].held_out  # the validation drives without outliers
        settings_of_proof: dict[str, Any] = {"known_start": known_start, "with_constant_velocity": False, "seed": seed}
        proof = _afterwards(partial(prove, rows, judges, **settings_of_proof), found, COMPARING, notes)
        begin()
        unclear = [] if shape else [one for one in found.found if len(one.aliases) > 1]
        largest = max(unclear, key=lambda one: one.candidate.total, default=None)
        proposed = _afterwards(partial(_proposed, largest, seed, notes), found, PROPOSING, notes) if largest else None
    again = _afterwards(partial(_not_wrong_after_all, found), found, "looking at wrong readings again", notes)
    notes += fallback_notes(why) + diagnose_units(program, problem.data) + _notes(found) + (again or [])
    if proof is not None:
        notes += doubtful(proof.rows, judges)
    drives = frozenset((*problem.data.digests, *choosing.data.digests))
    before, after = (
        _fit_to_all(refit, found, drives, settings, notes)
        for refit in (found.as_it_stands, found.base if shape else found.final)
    )
    return Discovery(found, effects, shape, proposed, proof, before, after, _doubts(found, is_fitted), notes)


def _searched(problem: Problem, valid: Trajectories, settings: Settings) -> Search:
    """The search; FilterError where what it begins with fails, also by a fault of numbers in the program's own code."""
    try:
        return search(problem, valid, settings)
    except (ArithmeticError, ValueError, torch.linalg.LinAlgError) as error:  # type: ignore[attr-defined]
        raise FilterError(f"the model cannot be searched on these trajectories: {reason_of(error)}") from error


def _afterwards(compute: Callable[[], Later], found: Search, doing: str, notes: list[str]) -> Later | None:
    """What is computed when the search has ended; None where it was interrupted, or where that fails, with a note."""
    if found.interrupted:
        return None
    try:
        return compute()
    except KeyboardInterrupt:
        found.interrupt(doing, cut_short=False)
    except Exception as error:  # also of the program's own code; what was found stays
        notes.append(f"{doing} failed: {reason_of(error)}")
    return None


def _fit_to_all(refit: Refit, found: Search, drives: frozenset[str], settings: Settings, notes: list[str]) -> Fit:
    """The program fitted to all drives, which have these digests, with what they tell of its parameters."""
    program, fold, maxima = refit.mean_program(), refit.folds[0], refit.judges.maxima
    data = concatenated(train=fold.drives, valid=fold.held_out)
    about = sum((one.information for one in maxima[1:]), maxima[0].information)

    def known() -> ParameterInformation | None:
        with seeded(settings.seed, "information"):
            kept, why = information_of_fit(Problem(program, data, fold.known_start).without_truth(), None, about)
        notes.extend(note for note in why if note not in notes)
        return None if kept is None else replace(kept, drives=drives)

    information = _afterwards(known, found, "looking at what the trajectories tell of the parameters", notes)
    said = {"simulations": settings.sets, "seed": settings.seed}
    trained = Trained([], kept=0, interrupted=True) if found.interrupted else None
    return Fit(program, "discover", said, settings.seed, fold.known_start, trained, information=information)


def _proposed(largest: Found, seed: int, notes: list[str]) -> NextRun | None:
    if (proposed := next_run(largest, seed)) is None:
        both = " from ".join(candidate.variant.name for candidate in largest.aliases[:2])
        notes.append(f"no way of driving that was tried tells {both} better than these trajectories do")
    return proposed


def _doubts(found: Search, is_fitted: bool) -> list[str]:
    doubts = [] if found.base.converged else [NOT_CONVERGED]
    if found.interrupted:
        doubts.append(f"interrupted while {found.interrupted}: this is what had been found until then")
    if is_fitted and found.gained > MAX_UNREPORTED_GAIN:
        doubts.append(
            f"the run had not converged: fitting it further gained {found.gained:.0f} nats on these trajectories, "
            "before anything was added. What follows begins from there; `steady prove` against the run would count "
            "them as gains"
        )
    statistic, count = found.rounds[0].screening.tests.fitted
    if count and statistic > 5 * count + 10:
        doubts.append(
            f"the fitted parameters' own score is large ({statistic:.0f} on {count}), the fit is at a bound: no "
            "ranking below is to be trusted"
        )
    return doubts


def _as_written(program: Program) -> Program:
    """The program as its file declares it, with the effects that were added to it."""
    with torch.random.fork_rng():
        written = with_substeps(written_class(program)(), program.substeps)
        return restore(written, record(program)).to(next(program.parameters(), torch.zeros(())).dtype)


def _notes(found: Search) -> list[str]:
    notes = []
    if isinstance(found.base.fitting, ByDraws):
        notes.append(
            "the linearised model's log p(y) is off by more than half a nat a trajectory, or cannot be judged: fits "
            "are gradient steps on draws, judged by particles, and whether they have converged is not tested"
        )
    if constant := unexcited(found.base.program, found.base.folds[0].drives):
        notes.append(f"{', '.join(constant)} never changes: what it does cannot be told from what happens anyway")
    steps = [found.step, found.with_found] if found.with_found else [found.step]
    notes += [f"all fits are at a finer step: {step.note}" for step in steps if step.note]
    if found.step.uncompared:
        notes.append(found.step.uncompared)
    if found.curve is not None:
        notes.append(
            "a curve has no name and is not kept: 'after' is what it would bring, --out has the model as it stood, "
            "fitted, with the noise that these trajectories show"
        )
    notes += [one.note for one in found.outliers if one.note] + found.notes
    if not found.final.converged and found.found:
        notes.append("the fit with what was found has not converged")
    notes += [f"{label}: taken back, for with it the model fails: {why}" for label, why in found.taken_back.items()]
    if found.is_full:
        notes.append(f"the search stops at {MAX_EFFECTS} effects: add them, fit, and discover again from there")
    if not found.is_complete and not found.cut_short:
        first = found.rounds[-1].screening.tests.tested[0]
        most = f", most of all one of a curve ({first.variant.at})" if first.is_curve else ""
        notes.append(f"something is left: the tests were not quiet at the end{most}")
    notes += [f"{one.candidate.variant.label}: {said}" for one in found.found if (said := _note_of_one_drive(one))]
    symptoms = [one.variant.label for one in found.rounds[0].candidates if one.against_its_sign and one.total > 0]
    return notes + [f"{label} would help with a sign that physics rules out: a symptom" for label in symptoms]


def _not_wrong_after_all(found: Search) -> list[str]:
    """A note where most readings that were left out are not wrong by the program with what was found."""
    before = found.outliers[0]
    if not (before.found and found.found):
        return []
    fold = found.final.folds[0]
    states = with_states_of(found.final.program, before.data)
    again = find_outliers(Problem(found.final.program, states, fold.known_start), fold.path, against_tails=False)
    count = int((before.wrong & ~again.wrong).sum())
    if count <= 0.5 * before.cells:
        return []
    return [
        f"{count} of {before.cells} readings of the training trajectories that were left out are not wrong by the "
        "model with what was found: discover again from there"
    ]


def _note_of_one_drive(found: Found) -> str:
    """Which drive carries a gain alone, if one does."""
    gain, refit = found.candidate.gain, found.candidate.refit
    if isinstance(refit, str) or found.candidate.total - float(gain.max()) > TIE_NATS:
        return ""
    held_out = [(name, fold.held_out) for name, fold in zip(("validation", "training"), refit.folds, strict=True)]
    drives = [f"{name} trajectory {label}" for name, data in held_out for label in data.labels]
    return f"without {drives[int(gain.argmax())]} nothing would be left of its gain: look at it"


def require_searchable(problem: Problem, valid: Trajectories, simulations: int) -> None:
    """Refuse what cannot be searched: the faults that `discover` raises."""
    program, train = problem.program, problem.data
    if simulations < MIN_SETS:
        raise UsageError(f"got {simulations} simulations: the calibration needs at least {MIN_SETS}, 200 are better")
    elements(program)
    if not program.channel_names:
        raise UsageError("the model declares no noise channels, through which effects act")
    for name, drives in (("training", train), ("validation", valid)):
        if len(drives) < MIN_DRIVES:
            raise DataError(
                f"{len(drives)} {name} trajectories are too few: each half needs at least {MIN_DRIVES}, because the "
                "unit that is resampled is the trajectory"
            )
        if drives.time.shape[0] < 3 or not bool(drives.observed[1:].any()):
            raise DataError(f"the {name} trajectories have no measurements after their first rows")
        refuse_long(drives)
    if both := shared_drives(train, valid):
        some = ", ".join(both[:3]) + (" …" if len(both) > 3 else "")
        raise UsageError(
            f"{len(both)} of the validation trajectories are training trajectories as well ({some}): nothing could be "
            "judged by them"
        )
    require_linear(problem, "discover needs a model that can be linearised")
    constant = unexcited(program, train)
    if constant and len(constant) == len(program.control_names):
        raise DataError(
            f"the controls never change ({', '.join(constant)}): these trajectories cannot tell what the controls do "
            "from what happens anyway, and no verdict is given; record trajectories with changing controls"
        )


def shared_drives(one: Trajectories, other: Trajectories) -> list[str]:
    """Labels of those of the second drives that are also among the first. Sensors that saturate say the same of
    different drives, whose controls tell them apart."""

    def content(data: Trajectories, index: int) -> bytes:
        rows = int(data.lengths[index])
        seen = data.observed[:rows, index]
        readings = torch.where(seen, data.measurements[:rows, index], 0.0)
        acting = data.controls[: rows - 1, index]  # the last row acts on nothing
        return b"".join(values.contiguous().numpy().tobytes() for values in (readings, seen, acting))

    known = {content(one, index) for index in range(len(one))}
    return [label for index, label in enumerate(other.labels) if content(other, index) in known]


def unexcited(program: Program, data: Trajectories) -> list[str]:
    """Controls that have one value everywhere."""
    controls = data.controls[:-1][data.transitions]
    same = (controls == controls[:1]).all(0).tolist()
    return [name for name, constant in zip(program.control_names, same, strict=True) if constant]


@contextmanager
def kept_search(
    folder: Path | None,
    given: Program | Fit,
    train: Trajectories,
    valid: Trajectories | None,
    options: Mapping[str, Any],
    *,
    force: bool,
    resume: bool,
) -> Iterator[dict[str, Any]]:
    """The folder of a search for the block that makes it; yields what its record says, nothing where there is none.

    `given`, `train`, `valid` and `options` are those of `discover`. `resume` goes on with the journal that is there, if
    everything is as it was; `force` overwrites a run.

    Raises:
        RunError: as `run_folder`, or what is given is not what the search was begun with.
    """
    if folder is None:
        yield {}
        return
    program = given.program if isinstance(given, Fit) else given
    parameters = hashlib.sha256()
    for name, value in program.state_dict().items():
        parameters.update(name.encode() + value.numpy(force=True).tobytes())
    known_start = options["known_start"]
    if known_start is None:
        known_start = isinstance(given, Fit) and given.known_start
    said: dict[str, Any] = {"known_start": known_start, "seed": options["seed"]}
    said |= {"options": {**options, "parameters": parameters.hexdigest()}, "option_files": {}}
    begun = begun_record(program, folder, train, valid, recipe="discover", status="searching", **said)
    if resume:
        require_same(folder, begun)
    with run_folder(folder, force=force, resume=resume):
        if not resume:
            write_record(folder, begun)
        with journal(folder / JOURNAL):
            yield begun
