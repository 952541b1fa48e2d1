"""What lies between the command and the force: gains, knees, delays, wear."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.catalogue.planar_forces import not_planar
from steady_ppl.effects.declaration import Effect, power_of_two_below
from steady_ppl.model.actuation import delayed, lagged
from steady_ppl.model.program import Program


def _has(*wanted: str) -> Any:
    def lacks(program: Program) -> str | None:
        if set(wanted) <= set(program.control_names):
            return None
        return f"there are no controls {' and '.join(wanted)}"

    return lacks


def _no_controls(program: Program) -> str | None:
    return None if program.controls else "the program has no controls"


def _groups(program: Program) -> list[dict[str, Any]]:
    """All controls together and, where their units differ, each alone."""
    order = program.control_names
    together = [{"controls": order}]
    if len(set(program.control_units)) == 1:
        return together
    return together + [{"controls": (name,), "at": name} for name in order]


def _everywhere(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    """All controls together and, where their units differ, each alone."""
    return _groups(program)


def _per_unit(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    """The coefficient has a control's unit: together where they share one, else each alone."""
    groups = _groups(program)
    groups = groups if len(groups) == 1 else groups[1:]
    return [{**group, "scale": _size(data, group["controls"])} for group in groups]


def _size(data: Trajectories | None, controls: Sequence[str]) -> float:
    """Of the largest command."""
    if data is None:
        return 1.0
    columns = [data.control_names.index(name) for name in controls]
    return power_of_two_below(float(data.controls[..., columns][data.rows].abs().amax()))


