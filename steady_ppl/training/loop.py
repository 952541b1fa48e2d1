"""One training loop for every guide, and its stopping rule: held-out log p(y)."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Protocol

import pyro
import torch
from pyro.infer import Trace_ELBO
from torch import Tensor, nn
from tqdm import tqdm

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import RunError, TrainingError, require
from steady_ppl.gaussian.linearize import why_not_linear
from steady_ppl.likelihood.evidence import log_likelihood
from steady_ppl.model.problem import Joint
from steady_ppl.model.program import Program, for_program, parameter_name
from steady_ppl.smc.filter import STEPS_WORTH_COMPILING
from steady_ppl.training.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from steady_ppl.utils.cores import one_thread
from steady_ppl.utils.random import seeded
from steady_ppl.utils.text import tell

TYPICAL_VALIDATIONS = 10  # validations are in a training
MAX_FINAL_GAIN = 1.0  # nats a drive by which held-out log p(y) may rise at the end of a training that has converged


class Guide(Protocol):
    """What the loop asks of a guide; parameters, if it is a torch module, are trained with the program's. What it keeps
    in a dict of tensors `memory`, if it has one, goes into checkpoints."""

    draws: int

    def refresh(self, data: Trajectories, progress: float) -> dict[str, float]:
        """The E step, outside the gradient; returns figures for the log."""

    def __call__(self, data: Trajectories) -> None:
        """Sample the sites of `Joint`."""


@dataclass(frozen=True)
class Optimization:
    """How parameters are moved. The defaults suit a network on some twenty trajectories.

    Attributes:
        steps: number of E steps.
        gradient_steps: Adam steps on each E step's draws.
        learning_rate: Adam's; falls to `final_rate` of it along half a cosine.
        betas: Adam's.
        final_rate: share of the learning rate at the end.
        weight_decay: of the matrices of `torch.nn.Linear`, decoupled; each step shrinks them by learning rate × decay
            (the authors' code: 1).
        gradient_norm: every array's gradient is scaled down to this norm at most; None leaves it.
        averaging: weight of the past in the running mean of the parameters; that mean is validated and returned.
        batch: trajectories an E step, all when None.
        validate_every: E steps between two validations.
        patience: stop after so many validations in a row that are worse than the best by more than a standard error.
    """

    steps: int = 600
    gradient_steps: int = 1
    learning_rate: float = 1e-2
    betas: tuple[float, float] = (0.9, 0.99)
    final_rate: float = 0.05
    weight_decay: float = 1.0
    gradient_norm: float | None = None
    averaging: float = 0.98
    batch: int | None = None
    validate_every: int = 25
    patience: int = 30

    @classmethod
    def among(cls, settings: Mapping[str, Any]) -> Optimization:
        """Of those settings of a recipe that are about it; the others are the defaults."""
        return cls(**{field.name: settings[field.name] for field in fields(cls) if field.name in settings})

    def __post_init__(self) -> None:
        for name in ("steps", "gradient_steps", "validate_every", "patience", "batch"):
            value = getattr(self, name)
            require(value is None or value >= 1, name, value, "at least 1")
        for name in ("learning_rate", "weight_decay"):
            require(0 <= getattr(self, name) < math.inf, name, getattr(self, name), "0 or more")
        for name in ("final_rate", "averaging"):
            require(0 <= getattr(self, name) <= 1, name, getattr(self, name), "between 0 and 1")
        require(self.gradient_norm is None or self.gradient_norm > 0, "gradient_norm", self.gradient_norm, "above 0")
        betas = self.betas if isinstance(self.betas, Sequence) else ()
        pair = len(betas) == 2 and all(isinstance(beta, int | float) and 0 <= beta < 1 for beta in betas)
        require(pair, "betas", self.betas, "two numbers from 0 to below 1")


@dataclass
class Trained:
    """What training leaves behind.

    Attributes:
        history: one entry a validation: step, loss, log p(y) and the guide's figures.
        kept: the step whose averaged parameters were kept.
        interrupted: whether it was stopped by the user.
    """

    history: list[dict[str, float]]
    kept: int
    interrupted: bool = False

    @property
    def rise(self) -> tuple[float, float] | None:
        """Held-out log p(y) of a trajectory at first and at the step that was kept; None where it was not judged."""
        judged = {entry["step"]: entry["log_likelihood"] for entry in self.history if "log_likelihood" in entry}
        return (next(iter(judged.values())), judged[self.kept]) if self.kept in judged else None

    @property
    def still_rising(self) -> float | None:
        """By how many nats a trajectory held-out log p(y) rose over the last quarter, if more than `MAX_FINAL_GAIN` and
        its end was kept; None where it had settled, or where fewer than three validations cannot tell."""
        judged = [(entry["step"], entry["log_likelihood"]) for entry in self.history if "log_likelihood" in entry]
        if len(judged) < 3 or self.interrupted or judged[-1][0] != self.kept:
            return None
        before = max(value for step, value in judged[:-1] if step <= max(0.75 * self.kept, judged[0][0]))
        risen = judged[-1][1] - before
        return risen if risen > MAX_FINAL_GAIN else None


@one_thread()
def train(
    program: Program,
    guide: Guide,
    data: Trajectories,
    validation: Validation,
    optimization: Optimization,
    *,
    known_start: bool = False,
    seed: int = 0,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: bool = True,
) -> Trained:
    """Fit the program's (and the guide's) parameters; the program ends with averaged ones, chosen by held-out data.

    Alternates the guide's E step with gradient steps on Pyro's ELBO. For a `PathGuide` that ELBO is STEADY's M-step
    objective (IROS 2022, equation 6); for a guide with parameters it is SVI. Of the validated parameters the latest is
    kept whose held-out log p(y) is the best so far, or `within_one_standard_error` of it.

    Args:
        program: the state-space model, trained in place.
        guide: proposes the latent variables.
        data: as returned by `for_program`.
        validation: the stopping rule.
        optimization: step sizes and numbers of steps.
        known_start: the first state is certain and not scored.
        seed: with the step it keys every draw, so that a resumed run repeats an uninterrupted one.
        checkpoint: file that is written at the start and at every validation.
        resume: continue from `checkpoint`.
        progress: show a bar on stderr, or a line a validation where stderr is no terminal.

    Raises:
        TrainingError: the loss is not finite.
        FilterError: the E step broke down.
    """
    joint = Joint(program, known_start=known_start)
    elbo = Trace_ELBO(num_particles=guide.draws, vectorize_particles=guide.draws > 1, max_plate_nesting=2)
    parameters: dict[str, Tensor] = dict(program.named_parameters())
    own = dict(guide.named_parameters(prefix="guide")) if isinstance(guide, nn.Module) else {}
    optimizer = torch.optim.AdamW(_groups(program, guide, own.values(), optimization), betas=optimization.betas)
    full_rates = [group["lr"] for group in optimizer.param_groups]
    state = Checkpoint(
        parameters=parameters | own,
        averaged={name: value.detach().clone() for name, value in parameters.items()},
        memory=getattr(guide, "memory", {}),
    )
    if checkpoint is not None:
        begin = read_checkpoint if resume else write_checkpoint
        begin(checkpoint, state, optimizer)
    batch, interrupted = optimization.batch or len(data), False
    patience = optimization.patience * optimization.validate_every
    shows_bar = progress and sys.stderr.isatty()
    bar = tqdm(total=optimization.steps, initial=state.step, disable=not shows_bar, file=sys.stderr, unit="step")
    with bar, pyro.settings.context(module_local_params=True), pyro.validation_enabled(False):
        try:
            while state.step < optimization.steps and state.step - state.kept_step < patience:
                done, final_rate = state.step / optimization.steps, optimization.final_rate
                share = final_rate + (1 - final_rate) * 0.5 * (1 + math.cos(math.pi * done))
                for group, rate in zip(optimizer.param_groups, full_rates, strict=True):
                    group["lr"] = rate * share
                with seeded(seed, "step", state.step):
                    part = data if batch >= len(data) else data.subset(torch.randperm(len(data))[:batch])
                    figures = guide.refresh(part, done)
                    for _ in range(optimization.gradient_steps):
                        loss = elbo.differentiable_loss(joint, guide, part) / int(part.transitions.sum())
                        _require_finite(loss, state.step)
                        optimizer.zero_grad()
                        loss.backward()
                        for name, value in state.parameters.items():
                            _require_finite_gradient(name, value, state.step)
                            if optimization.gradient_norm is not None:
                                nn.utils.clip_grad_norm_(value, optimization.gradient_norm)
                        optimizer.step()
                state.step += 1
                keep = min(optimization.averaging, (state.step - 1) / (state.step + 9))
                for name, value in parameters.items():
                    state.averaged[name].lerp_(value.detach(), 1 - keep)
                bar.update()
                if state.step % optimization.validate_every == 0 or state.step == optimization.steps:
                    with using(parameters, state.averaged):
                        held_out = validation(program, seed)
                    _judge(state, held_out, {"loss": loss.item(), **figures})
                    if progress and not shows_bar:
                        tell(_in_words(state.history[-1], optimization.steps), aside=True)
                    if checkpoint is not None:
                        write_checkpoint(checkpoint, state, optimizer)
                held = {k: v for k, v in (state.history or [{}])[-1].items() if k == "log_likelihood"}
                bar.set_postfix_str(_in_words({"loss": loss.item(), **figures, **held}), refresh=False)
        except KeyboardInterrupt:
            interrupted = True
    _copy(state.kept or state.averaged, parameters)
    return Trained(history=state.history, kept=state.kept_step, interrupted=interrupted)


def _in_words(figures: Mapping[str, float], steps: int = 0) -> str:
    """Figures of the log in one line."""
    begin = f"step {figures['step']:.0f} of {steps}: " if "step" in figures else ""
    shown = ", ".join(f"{name} {value:.4g}" for name, value in figures.items() if name != "step")
    return begin + shown.replace("log_likelihood", "held-out log p(y)").replace("_", " ")


def _require_finite_gradient(name: str, value: Tensor, step: int) -> None:
    if value.grad is not None and not bool(torch.isfinite(value.grad).all()):
        how = "look for a square root, a division or a norm at zero in the model, or for roll-outs that diverge"
        raise TrainingError(f"the gradient of {parameter_name(name)} is not finite at step {step + 1}: {how}")


def _judge(state: Checkpoint, held_out: list[float], figures: dict[str, float]) -> None:
    """Note a validation, and keep the averaged parameters if they are as good as the best."""
    if state.best_held_out and len(state.best_held_out) != len(held_out):
        counts = f"it has {len(state.best_held_out)} held-out log p(y), and there are {len(held_out)}"
        raise RunError(f"the checkpoint is damaged: {counts}")
    entry = {"step": float(state.step), **figures}
    if held_out:
        entry["log_likelihood"] = sum(held_out) / len(held_out)
    state.history.append(entry)
    if within_one_standard_error(held_out, state.best_held_out):
        state.kept = {name: value.clone() for name, value in state.averaged.items()}
        state.kept_step = state.step
    if not state.best_held_out or sum(held_out) > sum(state.best_held_out):
        state.best_held_out = held_out


@contextmanager
def using(parameters: Mapping[str, Tensor], values: Mapping[str, Tensor]) -> Iterator[None]:
    """Run a block with other parameter values, and put the present ones back."""
    present = {name: parameters[name].detach().clone() for name in values}
    _copy(values, parameters)
    try:
        yield
    finally:
        _copy(present, parameters)


@torch.no_grad()
def _copy(values: Mapping[str, Tensor], parameters: Mapping[str, Tensor]) -> None:
    for name, value in values.items():
        parameters[name].copy_(value)


def _groups(program: Program, guide: Guide, own: Iterable[Tensor], optimization: Optimization) -> list[dict[str, Any]]:
    """One parameter group each, with the program's own relative rates and decays; those of the guide are its `own`."""

    def relative(table: Any, name: str) -> float:
        return next((factor for start, factor in table.items() if name.startswith(start)), 1.0)

    linear = {id(module.weight) for module in program.modules() if isinstance(module, nn.Linear)}
    groups = []
    for name, value in program.named_parameters():
        decay = optimization.weight_decay * relative(program.decays, name) if id(value) in linear else 0.0
        rate = optimization.learning_rate * relative(program.rates, name)
        groups.append({"params": [value], "lr": rate, "weight_decay": decay})
    rate = optimization.learning_rate * getattr(guide, "rate", 1.0)
    return [*groups, *({"params": [value], "lr": rate, "weight_decay": 0.0} for value in own)]


