"""Ways in which a program may be wrong, and the score of log p(y) in each: for telling sensor, actuator and dynamics.

A direction is a push on the states of every row, or a shift of every measurement, whose size is left open; its score is
the derivative of log p(y) by that size. The directions here are coarse and belong to any program. `steady discover`
tests physical effects by name.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.gaussian.kalman import Tracked
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.predict import errors, on_a_circle
from steady_ppl.model.actuation import lagged
from steady_ppl.model.handlers import AtMean, running
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import acting_controls, advance, row_controls
from steady_ppl.utils.angles import wrap, wrap_angles

LAG = 0.3  # s
DEAD, KNEE = 0.2, 0.6  # of the largest command
ALONE = ("offset of", "curvature in")  # in the controls' own units
MAX_PARAMETERS = 40  # parameters; a network's are not looked at one by one


@dataclass(frozen=True)
class Direction:
    """A way of being wrong.

    Attributes:
        kind: "sensor", "actuator", "dynamics", or "parameter" for the program's own.
        name: in words.
        scores: of each drive, `(B,)`.
    """

    kind: str
    name: str
    scores: Tensor


@torch.no_grad()
def directions(program: Program, data: Trajectories, tracked: Tracked) -> list[Direction]:
    """Every direction's score.

    Args:
        program: the state-space model.
        data: as returned by `for_program`.
        tracked: of these drives.
    """
    path, scores = tracked.path(data), _Scores(program, data, tracked)
    found = itertools.chain(
        _parameters(program, data, path, scores),
        _sensor(program, data, path, scores),
        _actuator(program, data, path, scores),
        _dynamics(program, data, path, scores),
    )
    return [Direction(kind, name, value) for kind, name, value in found]


Named = Iterator[tuple[str, str, Tensor]]


class _Scores:
    """Scores of pushes on the states `(T, B, D)`, by the channels `(T, B)`, and of shifts `(T + 1, B, K)`."""

    def __init__(self, program: Program, data: Trajectories, tracked: Tracked) -> None:
        self.linear, self.inside = tracked.linearization, data.transitions
        self.arrival, self.noise, self.reading = tracked.arrival[1:], tracked.noise, tracked.reading

    def push(self, change: Tensor) -> Tensor:
        return torch.where(self.inside, (change * self.arrival).sum(-1), 0.0).sum(0)

    def channel(self, index: int, size: Tensor) -> Tensor:
        return torch.where(self.inside, size * self.noise[..., index], 0.0).sum(0)

    def shift(self, change: Tensor) -> Tensor:
        return (change * self.reading).sum((0, 2))


def _parameters(program: Program, data: Trajectories, path: ReferencePath, scores: _Scores) -> Named:
    """The program's own parameters, where they move the mean."""
    scalars = [(name, value, i) for name, value in program.named_parameters() for i in range(value.numel())]
    if len(scalars) > MAX_PARAMETERS:
        return
    states = path.states

    def run() -> tuple[Tensor, Tensor]:
        measured = errors(program, states, data.measurements, data.observed)
        return _moved(program, data, path, acting_controls(program, data)), -measured

    for name, value, index in scalars:
        flat = value.data.view(-1)
        before = flat[index].clone()
        size = 0.01 * max(1.0, abs(float(before)))
        try:
            flat[index] = before + size
            moved, measured = run()
            flat[index] = before - size
            moved_less, measured_less = run()
        finally:
            flat[index] = before
        push = wrap_angles(moved.double() - moved_less.double(), scores.linear.angles) / (2 * size)
        shift = torch.where(data.observed, measured.double() - measured_less.double(), 0.0) / (2 * size)
        score = scores.push(push) + scores.shift(shift)
        if bool((score != 0).any()):
            word = name.removesuffix("_unconstrained")
            yield "parameter", word if value.numel() == 1 else f"{word}[{index}]", score


def _sensor(program: Program, data: Trajectories, path: ReferencePath, scores: _Scores) -> Named:
    components, unit = program.measurement_names, program.measurement_units
    unity = torch.ones_like(scores.reading)
    predicted = torch.where(data.observed, data.measurements, 0.0).double() - scores.linear.residual
    predicted = torch.where(on_a_circle(program, data, path.states), wrap(predicted), predicted)
    step = data.steps.double().clamp(min=1e-9).unsqueeze(-1)
    velocity = wrap_angles((path.states[1:] - path.states[:-1]).double(), scores.linear.angles) / step
    late = torch.cat([velocity[:1], velocity]).unsqueeze(-2)
    late = torch.where(data.rows[..., None], -(scores.linear.measurement * late).sum(-1), 0.0)
    for word, change in (("offset", unity), ("scale", predicted), ("delay", late)):
        for kind in dict.fromkeys(unit):
            chosen = [i for i, u in enumerate(unit) if u == kind]
            for members in [[i] for i in chosen] + ([chosen] if len(chosen) > 1 else []):
                mask = torch.zeros(len(components), dtype=torch.float64)
                mask[members] = 1.0
                of = components[members[0]] if len(members) == 1 else f"all measurements in {kind or 'their unit'}"
                yield "sensor", f"{word} of {of}", scores.shift(change * mask)


