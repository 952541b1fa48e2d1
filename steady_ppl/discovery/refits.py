"""Programs with candidates, fitted to one half of the drives and judged on the other, both ways round."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.discovery.common_noise import Judges, with_common_noise
from steady_ppl.discovery.fitting import ByDraws, ByLikelihood, Fitting, is_doubtful
from steady_ppl.effects import Variant, attach, attached, coefficient
from steady_ppl.errors import FilterError, SteadyError
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import find_path
from steady_ppl.likelihood.fit import fit_by_likelihood, led_back
from steady_ppl.likelihood.maximize import Maximum, maximise
from steady_ppl.likelihood.parameters import elements, values_of
from steady_ppl.likelihood.scores import widens
from steady_ppl.model.program import Program
from steady_ppl.utils.random import seeded

MAX_LOG_NOISE_RATIO = math.log(20.0)
"""Of a channel's noise after a fit and before; beyond it a program explains next to nothing."""
MAX_LOSS = 2.0  # nats below the program without, after which a fit is given up: a candidate at zero is that program


@dataclass(frozen=True)
class Fold:
    """Drives to fit and drives to judge, with the paths along which they were last linearised."""

    drives: Trajectories
    path: ReferencePath
    held_out: Trajectories
    held_out_path: ReferencePath


@dataclass(frozen=True)
class Worth:
    """What log p(y) the drives of the first fold, or those kept from it, must reach for the second to be fitted."""

    drives: float = -math.inf
    held_out: float = -math.inf


ALWAYS = Worth()
BY_LIKELIHOOD, BY_DRAWS, FIRST_BY_DRAWS = ByLikelihood(), ByDraws(), ByDraws(steps=180)


@dataclass(frozen=True)
class Refit:
    """A program fitted on each fold.

    Attributes:
        programs: one a fold, fitted to its drives alone.
        judges: the same with their process noise in common, if fits by likelihood ended on every fold.
        maxima: one a fold.
        folds: with the paths of these programs.
        held_out: log p(y) of each drive under the judge fitted without it, but for the noise in common, `(B,)`.
            The folds come one after another; those of the first only where the rest was not worth fitting.
        held_out_alone: the same under the programs that were fitted to one fold alone.
        rough: the program before its fit made its noise many times wider, from whose parameters fits with an effect
            begin as well; None where it did not.
        fitting: how it was fitted, and how fits with an effect are.
    """

    programs: list[Program]
    judges: Judges
    maxima: list[Maximum]
    folds: list[Fold]
    held_out: Tensor
    held_out_alone: Tensor
    rough: Program | None = None
    fitting: Fitting = BY_LIKELIHOOD

    @property
    def program(self) -> Program:
        """The one fitted on the first fold."""
        return self.programs[0]

    def coefficients(self, variant: Variant) -> list[Tensor]:
        """An effect's coefficient on each fold."""
        return [coefficient(program, _there(program, variant)).detach().clone() for program in self.judges.programs]

    def coefficient(self, variant: Variant) -> Tensor:
        """Its mean over the folds, weighted by their drives: nearly that of a fit to all drives together."""
        weights = [len(fold.drives) for fold in self.folds]
        parts = [w * value for w, value in zip(weights, self.coefficients(variant), strict=True)]
        return torch.stack(parts).sum(0) / sum(weights)

    def mean_program(self) -> Program:
        """The folds' parameters averaged where they are learned: nearly what a fit to all drives together gives."""
        mean = copy.deepcopy(self.judges.programs[0])
        weights = [len(fold.drives) for fold in self.folds]
        learned = [dict(program.named_parameters()) for program in self.judges.programs]
        for name, parameter in mean.named_parameters():
            if parameter.requires_grad:
                parts = [weight * values[name].data for weight, values in zip(weights, learned, strict=True)]
                parameter.data.copy_(torch.stack(parts).sum(0) / sum(weights))
        return mean

    @property
    def converged(self) -> bool:
        """Whether all fits did."""
        return all(maximum.converged for maximum in (*self.maxima, *self.judges.maxima))

    def in_common(self, variant: Variant) -> int:
        """How many numbers of an effect's coefficient all drives told, those that judge it as well."""
        name = _there(self.program, variant).parameter
        return sum(common.split("[")[0] == name for common in self.judges.common)


