"""Run a program once on made-up shapes and explain what does not fit, before anything long starts."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pyro
import torch
from pyro import poutine
from pyro.poutine.messenger import Messenger
from torch import Tensor

from steady_ppl.errors import ProgramError, SteadyError
from steady_ppl.model.handlers import EVENT_HINT, Broadcasting, Observing, Recording, Replaying, draw_starts, running
from steady_ppl.model.program import FIRST_MEASUREMENTS, Program, names
from steady_ppl.model.roles import wrong_roles
from steady_ppl.model.stability import require_convergence
from steady_ppl.model.starts import require_centred
from steady_ppl.model.substeps import MAX_SUBSTEPS, is_count
from steady_ppl.utils.text import one_line

DRAWS, ROWS, TRAJECTORIES = 7, 11, 13  # of the probe, all different
LEFT = (DRAWS, ROWS, TRAJECTORIES)  # its batch shape


def probe(program: Program) -> None:
    """Check that the three methods exist and fit what the program declares, for particles and for all times at once.

    Raises:
        ProgramError: naming the method or site, what came and what was expected.
    """
    name = type(program).__name__
    for problem in _misdeclared(program):
        raise ProgramError(f"model {name}{problem}")
    size, width = len(program.states), len(program.measurements)
    parameter = next(program.parameters(), torch.zeros(()))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        step = (program.step * (1 + torch.rand(ROWS, TRAJECTORIES))).to(parameter)
        time = step.cumsum(0)
        start, started = _call(name, "initial", program.initial, (DRAWS, 1, TRAJECTORIES))
        _check_state("initial", start, size)
        if program.start:
            require_centred(started, size)
        usual = start.abs().flatten(0, -2).amax(0)
        usual = torch.where(usual > 0, usual, 1.0)  # of each component
        state = usual * torch.randn(*LEFT, size).to(parameter)
        control = torch.randn(ROWS, TRAJECTORIES, len(program.controls)).to(parameter)

        after, noise = _call(name, "transition", lambda: program.transition(state, control, time, step), LEFT)
        _check_state("transition", after, size)
        _check_noise(name, noise)
        if program.substeps > 1:
            require_convergence(program, state, control, time, step)

        measurements = torch.zeros(ROWS, TRAJECTORIES, width).to(parameter)
        observing = Observing(measurements, torch.ones_like(measurements, dtype=torch.bool))
        _, seen = _call(name, "observe", lambda: program.observe(state), LEFT, observing)
        density = seen.total()
        if density.shape != LEFT:
            what = f"the density of observe has shape {tuple(density.shape)}; expected {LEFT} {EVENT_HINT}"
            raise ProgramError(f"model {name}: {what}", site="observe")
        _check_sites(name, started, noise, seen)

        # one element alone must come out as it did among the others
        draw, row, drive = slice(2, 3), slice(4, 5), slice(8, 9)
        alone = {site: value.expand(*LEFT, *value.shape[3:])[draw, row, drive] for site, value in noise.values.items()}
        single = state[draw, row, drive], control[row, drive], time[row, drive], step[row, drive]
        one, moved = _call(name, "transition", lambda: program.transition(*single), (1, 1, 1), Replaying(alone))
        observing = Observing(measurements[row, drive], observing.observed[row, drive])
        _, again = _call(name, "observe", lambda: program.observe(single[0]), (1, 1, 1), observing)
        pairs = [("transition", after / usual, one / usual)]
        pairs += [("transition", _density(noise, site).expand(LEFT), _density(moved, site)) for site in noise.values]
        for method, among, by_itself in (*pairs, ("observe", density, again.total())):
            if not torch.allclose(among[draw, row, drive], by_itself, rtol=1e-3, atol=1e-4, equal_nan=True):
                what = "mixes draws, rows or trajectories: one alone gives another result than among others"
                how = "work on the last dimension only (no sum or mean over the others)"
                raise ProgramError(f"model {name}: {method} {what}; {how}", site=method)


def _misdeclared(program: Program) -> Iterator[str]:
    """What is wrong with a program's declarations, the first of which is reported."""
    for what in ("states", "controls", "measurements", "channels"):
        declared = getattr(program, what)
        if isinstance(declared, str):
            yield f": {what} is the text {declared!r}; one component is ({declared!r},)"
        if len(set(names(declared))) != len(declared):
            yield f": {what} names a component twice: {', '.join(names(declared))}"
    if not program.states or not program.measurements:
        missing = "states" if not program.states else "measurements (for a planar vehicle: landmarks)"
        yield f" declares no {missing}; name another class of the file as FILE.py:NAME"
    known = program.state_names
    groups = [("error_groups", group) for group in program.error_groups.values()]
    for what, members in (("angles", program.angles), ("resting", program.resting_names), *groups):
        for member in members:
            if member not in known:
                yield f": {what} names {member!r}, no state component ({', '.join(known)})"
    if unknown := set(names(program.since_row_before)) - set(program.measurement_names):
        there = ", ".join(program.measurement_names)
        yield f": since_row_before names {sorted(unknown)[0]!r}, no measurement ({there})"
    if program.start not in ("", FIRST_MEASUREMENTS):
        yield f': start is {program.start!r}; expected "{FIRST_MEASUREMENTS}", or nothing'
    yield from wrong_roles(program)
    if not is_count(program.substeps):
        yield f": substeps is {program.substeps!r}; expected a whole number from 1 to {MAX_SUBSTEPS}"
    if not (isinstance(program.simulated_step, float | int) and program.simulated_step > 0):
        yield f": simulated_step is {program.simulated_step!r}; expected seconds above 0, or infinity"
    if not (program.step > 0 and program.duration >= program.step):
        yield f": step is {program.step} s and duration {program.duration} s; expected 0 < step ≤ duration"


