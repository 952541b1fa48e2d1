"""Ways in which a program may be wrong, and the score of log p(y) in each: for telling sensor, actuator and dynamics.

A direction is a push on the states of every row, or a shift of every measurement, whose size is left open; its score is
the derivative of log p(y) by that size. The directions here are coarse and belong to any program. `steady discover`
tests physical effects by name.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.sizes import time_of_change
from steady_ppl.gaussian.kalman import Tracked
from steady_ppl.gaussian.predict import mean_steps, on_a_circle, row_errors
from steady_ppl.kernels.rows import Slopes, slopes_on_all_rows
from steady_ppl.likelihood.parameters import Element, elements, on_both_sides
from steady_ppl.likelihood.scores import measured, of_actuators
from steady_ppl.model.actuation import lagged
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import RowInputs, acting_controls, mean_step, row_controls
from steady_ppl.utils.angles import wrap, wrap_angles

SHARE_OF_LAG = 0.4  # of the time in which commands change
DEAD_ZONE, SATURATION_KNEE = 0.2, 0.6  # of the largest command
NOT_SUMMED = ("offset of", "curvature in")  # in the controls' own units
MAX_SCORED_PARAMETERS = 40  # parameters; a network's are not looked at one by one


@dataclass(frozen=True)
class Direction:
    """A way of being wrong."""

    kind: str  # "sensor", "actuator", "dynamics", or "parameter" for the program's own
    name: str  # in words
    scores: Tensor  # of each drive, (B,)


Named = Iterator[tuple[str, Tensor]]


@torch.no_grad()
def directions(program: Program, data: Trajectories, tracked: Tracked) -> list[Direction]:
    """Every direction's score of these drives; `data` is as returned by `for_program`."""
    scores = _Scores(program, data, tracked)
    kinds = {
        "parameter": scores.of_parameters(),
        "sensor": scores.of_sensors(),
        "actuator": scores.of_actuators(),
        "dynamics": itertools.chain(scores.of_channels(), scores.of_states(), scores.of_couplings()),
    }
    return [Direction(kind, name, value) for kind, found in kinds.items() for name, value in found]