def first_refit(
    program: Program,
    train: Trajectories,
    valid: Trajectories,
    *,
    known_start: bool,
    seed: int,
    nearer: Program | None = None,
) -> Refit:
    """Fit the program as it stands, both ways round; `nearer` has parameters from which fits begin instead.

    Raises:
        FilterError: the drives cannot be smoothed.
    """
    own = copy.deepcopy(program if nearer is None else nearer)
    with seeded(seed, "paths"):
        one = fit_by_likelihood(own, train, known_start=known_start)
        other = copy.deepcopy(own)
        second = maximise(other, valid, find_path(other, valid, known_start=known_start), known_start=known_start)
        second = led_back(other, valid, second, known_start)
    folds = [Fold(train, one.path, valid, second.path), Fold(valid, second.path, train, one.path)]
    rough = copy.deepcopy(program) if _far_wider(own, program, train) else None
    if rough is None and is_doubtful(own, train, one.path, known_start):
        return first_by_draws(program, [own, other], folds, known_start, seed)
    return replace(_refit([own, other], folds, known_start, [one, second]), rough=rough)


@dataclass(frozen=True)
class Start:
    """Where a fit by draws may begin: a program, a path of its drives and what log p(y) a filter finds for them all."""

    program: Program
    path: ReferencePath
    log_likelihood: float


def starts_by_draws(given: Program, fitted: Program, fold: Fold, *, known_start: bool) -> list[Start]:
    """Return the given program and its linearised fit as starts, the likelier first, as far as they follow the drives.

    Raises:
        FilterError: neither does.
    """
    found, failures = list[Start](), list[FilterError]()
    for program, near in ((given, None), (fitted, fold.path)):
        try:
            path = near or find_path(program, fold.drives, known_start=known_start)
            judged = FIRST_BY_DRAWS.judge(program, fold.drives, path, known_start=known_start)
            found.append(Start(program, judged.path, float(judged.log_likelihood.sum())))
        except FilterError as error:
            failures.append(error)
    if not found:
        raise failures[0]
    return sorted(found, key=lambda start: start.log_likelihood, reverse=True)


def first_by_draws(given: Program, fitted: list[Program], folds: list[Fold], known_start: bool, seed: int) -> Refit:
    """Fit by draws from the likelier programs; where that diverges, once more from the program as given."""
    with seeded(seed, "paths by draws"):
        starts = [starts_by_draws(given, *pair, known_start=known_start) for pair in zip(fitted, folds, strict=True)]
    likelier = [ranked[0] for ranked in starts]
    as_given = [start for ranked in starts for start in ranked if start.program is given]

    def climbed(begun: list[Start]) -> Refit:
        (one, other), (train, valid) = (start.path for start in begun), (fold.drives for fold in folds)
        along = [Fold(train, one, valid, other), Fold(valid, other, train, one)]
        programs = [copy.deepcopy(start.program) for start in begun]
        return _refit(programs, along, known_start, [None, None], fitting=FIRST_BY_DRAWS)

    try:
        refit = climbed(likelier)
    except FilterError:
        if len(as_given) < len(folds) or all(start.program is given for start in likelier):
            raise
        refit = climbed(as_given)
    return replace(refit, fitting=BY_DRAWS)


def _far_wider(fitted: Program, program: Program, data: Trajectories) -> bool:
    """Whether a fit has made some channel's noise several times what it was."""
    parts = elements(fitted)
    grown = values_of(parts) - values_of(elements(program)) > MAX_LOG_NOISE_RATIO
    return bool((grown & torch.tensor(widens(fitted, parts, data))).any())


def refit_with(
    base: Refit,
    variant: Variant,
    value: float | Sequence[float] | Tensor,
    *,
    known_start: bool,
    information: Tensor | None = None,
    worth: Worth = ALWAYS,
) -> Refit | str:
    """The program with an effect, or why it cannot be fitted.

    Args:
        base: the program without.
        variant: the effect.
        value: where its coefficient begins.
        known_start: the first state is certain.
        information: of the first fold's drives, the coefficient last.
        worth: what the first fold must reach for the second to be fitted as well.
    """
    try:
        programs = [attach(copy.deepcopy(program), variant, value) for program in base.programs]
        least = [float(maximum.log_likelihood.sum()) - MAX_LOSS for maximum in base.maxima]
        nothing = [None] * len(programs)
        fit = _refit(programs, base.folds, known_start, nothing, information, least, worth, base.rough, base.fitting)
    except SteadyError as error:
        return str(error)
    return replace(fit, rough=base.rough, fitting=base.fitting)


