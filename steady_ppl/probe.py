"""Run a program once on made-up shapes and explain what does not fit, before anything long starts."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

import torch
from pyro import poutine
from torch import Tensor

from steady_ppl.errors import ProgramError, SteadyError
from steady_ppl.program import Program, error_groups
from steady_ppl.sites import Broadcasting, Observing, Recording, as_vector

DRAWS, ROWS, TRAJECTORIES = 3, 4, 5


def probe(program: Program) -> None:
    """Check that the three methods exist and fit what the program declares, for particles and for all times at once.

    Raises:
        ProgramError: naming the method or site, what came and what was expected.
    """
    name = type(program).__name__
    if not program.states or not program.measurements:
        missing = "states" if not program.states else "measurements (for a planar vehicle: landmarks)"
        raise ProgramError(f"program {name} declares no {missing}; name another class of the file as FILE.py:NAME")
    size, left = len(program.states), (DRAWS, ROWS, TRAJECTORIES)
    try:
        error_groups(program)
    except ValueError as error:
        raise ProgramError(f"program {name}: error_groups names an unknown state component: {error}") from None
    parameter = next(program.parameters(), torch.zeros(()))
    state = torch.randn(*left, size).to(parameter)
    control = torch.randn(ROWS, TRAJECTORIES, len(program.controls)).to(parameter)
    step = torch.full((ROWS, TRAJECTORIES), program.step).to(parameter)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        _check_state("initial", _call(name, "initial", program.initial)[0], size)
        after, noise = _call(name, "transition", lambda: program.transition(state, control, step.cumsum(0), step))
        _check_state("transition", after, size)
        if tuple(after.shape[:-1]) != left:
            raise ProgramError(
                f"program {name}: transition returned shape {tuple(after.shape)} for states of shape "
                f"{tuple(state.shape)}: write it for any shape on the left, with the component last",
                site="transition",
            )
        if not noise.values:
            raise ProgramError(
                f"program {name}: transition samples nothing: at least one channel must be noisy", site="transition"
            )
        for site, value in noise.values.items():
            channel = as_vector(value, noise.distributions[site].event_dim)
            if tuple(channel.shape[:-1]) != left or noise.distributions[site].event_dim > 1:
                raise ProgramError(
                    f"program {name}: site {site!r} of transition has shape {tuple(value.shape)} with event shape "
                    f"{tuple(noise.distributions[site].event_shape)}; expected {left} and at most one event dimension "
                    "(is .to_event(1) missing?)",
                    site=site,
                )
        measurements = torch.zeros(ROWS, TRAJECTORIES, len(program.measurements)).to(parameter)
        observing = Observing(measurements, torch.ones_like(measurements, dtype=torch.bool))
        _, seen = _call(name, "observe", lambda: program.observe(state), observing)
        shape = tuple(seen.total().shape)
        if shape != left:
            raise ProgramError(
                f"program {name}: the density of observe has shape {shape}; expected {left} (is .to_event(1) missing?)",
                site="observe",
            )


def _call(name: str, method: str, run: Callable[[], Tensor | None], *handlers: Observing) -> tuple[Tensor, Recording]:
    recording = Recording()
    left = (DRAWS, 1, TRAJECTORIES) if method == "initial" else (DRAWS, ROWS, TRAJECTORIES)
    with ExitStack() as stack:
        stack.enter_context(poutine.block())
        stack.enter_context(Broadcasting(left))
        for handler in (recording, *handlers):
            stack.enter_context(handler)
        try:
            return run(), recording  # type: ignore[return-value]
        except SteadyError:
            raise
        except Exception as error:
            first = str(error).strip().splitlines()[0] if str(error).strip() else ""
            raise ProgramError(
                f"program {name}: {method} failed on states of shape ({DRAWS}, {ROWS}, {TRAJECTORIES}, …): "
                f"{type(error).__name__}: {first}",
                site=method,
            ) from error


def _check_state(method: str, state: object, size: int) -> None:
    if not isinstance(state, Tensor) or state.shape[-1:] != (size,):
        came = f"shape {tuple(state.shape)}" if isinstance(state, Tensor) else type(state).__name__
        raise ProgramError(
            f"{method} must return a state whose last dimension holds the {size} declared components; "
            f"it returned {came}",
            site=method,
        )