class _Scores:
    """Scores of pushes on the states and by the channels, row by row `(T, B)`, and of shifts `(T + 1, B, K)`."""

    def __init__(self, program: Program, data: Trajectories, tracked: Tracked) -> None:
        self.program, self.data, self.path = program, data, tracked.path(data)
        self.linear, self.states, self.steps = tracked.linearization, self.path.states[:-1], data.steps.double()
        self.arrival, self.noise, self.reading = tracked.arrival[1:], tracked.noise, tracked.reading
        self.controls = acting_controls(program, data)
        self.inputs = RowInputs(self.controls[:-1], data.elapsed[:-1], data.steps)
        self.commands = row_controls(program, self.controls).double()
        self.lag = torch.tensor(SHARE_OF_LAG * time_of_change(program, data))
        count = self.noise.shape[-1]
        self.channels = program.channel_names if len(program.channels) == count else [f"{i + 1}" for i in range(count)]

    def over_rows(self, score: Tensor) -> Tensor:
        return torch.where(self.data.transitions, score, 0.0).sum(0)

    def shift(self, change: Tensor) -> Tensor:
        return (change * self.reading).sum((0, 2))

    def of_parameters(self) -> Named:
        """The program's own parameters, where they move the mean."""
        if not 0 < sum(value.numel() for value in self.program.parameters()) <= MAX_SCORED_PARAMETERS:
            return
        parts = elements(self.program, frozen=True)
        for part, score in zip(parts, (self._pushed_by(parts) + self._shifted_by(parts)).unbind(-1), strict=True):
            if bool((score != 0).any()):
                yield part.name, score

    def _pushed_by(self, parts: Sequence[Element]) -> Tensor:
        """Scores of what numbers change of the mean steps, `(B, P)`."""
        program, data = self.program, self.data
        given = {"state": self.states} | self.inputs._asdict()
        slopes = slopes_on_all_rows(program, "mean step", partial(mean_step, program), given, parts)
        scores, left = torch.zeros(len(data), len(parts)).double(), list(range(len(parts)))
        if isinstance(slopes, Slopes):
            arrival = torch.where(data.transitions[..., None], self.arrival, 0.0)
            scores, left = slopes.weighted(arrival), of_actuators(program, data, parts)
        for index in left:
            up, down = on_both_sides(parts[index], lambda: self._moved(acting_controls(program, data)))
            push = wrap_angles(up - down, self.linear.angles) / (2 * parts[index].step)
            scores[:, index] = self.over_rows((push * self.arrival).sum(-1))
        return scores

    def _shifted_by(self, parts: Sequence[Element]) -> Tensor:
        """The same of what the program measures."""
        program, data, states = self.program, self.data, self.path.states
        given = {"state": states}
        slopes = slopes_on_all_rows(program, "reading", lambda state: measured(program, state).reading, given, parts)
        if isinstance(slopes, Slopes):
            return slopes.weighted(torch.where(data.observed, self.reading, 0.0))
        scores = []
        for part in parts:
            sides = on_both_sides(part, lambda: row_errors(program, states, data.measurements, data.observed).double())
            scores.append(self.shift(torch.where(data.observed, sides[1] - sides[0], 0.0) / (2 * part.step)))
        return torch.stack(scores, -1)

    def of_sensors(self) -> Named:
        """Offset, scale and delay of every measurement, and of all in one unit together."""
        program, data = self.program, self.data
        components, unit = program.measurement_names, program.measurement_units
        predicted = torch.where(data.observed, data.measurements, 0.0).double() - self.linear.residual
        predicted = torch.where(on_a_circle(program, data, self.path.states), wrap(predicted), predicted)
        moved = wrap_angles((self.path.states[1:] - self.states).double(), self.linear.angles)
        velocity = moved / self.steps.clamp(min=1e-9).unsqueeze(-1)
        late = torch.cat([velocity[:1], velocity]).unsqueeze(-2)
        late = torch.where(data.rows[..., None], -(self.linear.measurement * late).sum(-1), 0.0)
        for word, change in (("offset", torch.ones_like(self.reading)), ("scale", predicted), ("delay", late)):
            for kind in dict.fromkeys(unit):
                chosen = [i for i, u in enumerate(unit) if u == kind]
                for members in [[i] for i in chosen] + ([chosen] if len(chosen) > 1 else []):
                    mask = torch.zeros(len(components), dtype=torch.float64)
                    mask[members] = 1.0
                    of = components[members[0]] if len(members) == 1 else f"all measurements in {kind or 'their unit'}"
                    yield f"{word} of {of}", self.shift(change * mask)

    def of_actuators(self) -> Named:
        """Other controls than those commanded, as the program would answer to them: one's, and all together."""
        together: dict[str, list[Tensor]] = {}
        for index, (name, response) in enumerate(zip(self.program.control_names, self.responses, strict=True)):
            if response is None:
                continue
            along = (response * self.arrival).sum(-1)
            for word, shape in self._other_than(self.commands[:-1, :, index]).items():
                score = self.over_rows(shape * along)
                together.setdefault(word, []).append(score)
                yield f"{word} {name}", score
        for word, scores in together.items():
            if len(scores) > 1 and word not in NOT_SUMMED:
                yield f"{word} all controls", torch.stack(scores).sum(0)

    def _other_than(self, command: Tensor) -> dict[str, Tensor]:
        """How what acts may differ from a command `(T, B)`, in words."""
        change = torch.cat([torch.zeros_like(command[:1]), command.diff(dim=0)]) / self.steps.clamp(min=1e-9)
        time, most = self.data.elapsed.double()[:-1], float(command.abs().amax())
        shapes = {
            "gain of": command,
            "drift of the gain of": command * time,
            "curvature in": command * command.abs(),
            "offset of": torch.ones_like(command),
            "dead zone of": -command.clamp(-DEAD_ZONE * most, DEAD_ZONE * most),
            "saturation of": command.clamp(-SATURATION_KNEE * most, SATURATION_KNEE * most) - command,
            "delay of": -change,
            "lag of": lagged(command.unsqueeze(-1), time, self.lag).squeeze(-1) - command,
        }
        if (speed := next(iter(self.program.velocities(self.states).values()), None)) is not None:
            shapes["speed-dependent gain of"] = command * speed.abs().double()
        return shapes

    def of_channels(self) -> Named:
        """Accelerations that grow with velocities, positions and angles."""
        program, states = self.program, self.states
        speeds = {f"{name} velocity": value.double() for name, value in program.velocities(states).items()}
        places = {f"{name} position": value.double() for name, value in program.positions(states).items()}
        shapes = {"always": torch.ones_like(self.steps)}
        shapes |= {f"with {name}": value for name, value in (speeds | places).items()}
        shapes |= {f"with the square of {name}": value * value.abs() for name, value in speeds.items()}
        shapes |= {f"with the cube of {name}": value**3 for name, value in places.items()}
        for (one, first), (other, second) in itertools.combinations(speeds.items(), 2):
            shapes[f"with {one} times {other}"] = first * second
        for angle in program.angles:
            value = states[..., program.state_names.index(angle)].double()
            shapes |= {f"with the sine of {angle}": value.sin(), f"with the cosine of {angle}": value.cos()}
        for index, channel in enumerate(self.channels):
            for word, shape in shapes.items():
                yield f"{channel} acceleration {word}", self.over_rows(shape * self.noise[..., index])

    def of_states(self) -> Named:
        """A constant push on each state component that noise reaches."""
        reached = self.linear.noise.square().sum((0, 1, 3)) > 0
        for index, name in enumerate(self.program.state_names):
            if bool(reached[index]) and name not in self.program.kept_names:
                yield f"constant push on {name}", self.over_rows(self.steps * self.arrival[..., index])

    def of_couplings(self) -> Named:
        """Controls acting on channels that they do not move in the program."""
        name, unit, commands = self.program.control_names, self.program.control_units, self.commands[:-1]
        along = self.linear.noise / self.linear.noise.norm(dim=-2, keepdim=True).clamp(min=1e-300)
        for channel, (called, noise) in enumerate(zip(self.channels, self.noise.unbind(-1), strict=True)):
            unmoved = []
            for index, response in enumerate(self.responses):
                if response is None or float((response * along[..., channel]).sum(-1).norm() / response.norm()) < 1e-3:
                    unmoved.append(index)
            for one in unmoved:
                yield f"{called} acceleration with {name[one]}", self.over_rows(commands[..., one] * noise)
            for one, other in itertools.combinations(unmoved, 2):
                if unit[one] == unit[other]:
                    word = f"{called} acceleration with {name[one]} − {name[other]}"
                    yield word, self.over_rows((commands[..., one] - commands[..., other]) * noise)

    @cached_property
    def responses(self) -> list[Tensor | None]:
        """How the next state changes with each control, `(T, B, D)`; None where it does not."""
        found: list[Tensor | None] = []
        for index in range(len(self.program.controls)):
            size = 0.05 * float(self.commands[..., index].abs().amax()) or 0.05
            change = torch.zeros_like(self.controls)
            change[..., index :: len(self.program.controls)] = size  # in every substep
            more, less = (self._moved(self.controls + sign * change) for sign in (1, -1))
            response = wrap_angles(more - less, self.linear.angles) / (2 * size)
            response = torch.where(self.data.transitions[..., None], response, 0.0)
            found.append(response if bool((response != 0).any()) else None)
        return found

    def _moved(self, controls: Tensor) -> Tensor:
        """The program's mean step from every row, `(T, B, D)`."""
        return mean_steps(self.program, self.states, self.inputs._replace(control=controls[:-1])).double()