def refit_near(base: Refit, near: Refit, variants: Sequence[Variant], *, known_start: bool) -> Refit | str:
    """The program with effects, fitted from where another that shares parameters with it ended, or why it cannot be.

    Args:
        base: the program without these effects.
        near: where the fit begins; its paths are taken as well.
        variants: the effects; one at another knee, width or place than `near` has it, or fewer of them.
        known_start: the first state is certain.
    """
    try:
        programs = [copy.deepcopy(program) for program in base.programs]
        for variant in variants:
            programs = [attach(program, variant) for program in programs]
        if programs[0].states != near.program.states:
            return "paths of other states are no start"
        for program, fitted in zip(programs, near.programs, strict=True):
            own = program.state_dict()
            program.load_state_dict(own | {name: value for name, value in fitted.state_dict().items() if name in own})
        return _refit(programs, near.folds, known_start, [None] * len(programs), fitting=near.fitting)
    except SteadyError as error:
        return str(error)


def as_declared(declared: Program, fitted: Program) -> Program:
    """A copy of a fitted program with its own parameters as declared; the coefficients of its effects stay."""
    program, values = copy.deepcopy(fitted), dict(declared.named_parameters())
    coefficients = {known.parameter for known in attached(fitted)}
    for name, parameter in program.named_parameters():
        if name in values and name.removesuffix("_unconstrained") not in coefficients:
            parameter.data.copy_(values[name].data)
    return program


def _refit(
    programs: list[Program],
    folds: list[Fold],
    known_start: bool,
    maxima: Sequence[Maximum | None],
    information: Tensor | None = None,
    least: Sequence[float] = (-math.inf, -math.inf),
    worth: Worth = ALWAYS,
    rough: Program | None = None,
    fitting: Fitting = BY_LIKELIHOOD,
) -> Refit:
    fitted, found, held_out, judged_folds = list[Program](), list[Maximum](), list[Tensor](), list[Fold]()
    for program, fold, known, floor in zip(programs, folds, maxima, least, strict=True):
        drives, unseen = wide_drives(fold.drives, program), wide_drives(fold.held_out, program)
        share, path = len(fold.drives) / len(folds[0].drives), wide(fold.held_out_path, program)
        guess = None if information is None else share * information
        afresh = None if rough is None else _afresh(as_declared(rough, program), drives, known_start, floor)
        if afresh is not None:
            floor = max(floor, float(afresh[1].log_likelihood.sum()))
        maximum = known or fitting.fit(
            program, drives, wide(fold.path, program), known_start=known_start, information=guess, hopeless=floor
        )
        if afresh is not None and afresh[1].objective > maximum.objective:
            program, maximum = afresh
            path = find_path(program, unseen, known_start=known_start)
        judged = fitting.judge(program, unseen, path, known_start=known_start)
        fitted.append(program)
        found.append(maximum)
        held_out.append(judged.log_likelihood)
        judged_folds.append(Fold(drives, maximum.path, unseen, judged.path))
        if float(maximum.log_likelihood.sum()) < worth.drives and float(judged.log_likelihood.sum()) < worth.held_out:
            break
    judges, alone = Judges(fitted, found), torch.cat(held_out)
    if len(fitted) == len(folds) and fitting == BY_LIKELIHOOD:
        judges = with_common_noise(fitted, found, [fold.drives for fold in judged_folds], known_start=known_start)
    if judges.common:
        held_out = [
            fitting.judge(program, fold.held_out, fold.held_out_path, known_start=known_start).log_likelihood
            for program, fold in zip(judges.programs, judged_folds, strict=True)
        ]
    return Refit(fitted, judges, found, judged_folds, torch.cat(held_out), alone, fitting=fitting)


def _afresh(program: Program, drives: Trajectories, known_start: bool, floor: float) -> tuple[Program, Maximum] | None:
    """A fit whose paths are found anew; None where the program cannot follow the drives."""
    try:
        return program, maximise(program, drives, known_start=known_start, hopeless=floor)
    except FilterError:
        return None


def _there(program: Program, variant: Variant) -> Variant:
    """The effect as a program has it, where its coefficient may have another name."""
    return next(known for known in attached(program) if known.name == variant.name)


def wide(path: ReferencePath, program: Program) -> ReferencePath:
    """A path for a program that has further, resting states."""
    return ReferencePath(_with_resting(path.states, program), path.noise)


def wide_drives(drives: Trajectories, program: Program) -> Trajectories:
    """Drives for a program that has further, resting states."""
    return drives if drives.states is None else replace(drives, states=_with_resting(drives.states, program))


def _with_resting(states: Tensor, program: Program) -> Tensor:
    more = max(0, len(program.states) - states.shape[-1])
    return torch.cat([states, states.new_zeros((*states.shape[:-1], more))], -1)
