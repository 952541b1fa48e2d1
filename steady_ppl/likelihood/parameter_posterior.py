"""How far drives leave a program's parameters open: draws of them, what is not determined, and covariances.

The likelihood's maximum and curvature give a Student t, from which values are drawn and weighed by likelihood and
prior; these shape a second and a third. All values count, as draws of the mixture of all three (adaptive multiple
importance sampling, Cornuet, Marin, Mira and Robert 2012). Draws are resampled by weights with a smoothed tail
(Vehtari, Simpson, Gelman, Yao and Gabry 2024, JMLR 25:72), whose index says where that mixture is too far from the
posterior.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.distributions import transform_to

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import FilterError, require
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import smooth
from steady_ppl.likelihood.information import within_reach
from steady_ppl.likelihood.maximize import maximise
from steady_ppl.likelihood.objective import PASSES, TOLERANCE, Term, linearised, log_prior, posterior_score
from steady_ppl.likelihood.parameters import Element, elements, on_both_sides, set_values, values_of
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.utils.cores import one_thread
from steady_ppl.utils.progress import stages
from steady_ppl.utils.random import seeded

if TYPE_CHECKING:
    import arviz

RIDGE = 1e-10  # beside an information of one
MIN_CURVATURE = 1.0  # of log p(y) in a direction's own size, nats: below it a number is open by a factor of e
MIN_DRIVES_OF_NUMBER = 2  # for the cross products of their scores to tell the information
MIN_SHARE, SAME_SHARE = 0.1, 0.1  # of a direction's largest part, for a number to belong to it, or to be as large
DEGREES_OF_FREEDOM = 5.0  # of the Student t: its tails are heavier than those of any posterior that data tell
ROUND_SHARES = (0.25, 0.25, 0.5)  # shares of the values; each round draws about what those before found
MIN_EFFECTIVE_DRAWS = 4  # effective values a number, for which the weights that shape the next round are tempered
MAX_TAIL_INDEX = 0.7  # Pareto tail index above which weights are not to be trusted (Vehtari et al. 2024)

LogLikelihood = Callable[[Program], Tensor]


@dataclass(frozen=True)
class ParameterPosterior:
    """Draws of the learnable numbers of a program.

    Attributes:
        names: of the P numbers, as in `Maximum.names`.
        draws: `(M, P)` in the parameters' own units.
        tail_index: Pareto's k of the weights; above `MAX_TAIL_INDEX` the draws are not to be trusted.
    """

    names: tuple[str, ...]
    draws: Tensor
    tail_index: float

    @property
    def is_reliable(self) -> bool:
        """Whether the distribution that was drawn from covers the posterior."""
        return self.tail_index <= MAX_TAIL_INDEX

    def interval(self, share: float = 0.9) -> dict[str, tuple[float, float]]:
        """The central interval of each number."""
        ends = torch.tensor([(1 - share) / 2, (1 + share) / 2], dtype=self.draws.dtype)
        low, high = self.draws.quantile(ends, 0)
        return dict(zip(self.names, zip(low.tolist(), high.tolist(), strict=True), strict=True))

    def to_arviz(self) -> arviz.InferenceData:
        """One chain, a variable a number."""
        import arviz

        columns = zip(self.names, self.draws.T.numpy(), strict=True)
        return arviz.from_dict(posterior={name: draws[None] for name, draws in columns})


@one_thread()
@torch.no_grad()
def parameter_posterior(
    program: Program,
    table: Trajectories,
    *,
    known_start: bool = False,
    draws: int = 200,
    proposals: int = 400,
    seed: int = 0,
) -> ParameterPosterior:
    """Draw the parameters given trajectories; `program` stays as it is, and need not be at its maximum.

    A parameter without a prior (`Program.priors`) has a flat one on its own value.

    Args:
        program: with normal noise and at most some dozens of learnable numbers, fitted or near it.
        table: the trajectories.
        known_start: the first row's true state is given.
        draws: M.
        proposals: K, of which each needs a run of the smoother.
        seed: of all draws.

    Raises:
        FilterError: the trajectories cannot be smoothed at the program's parameters, or at none of the values.
        UsageError: more learnable numbers than can be looked at one by one.
    """
    require(draws >= 1, "draws", draws, "at least 1")
    require(proposals >= 20, "proposals", proposals, "at least 20: a tail is told from the largest weights")
    program = copy.deepcopy(program).double()
    problem = Problem.of_table(program, table, known_start)
    with seeded(seed, "parameters"), stages(("finding the maximum", 1), ("weighing", 4)) as begin:
        begin()
        path = maximise(problem).path
        begin()
        proposed, log_weights = adapt(
            program, about_maximum(problem, path), log_likelihood_along(problem, path), proposals
        )
        return resampled(program, proposed, log_weights, draws)


@dataclass(frozen=True)
class NormalShape:
    """A Student t in the space in which parameters are learned."""

    centre: Tensor  # (P,)
    root: Tensor  # (P, P), times its transpose the covariance of the normal that it is in the middle

    def draws(self, count: int) -> Tensor:
        """Values `(K, P)`."""
        student = torch.distributions.Chi2(torch.tensor(DEGREES_OF_FREEDOM, dtype=torch.float64)).sample((count, 1))
        white = torch.randn(count, len(self.centre), dtype=torch.float64) * (DEGREES_OF_FREEDOM / student).sqrt()
        return self.centre + white @ self.root.T

    def density(self, values: Tensor) -> Tensor:
        """Its logarithm `(K,)` at values `(K, P)`, but for a constant that all shapes share."""
        white = torch.linalg.solve(self.root, (values - self.centre).T)
        tail = -0.5 * (DEGREES_OF_FREEDOM + len(self.centre)) * torch.log1p(white.square().sum(0) / DEGREES_OF_FREEDOM)
        return tail - torch.linalg.slogdet(self.root)[1]


def about_maximum(problem: Problem, path: ReferencePath) -> NormalShape:
    """By the curvature where the program is; what the data do not tell is open by as much as a fit moves it at once."""
    parts = elements(problem.program)
    limits, directions, curvature = within_reach(parts, observed_information(problem, path, parts))
    return NormalShape(values_of(parts), limits[:, None] * directions * curvature.rsqrt())


def adapt(program: Program, shape: NormalShape, judge: LogLikelihood, count: int) -> tuple[Tensor, Tensor]:
    """Values of all rounds, `(K, P)`, and their log weights, `(K,)`."""
    shapes: list[NormalShape] = []
    values, judged = shape.centre.new_empty(0, len(shape.centre)), shape.centre.new_empty(0)
    log_weights = judged
    with stages(*(("", share) for share in ROUND_SHARES)) as begin:
        for share in ROUND_SHARES:
            begin()
            shapes.append(_shaped(shapes[-1], values, log_weights) if shapes else shape)
            new = shapes[-1].draws(round(share * count))
            values, judged = torch.cat([values, new]), torch.cat([judged, log_posterior(program, new, judge)])
            drawn = torch.tensor(ROUND_SHARES[: len(shapes)], dtype=values.dtype).log()
            log_weights = judged - (torch.stack([one.density(values) for one in shapes]) + drawn[:, None]).logsumexp(0)
    return values, log_weights


def _shaped(shape: NormalShape, values: Tensor, log_weights: Tensor) -> NormalShape:
    """The moments of weighed values; weights are tempered until enough of the values count."""
    enough = min(MIN_EFFECTIVE_DRAWS * values.shape[1], int(torch.isfinite(log_weights).sum()) / 2)
    power = 1.0
    while (weights := (power * log_weights).softmax(0)).square().sum().reciprocal() < enough:
        power *= 0.8
    centre = weights @ values
    apart = values - centre
    covariance = apart.T @ (weights[:, None] * apart)
    spread = covariance.diagonal().sqrt()
    root, failed = torch.linalg.cholesky_ex(covariance + torch.diag(1e-6 * spread.square()))
    return NormalShape(centre, root) if not failed else shape


def observed_information(problem: Problem, path: ReferencePath, parts: list[Element]) -> Tensor:
    """Minus the second derivatives of log p(y) and the log prior, `(P, P)`, by differences of exact scores."""
    sides = [on_both_sides(part, lambda: posterior_score(problem, path)) for part in parts]
    found = torch.stack([(down - up) / (2 * part.step) for part, (up, down) in zip(parts, sides, strict=True)])
    return (found + found.T) / 2


def log_likelihood_along(problem: Problem, path: ReferencePath) -> LogLikelihood:
    """log p(y) of the linearised program as it stands, summed over drives."""

    def judge(program: Program) -> Tensor:
        own = replace(problem, program=program)
        return smooth(own, path, passes=PASSES, tolerance=TOLERANCE, kernels=False).log_likelihood.sum()

    return judge


def log_posterior(program: Program, values: Tensor, judge: LogLikelihood) -> Tensor:
    """log p(y) and log prior of values `(K, P)`, `(K,)`: minus infinity where the program diverges.

    Raises:
        FilterError: it does at all of them.
    """
    parts = elements(program)
    before = values_of(parts)
    found = torch.full((len(values),), -torch.inf, dtype=torch.float64)
    with stages(*[("", 1)] * len(values)) as begin:
        for index, each in enumerate(values):
            begin()
            set_values(parts, each)
            try:
                found[index] = judge(program).double() + _log_prior(program)
            except FilterError:
                continue
    set_values(parts, before)
    found = torch.where(torch.isfinite(found), found, -torch.inf)
    if not bool(torch.isfinite(found).any()):
        raise FilterError("at none of the parameters' values can these trajectories be smoothed")
    return found


def resampled(program: Program, values: Tensor, log_weights: Tensor, draws: int) -> ParameterPosterior:
    """Draws of values `(K, P)` by their smoothed weights."""
    import arviz

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that the index is large, which the result says itself
        smoothed, tail = arviz.psislw(log_weights.numpy().copy())
    chosen = values[torch.multinomial(torch.from_numpy(smoothed).exp(), draws, replacement=True)]
    parts = elements(program)
    before, rows = values_of(parts), []
    for each in chosen:
        set_values(parts, each)
        rows.append(own_values(program))
    set_values(parts, before)
    return ParameterPosterior(tuple(part.name for part in parts), torch.stack(rows), float(tail))


def own_values(program: Program) -> Tensor:
    """All learnable numbers, `(P,)`, in their own units."""
    parts = elements(program)
    tensors = [attrgetter(part.owner)(program).detach() for part in parts]
    return torch.stack([values.view(-1)[part.index].double() for values, part in zip(tensors, parts, strict=True)])


def _log_prior(program: Program) -> float:
    """Of the parameters' own values, with what makes it a density in the space in which they are learned."""
    total = log_prior(program)
    for module in program.modules():
        for name, (constraint, _) in getattr(module, "_pyro_params", {}).items():
            free = getattr(module, f"{name}_unconstrained")
            if free.requires_grad:
                transform = transform_to(constraint)
                total += float(transform.log_abs_det_jacobian(free, transform(free)).sum())
    return total