def _knees(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    choices = []
    for group in _per_unit(program, data):
        knees = [0.6]
        if data is not None:
            columns = [data.control_names.index(name) for name in group["controls"]]
            sizes = data.controls[..., columns][data.rows].abs().double().flatten()
            sizes = sizes[sizes > 0.02 * sizes.max()]
            knees = sizes.quantile(sizes.new_tensor([0.4, 0.6, 0.75, 0.88])).tolist() if len(sizes) else knees
        choices += [{**group, "knee": float(f"{knee:.3g}")} for knee in knees]
    return choices


def _single(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    return [{"controls": (name,), "at": name} for name in program.control_names]


def _lacks_single(program: Program) -> str | None:
    if {"left", "right"} == set(program.control_names):
        return "of two thrusts it is the asymmetry, up to mass and inertia"
    return _no_controls(program)


def thrust_asymmetry(self: Any, control: Tensor, time: Tensor, c: Tensor) -> Tensor:
    return control * (1 + c * self.chosen_controls(("right",), control))


def one_gain(self: Any, control: Tensor, time: Tensor, c: Tensor, controls: Sequence[str]) -> Tensor:
    return control * (1 + c * self.chosen_controls(controls, control))


def speed_dependent_gain(self: Any, state: Tensor, control: Tensor, time: Tensor, c: Tensor) -> Tensor:
    forward, lateral, _ = self.body_velocity(state)
    speed = (forward**2 + lateral**2 + 1e-12).sqrt()
    return control * (1 - c * speed).unsqueeze(-1)


def thrust_saturation(
    self: Any, control: Tensor, time: Tensor, c: Tensor, controls: Sequence[str], knee: Any
) -> Tensor:
    beyond = control.sign() * (control.abs() - knee).relu()
    return control - c * self.chosen_controls(controls, control) * beyond


def dead_zone(self: Any, control: Tensor, time: Tensor, c: Tensor, controls: Sequence[str]) -> Tensor:
    lost = torch.minimum(torch.maximum(control, -c), c)
    return control - self.chosen_controls(controls, control) * lost


def actuator_lag(self: Any, control: Tensor, time: Tensor, c: Tensor, controls: Sequence[str]) -> Tensor:
    return control + self.chosen_controls(controls, control) * (lagged(control, time, c) - control)


def actuator_delay(self: Any, control: Tensor, time: Tensor, c: Tensor, controls: Sequence[str]) -> Tensor:
    return control + self.chosen_controls(controls, control) * (delayed(control, time, c) - control)


def battery_sag(self: Any, control: Tensor, time: Tensor, c: Tensor) -> Tensor:
    return control * (1 - c * time / self.duration).unsqueeze(-1)


ACTUATORS = [
    Effect(
        name="thrust_asymmetry",
        form="history",
        equation=r"u_\mathrm{right} \to (1 + c)\,u_\mathrm{right}",
        text="right → (1 + c) right",
        unit="1",
        feels="pulls to one side, the more the harder it is driven",
        occurs="a chipped propeller, a tyre with less air, one motor of another batch",
        function=thrust_asymmetry,
        typical=0.05,
        limit=0.5,
        lacks=_has("left", "right"),
    ),
    Effect(
        name="gain_error",
        form="history",
        equation=r"u \to (1 + c)\,u",
        text="u → (1 + c) u of one control",
        unit="1",
        feels="does more (or less) than it is told",
        occurs="a motor constant taken from the data sheet, a gear ratio or a wheel radius that is off",
        function=one_gain,
        typical=0.08,
        limit=1.0,
        choices=_single,
        lacks=_lacks_single,
    ),
    Effect(
        name="speed_dependent_gain",
        form="command",
        equation=r"u \to (1 - c\,|v|)\,u",
        text="u → (1 - c |v|) u",
        unit="s/m",
        feels="propellers pull less the faster it goes",
        occurs="propellers, whose thrust falls with the speed of advance; motors near the speed of no load",
        function=speed_dependent_gain,
        typical=0.1,
        limit=1.0,
        lacks=not_planar,
    ),
    Effect(
        name="thrust_saturation",
        form="history",
        equation=r"u \to u - c\,\mathrm{sign}(u)\max(|u| - u_0, 0)",
        text="u → u - c sign(u) max(|u| - knee, 0)",
        unit="1",
        feels="full commands give little more than half ones",
        occurs="motors at their current limit, ventilating propellers, valves that are fully open",
        function=thrust_saturation,
        profiled=("knee",),
        typical=0.45,
        limit=1.0,
        sign=1,
        choices=_knees,
        lacks=_no_controls,
    ),
    Effect(
        name="dead_zone",
        form="history",
        equation=r"u \to \mathrm{sign}(u)\max(|u| - c, 0)",
        text="u → sign(u) max(|u| - c, 0)",
        unit="of the control",
        feels="small commands do nothing",
        occurs="static friction in motors, gear play, valves with overlap, drivers that ignore small duty cycles",
        function=dead_zone,
        typical=0.2,
        limit=1.0,
        sign=1,
        probes=(0.05, 0.15, 0.3),
        choices=_per_unit,
        lacks=_no_controls,
    ),
    Effect(
        name="actuator_lag",
        form="history",
        equation=r"\dot u_\mathrm{acting} = (u - u_\mathrm{acting}) / c",
        text="du_acting/dt = (u - u_acting) / c",
        unit="s",
        feels="builds up what it is told, and lets go of it as slowly",
        occurs="rotors that spin up, hydraulic cylinders, heating elements, a low pass in the driver",
        function=actuator_lag,
        typical=0.25,
        limit=2.0,
        sign=1,
        between=(0.0, math.inf),
        probes=(0.1, 0.3, 0.6),
        choices=_everywhere,
        lacks=_no_controls,
    ),
    Effect(
        name="actuator_delay",
        form="history",
        equation=r"u_\mathrm{acting}(t) = u(t - c)",
        text="u_acting(t) = u(t - c)",
        unit="s",
        feels="does all that it is told, later",
        occurs="radio links, buses and computers between command and motor",
        function=actuator_delay,
        typical=0.2,
        limit=2.0,
        sign=1,
        between=(0.0, math.inf),
        probes=(0.1, 0.2, 0.4),
        choices=_everywhere,
        lacks=_no_controls,
    ),
    Effect(
        name="battery_sag",
        form="history",
        equation=r"u \to (1 - c\,t / T)\,u",
        text="u → (1 - c t/T) u, T the program's duration",
        unit="1",
        feels="weaker towards the end of every drive",
        occurs="small vehicles on one battery without a voltage regulator",
        function=battery_sag,
        typical=0.25,
        limit=1.0,
        sign=1,
        lacks=_no_controls,
    ),
]