def _require_finite(loss: Tensor, step: int) -> None:
    if not bool(torch.isfinite(loss)):
        how = "lower the learning rate, or look at the model's densities (a standard deviation of zero?)"
        raise TrainingError(f"the loss is {loss.item()} at step {step + 1}: {how}")


@dataclass(frozen=True)
class Validation:
    """Held-out log p(y): the stopping rule of every method.

    Attributes:
        data: the validation table, as returned by `for_program`; None trains to the last step.
        particles: N of the filter; the same random numbers are used at every validation.
        known_start: start at the true first state.
        every: use every n-th row's measurements (10 Hz to 1 Hz).
        look_ahead: with a filter that looks ahead; `particles` can then be a twentieth.
        reason: why it does not, where that was wanted.
    """

    data: Trajectories | None = None
    particles: int = 2000
    known_start: bool = False
    every: int = 10
    look_ahead: bool = False
    reason: str | None = None

    @property
    def notes(self) -> list[str]:
        """What a fit should say of it."""
        said = f"held-out trajectories were judged by the bootstrap filter at every tenth row: {self.reason}"
        return [] if self.reason is None else [said]

    @classmethod
    def suited(
        cls, program: Program, table: Trajectories | None, *, known_start: bool = False, particles: int | None = None
    ) -> Validation:
        """Looking ahead at every row where the program's noise is normal, else by the bootstrap at every tenth.

        Args:
            table: the held-out trajectories, if there are any.
            particles: N; 100 looking ahead and 2000 otherwise when not given.
        """
        if table is None:
            return cls(None, known_start=known_start)
        data = for_program(program, table)
        reason = why_not_linear(program, data, known_start=known_start)
        ahead = reason is None
        count = (100 if ahead else 2000) if particles is None else particles
        require(count >= 1, "validation_particles", count, "at least 1")
        return cls(data, count, known_start, every=1 if ahead else 10, look_ahead=ahead, reason=reason)

    def __call__(self, program: Program, seed: int) -> list[float]:
        """Log p(y) of each held-out trajectory, if there are any."""
        if self.data is None:
            return []
        given: Any = {name: getattr(self, name) for name in ("particles", "known_start", "every", "look_ahead")}
        kernels = TYPICAL_VALIDATIONS * self.particles * self.data.time.numel() >= STEPS_WORTH_COMPILING
        with seeded(seed, "validate"):
            return log_likelihood(program, self.data, kernels=kernels, **given).tolist()


def within_one_standard_error(candidate: Sequence[float], best: Sequence[float]) -> bool:
    """Whether held-out log p(y), of each drive or empty, is no worse than the best, up to one standard error of the
    paired difference (the rule of Breiman et al. 1984, towards the later instead of the smaller model).

    Log p(y) at 1 Hz hardly feels how wide the process noise is; its differences late in a training are smaller than
    what the choice of held-out drives moves. Among equals the later parameters have seen more of the full observation
    weight.
    """
    if not candidate or not best:
        return True
    loss = torch.tensor(best, dtype=torch.float64) - torch.tensor(candidate, dtype=torch.float64)
    error = loss.std() / math.sqrt(len(loss)) if len(loss) > 1 else 0.0
    return bool(loss.mean() <= error)