@torch.no_grad()
def undetermined(problem: Problem, path: ReferencePath) -> list[str]:
    """Sentences about what drives leave open of a program that was fitted to them, or to others like them.

    Directions are eigenvectors of the information matrix, in logarithms and, of numbers with a unit, in their own size.

    Args:
        problem: its program has some dozens of learnable numbers.
        path: of the drives, near their posterior means.
    """
    term = Term.alone(problem, path)
    if not (parts := term.parts):
        return []
    scores = linearised([term]).scores
    directions = _open_directions(parts, scores.T @ scores)
    if directions or len(scores) < MIN_DRIVES_OF_NUMBER * len(parts):
        directions = _open_directions(parts, observed_information(problem, path, parts))
    return [_sentence(parts, direction) for direction in directions]


def _open_directions(parts: Sequence[Element], information: Tensor) -> list[Tensor]:
    """Directions along which log p(y) hardly bends, each `(P,)` and of few numbers, in the numbers' own sizes."""
    own = information.diagonal().clamp(min=0)
    size = torch.where(own > 0, torch.maximum(values_of(parts).abs(), 3 * own.rsqrt()), 1.0)
    size = torch.where(torch.tensor([part.has_unit for part in parts]), size, 1.0)
    curvature, turn = torch.linalg.eigh(size * information * size[:, None])
    basis = turn[:, curvature < MIN_CURVATURE].T.clone()
    for row in range(len(basis)):  # the same space by directions of few numbers: Gauss and Jordan
        at = divmod(int(basis[row:].abs().argmax()), len(parts))
        basis[[row, row + at[0]]] = basis[[row + at[0], row]]
        basis[row] /= basis[row, at[1]].clone()
        others = torch.arange(len(basis)) != row
        basis[others] -= basis[others][:, at[1], None] * basis[row]
    return list(basis)