def _check_noise(name: str, noise: Recording) -> None:
    if not noise.values:
        about = "transition samples nothing: at least one channel must be noisy"
        raise ProgramError(f"model {name}: {about}", site="transition")
    for site, value in noise.values.items():
        fn = noise.distributions[site]
        if fn.event_dim > 1 or tuple(value.shape[: value.dim() - fn.event_dim]) != LEFT:
            has = f"shape {tuple(value.shape)} with event shape {tuple(fn.event_shape)}"
            what = f"has {has}; expected {LEFT} and at most one event dimension {EVENT_HINT}"
            raise ProgramError(f"model {name}: site {site!r} of transition {what}", site=site)


def _check_sites(name: str, *recordings: Recording) -> None:
    """The joint density needs every site to have a name of its own."""
    taken = {"states": "the engine"}
    for method, recording in zip(("initial", "transition", "observe"), recordings, strict=True):
        for site in recording.distributions:
            if site in taken:
                about = f"site {site!r} of {method} has a name that {taken[site]} uses too"
                raise ProgramError(f"model {name}: {about}", site=site)
            taken[site] = method


class _RecordingOnce(Recording):
    """Refuses a second site of the same name, and names the site that cannot be scored."""

    def _pyro_post_sample(self, message: Any) -> None:
        name = message["name"]
        if name in self.distributions:
            raise ProgramError(f"two sites are named {name!r}: give each its own name", site=name)
        try:
            super()._pyro_post_sample(message)
        except (ValueError, RuntimeError) as error:
            batch, event = tuple(message["fn"].batch_shape), tuple(message["fn"].event_shape)
            what = f"of batch shape {batch} and event shape {event}, cannot be scored: {one_line(error)} {EVENT_HINT}"
            raise ProgramError(f"site {name!r}, {what}", site=name) from error


def _call(
    name: str, method: str, run: Callable[[], Tensor | None], left: tuple[int, ...], *handlers: Messenger
) -> tuple[Tensor, Recording]:
    recording = _RecordingOnce()
    with ExitStack() as stack, pyro.settings.context(module_local_params=True):
        for handler in (poutine.block(), Broadcasting(left), recording, *handlers):
            stack.enter_context(handler)
        try:
            return run(), recording  # type: ignore[return-value]
        except SteadyError as error:
            if isinstance(error, ProgramError) and name not in str(error):
                raise ProgramError(f"model {name}: {method}: {error}", site=error.site) from error
            raise
        except Exception as error:
            on = "" if method == "initial" else f" on states of shape {LEFT} + (D,)"
            hint = f" {EVENT_HINT}" if "broadcast" in str(error) else ""
            raise ProgramError(f"model {name}: {method} failed{on}: {one_line(error)}{hint}", site=method) from error


def _density(recording: Recording, site: str) -> Tensor:
    return recording.distributions[site].log_prob(recording.values[site])


def _check_state(method: str, state: object, size: int) -> None:
    if not isinstance(state, Tensor) or state.shape[-1:] != (size,):
        came = f"shape {tuple(state.shape)}" if isinstance(state, Tensor) else type(state).__name__
        wanted = f"a state whose last dimension holds the {size} declared components"
        raise ProgramError(f"{method} must return {wanted}; it returned {came}", site=method)
    if method == "transition" and state.shape[:-1] != LEFT:
        returned = f"shape {tuple(state.shape)} for states of shape {(*LEFT, size)}"
        how = "write it for any shape on the left, with the component last"
        raise ProgramError(f"transition returned {returned}: {how}", site=method)


def start_size(program: Program) -> int:
    """How many numbers `initial` draws."""
    with running(1, 1), Recording() as seen:
        program.initial()
    return sum(fn.event_shape.numel() for fn in seen.distributions.values())


def noise_size(program: Program) -> int:
    """How many numbers each `transition` draws."""
    state = draw_starts(program, 1, 1)
    control, one = state.new_zeros(1, 1, len(program.controls)), state.new_ones(1, 1)
    with running(1, 1), Recording() as seen:
        program.transition(state, control, 0.0 * one, one)
    return sum(fn.event_shape.numel() for fn in seen.distributions.values())