def _actuator(program: Program, data: Trajectories, path: ReferencePath, scores: _Scores) -> Named:
    """Other controls than those commanded, as the program would answer to them: one's, and all together."""
    controls = acting_controls(program, data)
    speed = next(iter(program.velocities(path.states[:-1]).values()), None)
    together: dict[str, list[Tensor]] = {}
    for index, name in enumerate(program.control_names):
        answer = _answer(program, data, path, controls, index, scores.linear.angles)
        if answer is None:
            continue
        command = row_controls(program, controls)[:-1, :, index].double()
        for word, shape in _miscarried(command, data, speed).items():
            push = answer * shape.unsqueeze(-1)
            together.setdefault(word, []).append(push)
            yield "actuator", f"{word} {name}", scores.push(push)
    for word, pushes in together.items():
        if len(pushes) > 1 and word not in ALONE:
            yield "actuator", f"{word} all controls", scores.push(torch.stack(pushes).sum(0))


def _miscarried(command: Tensor, data: Trajectories, speed: Tensor | None) -> dict[str, Tensor]:
    """How what acts may differ from a command `(T, B)`, in words."""
    step = data.steps.double().clamp(min=1e-9)
    change = torch.cat([torch.zeros_like(command[:1]), command.diff(dim=0)]) / step
    most = float(command.abs().amax())
    shapes = {
        "gain of": command,
        "drift of the gain of": command * data.elapsed.double()[:-1],
        "curvature in": command * command.abs(),
        "offset of": torch.ones_like(command),
        "dead zone of": -command.clamp(-DEAD * most, DEAD * most),
        "saturation of": command.clamp(-KNEE * most, KNEE * most) - command,
        "delay of": -change,
        "lag of": lagged(command.unsqueeze(-1), data.elapsed.double()[:-1], torch.tensor(LAG)).squeeze(-1) - command,
    }
    if speed is not None:
        shapes["speed-dependent gain of"] = command * speed.abs().double()
    return shapes


def _dynamics(program: Program, data: Trajectories, path: ReferencePath, scores: _Scores) -> Named:
    states = path.states[:-1]
    speeds = {f"{name} velocity": value.double() for name, value in program.velocities(states).items()}
    places = {f"{name} position": value.double() for name, value in program.positions(states).items()}
    order = program.state_names
    shapes: dict[str, Tensor] = {"always": torch.ones_like(data.steps).double()}
    shapes |= {f"with {name}": value for name, value in (speeds | places).items()}
    shapes |= {f"with the square of {name}": value * value.abs() for name, value in speeds.items()}
    shapes |= {f"with the cube of {name}": value**3 for name, value in places.items()}
    for (one, first), (other, second) in itertools.combinations(speeds.items(), 2):
        shapes[f"with {one} times {other}"] = first * second
    for angle in program.angles:
        value = states[..., order.index(angle)].double()
        shapes |= {f"with the sine of {angle}": value.sin(), f"with the cosine of {angle}": value.cos()}
    channels = scores.noise.shape[-1]
    called = program.channel_names if len(program.channels) == channels else [f"{i + 1}" for i in range(channels)]
    for index, channel in enumerate(called):
        for word, shape in shapes.items():
            yield "dynamics", f"{channel} acceleration {word}", scores.channel(index, shape)
    reached = scores.linear.noise.square().sum((0, 1, 3)) > 0
    for index, name in enumerate(order):
        if bool(reached[index]):
            push = torch.zeros_like(scores.arrival)
            push[..., index] = data.steps
            yield "dynamics", f"constant push on {name}", scores.push(push)
    yield from _couplings(program, data, path, scores, called)


def _couplings(
    program: Program, data: Trajectories, path: ReferencePath, scores: _Scores, called: Sequence[str]
) -> Named:
    """Controls acting on channels that they do not move in the program."""
    controls = acting_controls(program, data)
    along = scores.linear.noise / scores.linear.noise.norm(dim=-2, keepdim=True).clamp(min=1e-300)
    unmoved: dict[int, list[int]] = {channel: [] for channel in range(len(called))}
    for index in range(len(program.controls)):
        answer = _answer(program, data, path, controls, index, scores.linear.angles)
        for channel, members in unmoved.items():
            if answer is None or float((answer * along[..., channel]).sum(-1).norm() / answer.norm()) < 1e-3:
                members.append(index)
    commands, name, unit = (
        row_controls(program, controls)[:-1].double(),
        program.control_names,
        program.control_units,
    )
    for channel, members in unmoved.items():
        for one in members:
            word = f"{called[channel]} acceleration with {name[one]}"
            yield "dynamics", word, scores.channel(channel, commands[..., one])
        for one, other in itertools.combinations(members, 2):
            if unit[one] == unit[other]:
                word = f"{called[channel]} acceleration with {name[one]} − {name[other]}"
                yield "dynamics", word, scores.channel(channel, commands[..., one] - commands[..., other])


def _answer(
    program: Program, data: Trajectories, path: ReferencePath, controls: Tensor, index: int, angles: tuple[int, ...]
) -> Tensor | None:
    """How the next state changes with a control, `(T, B, D)`; None where it does not."""
    size = 0.05 * float(row_controls(program, controls)[..., index].abs().amax()) or 0.05
    change = torch.zeros_like(controls)
    change[..., index :: len(program.controls)] = size  # in every substep
    more, less = (_moved(program, data, path, controls + sign * change).double() for sign in (1, -1))
    answer = wrap_angles(more - less, angles) / (2 * size)
    answer = torch.where(data.transitions[..., None], answer, 0.0)
    return answer if bool((answer.abs() > 1e-9).any()) else None


def _moved(program: Program, data: Trajectories, path: ReferencePath, controls: Tensor) -> Tensor:
    """The program's mean step from every row, `(T, B, D)`."""
    states = path.states[:-1]
    with running(*states.shape[:-1]), AtMean():
        return advance(program, states, controls[:-1], data.elapsed[:-1], data.steps)