def _sentence(parts: Sequence[Element], direction: Tensor) -> str:
    share = direction / direction.abs().max()
    chosen = [index for index in range(len(parts)) if abs(float(share[index])) > MIN_SHARE]
    names = [parts[index].name for index in chosen]
    if len(chosen) == 1:
        return f"these trajectories do not tell {names[0]}: many values are as likely"
    listed = f"{', '.join(names[:-1])} and {names[-1]}"
    pair = [float(share[index]) for index in chosen]
    equal = len(pair) == 2 and abs(abs(pair[0]) - abs(pair[1])) < SAME_SHARE
    if equal and not any(parts[index].has_unit for index in chosen):
        what = "product" if pair[0] * pair[1] < 0 else "ratio"
        return f"these trajectories tell only the {what} of {listed}, not each"
    return f"these trajectories tell {listed} only together, not each"


def in_own_sizes(inverse: Callable[[Tensor], Tensor], information: Tensor) -> Tensor:
    """An inverse of a matrix `(N, N)`, taken of the one that has ones on its diagonal: the same in any units."""
    size = information.diagonal().clamp(min=0).sqrt()
    per = torch.where(size > 0, 1 / size, 1.0)
    return per * inverse(per * information * per[:, None]) * per[:, None]


def pseudo_inverse(information: Tensor) -> Tensor:
    """The covariance of what the information tells; zero of what it does not tell. `lstsq` rounds differently from run
    to run."""
    return in_own_sizes(partial(torch.linalg.pinv, hermitian=True), information)


def ridged_inverse(information: Tensor) -> Tensor:
    """The covariance; of what the information does not tell it is huge."""
    ridge = RIDGE * torch.eye(len(information)).to(information)
    return in_own_sizes(lambda matrix: torch.linalg.inv(matrix + ridge), information)
