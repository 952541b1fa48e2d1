"""What `check` found, in words, as a plain dict and as a table of text."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from steady_ppl.criticism.attribution import MIN_GAIN_OF_KIND, Attribution
from steady_ppl.criticism.baselines import DEFINITION, Reference
from steady_ppl.criticism.residual_maps import Cell, Misfit, Residuals, SignificantCell
from steady_ppl.criticism.step_size import StepCheck
from steady_ppl.data.frozen_sensors import Stretch
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.predict import HALF_WIDTH, Prediction
from steady_ppl.likelihood.information import ParameterInformation
from steady_ppl.likelihood.outliers import Outliers
from steady_ppl.model.program import Program, unit_of
from steady_ppl.utils.context import Displayed
from steady_ppl.utils.text import aligned, figure, with_unit

MAX_FINDINGS_SHOWN = 8  # findings in the table
MIN_GAIN_OF_FIT = 1.0  # nats that a longer fit must gain to be what is advised first
VERDICTS = {  # the verdict; and what stands out as well, which is no verdict while the parameters are wrong
    "sensor": ("the sensor model is wrong", "the sensor model stands out"),
    "actuator": ("the actuator model is wrong", "the actuator model stands out"),
    "dynamics": ("the dynamics are wrong", "the dynamics stand out"),
    "noise": ("the noise is wrong", "the noise stands out"),
    "parameters": ("the parameters are wrong", ""),
    "cannot tell": ("these trajectories cannot tell which part is wrong", ""),
}


@dataclass(frozen=True, repr=False)
class Check(Displayed):
    """What `check` found.

    Attributes:
        program: that was judged.
        data: the trajectories, as the program reads them, without outliers.
        path: near their posterior means.
        horizons: name → how many rows ahead, "one step" first.
        predictions: horizon → measured less predicted.
        floor: horizon → RMSE of each component in each simulated set, `(M, K)`, see `floor_name`.
        reference: the vehicle that keeps its velocity, or why there is none.
        held: horizon → measured less last measured, and where both exist.
        step: the program beside itself at finer steps, refitted to these trajectories.
        misfit: the maps; every cell with its residual.
        blame: which part is wrong.
        residuals: names of the measurement components and, after them, of the channels.
        standardised: the residuals themselves, one set, with the variables that the regimes are ranges of.
        stuck: stretches of the table in which nothing was measured though something is written.
        outliers: readings that no noise of the sensors explains; nothing else is about them.
        information: how well the trajectories of its fit determine the program's parameters; None where nobody said.
        is_open: whether bands hold what these leave open, for it was not fitted to the trajectories that are checked.
        notes: what was left out.
    """

    program: Program
    data: Trajectories
    path: ReferencePath
    horizons: dict[str, int]
    predictions: dict[int, Prediction]
    floor: dict[int, np.ndarray]
    reference: Reference | str
    held: dict[int, tuple[Tensor, Tensor]]
    step: StepCheck
    misfit: Misfit
    blame: Attribution
    residuals: list[str]
    standardised: Residuals
    stuck: list[Stretch]
    outliers: Outliers
    information: ParameterInformation | None
    is_open: bool
    notes: list[str]

    @property
    def figures(self) -> dict[str, Any]:
        """Everything as a plain dict, ready for JSON; every figure is finite, None where there is none."""
        blame, misfit, reference = self.blame, self.misfit, self.reference
        scatter = zip(self.residuals, misfit.dispersion.tolist(), strict=True)
        about: dict[str, Any] = {"what": DEFINITION, "why_not": reference if isinstance(reference, str) else None}
        if isinstance(reference, Reference):
            about |= {"noise": reference.program.scales.tolist(), "log_likelihood": reference.log_likelihood}
        return {
            "verdict": verdict(self),
            "who": blame.kind,
            "p_value": blame.p_value,
            "program": type(self.program).__name__,
            "trajectories": len(self.data),
            "simulations": len(misfit.simulated),
            "parameter_uncertainty": self.is_open,
            "gain_of_longer_fit": self.information.gain if self.information else None,
            "measurements": {name: _component(self, i) for i, name in enumerate(self.program.measurement_names)},
            "constant_velocity": about | {"loses_to_it": lost_horizons(self)},
            "findings": [
                {"text": sentence(self, one), "map": one.cell.map, "residual": self.residuals[one.cell.residual]}
                | {"where": {key: _plain(self, key, value) for key, value in one.cell.where.items()}}
                | {"count": one.cell.count, "mean": one.cell.mean, "z": one.z, "p_value": one.p_value}
                for one in misfit.significant
            ],
            "cells": len(misfit.cells),
            "evidence": {
                "p_values": blame.p_values,
                "explained_nats": blame.explained,
                "directions": [{"kind": kind, "direction": name, "z": z} for kind, name, z in blame.evidence],
                "parameters": blame.parameters,
                "noise": blame.noise,
                "scatter": {name: ratio for name, ratio in scatter if math.isfinite(ratio)},
            },
            "step": self.step.figures,
            "stuck": [
                {"trajectory": one.label, "seconds": list(one.seconds), "columns": list(one.columns), "text": str(one)}
                for one in self.stuck
            ],
            "outliers": self.outliers.figures,
            "notes": self.notes,
        }

    def __str__(self) -> str:
        content = self.figures
        table = [["", "ahead", "RMSE", floor_name(self), "constant velocity", "last measurement", "in 90 % band"]]
        for name, component in content["measurements"].items():
            for horizon, row in component["horizons"].items():
                keys = ("rmse", "noise_floor", "constant_velocity", "last_measurement")
                cells = [figure(row[key], ".4g") for key in keys]
                table.append([with_unit(name, component["unit"]), horizon, *cells, f"{row['coverage_90']:.1%}"])
        lines = [content["verdict"], "", *aligned(table, left=(0, 1))]
        ratios = ", ".join(f"{name} {value:.2f}" for name, value in content["evidence"]["scatter"].items())
        lines += ["", f"mean squares over those of simulated trajectories (nearly blind to a missing effect): {ratios}"]
        total, cells = len(content["findings"]), content["cells"]
        lines += ["", f"{total} of {cells} cells are outside their simulated bands (false discoveries held at 5 %)"]
        lines += [f"  {finding['z']:+6.1f} sd  {finding['text']}" for finding in strongest(content["findings"])]
        lines += [f"the table: {one['text']}" for one in content["stuck"]]
        lines += self.outliers.lines()
        return "\n".join(lines + [f"note: {note}" for note in content["notes"]])

    def __repr__(self) -> str:
        return f"Check({verdict(self)!r})"


def _component(found: Check, index: int) -> dict[str, Any]:
    """Errors of one measurement component by horizon, in its unit."""
    horizons: dict[str, Any] = {}
    for name, horizon in found.horizons.items():
        prediction = found.predictions[horizon]
        seen = prediction.observed[..., index]
        if not (count := int(seen.sum())):
            continue
        theirs = found.reference.predictions[horizon] if isinstance(found.reference, Reference) else None
        error, both = found.held[horizon]
        floor = torch.from_numpy(found.floor[horizon][:, index]).double()
        horizons[name] = {
            "rmse": _rms(prediction.error[..., index], seen),
            "noise_floor": float(floor.mean()),
            "noise_floor_90": [float(floor.quantile(0.05)), float(floor.quantile(0.95))],
            "constant_velocity": _rms(theirs.error[..., index], theirs.observed[..., index]) if theirs else None,
            "last_measurement": _rms(error[..., index], both[..., index]),
            "predicted_sd": float(prediction.variance[..., index][seen].mean().sqrt()),
            "coverage_90": float(prediction.covered()[..., index].sum()) / count,
            "count": count,
        }
    return {"unit": found.program.measurement_units[index], "horizons": horizons}


def floor_name(found: Check) -> str:
    """What the errors of simulated sets are from."""
    return "noise and fit" if found.is_open else "noise alone"


def _rms(error: Tensor, there: Tensor) -> float | None:
    return float(error[there].double().square().mean().sqrt()) if bool(there.any()) else None


def over_floor(error: Tensor, there: Tensor, floor: np.ndarray) -> float:
    """Errors `(·, B, K)` over the noise floor's, `(M, K)`: root mean square over the components; NaN without any."""
    typical, count = floor.mean(0), there.numpy(force=True).sum((0, 1))
    square = torch.where(there, error, 0.0).numpy(force=True) ** 2
    means, known = square.sum((0, 1)) / np.maximum(count, 1), (count > 0) & (typical > 0)
    return float(np.sqrt((means[known] / typical[known] ** 2).mean())) if known.any() else np.nan


def measured_values(found: Check) -> np.ndarray:
    """What was measured, `(T + 1, B, K)`, NaN where it was not."""
    return np.where(found.data.observed.numpy(force=True), found.data.measurements.double().numpy(force=True), np.nan)


def band(found: Check, horizon: str) -> tuple[np.ndarray, np.ndarray]:
    """The middle of the predictions so far ahead and half the width of their 90 % bands, `(T + 1, B, K)` each.

    NaN where nothing was measured, and where a line would cross the whole circle because an angle comes round.
    """
    rows = found.horizons[horizon]
    prediction = found.predictions[rows]
    there = prediction.observed.numpy(force=True)
    middle, half = np.full((2, *found.data.measurements.shape), np.nan)
    middle[rows:] = np.where(there, measured_values(found)[rows:] - prediction.error.numpy(force=True), np.nan)
    half[rows:] = HALF_WIDTH * np.sqrt(np.where(there, prediction.variance.numpy(force=True), np.nan))
    jumps = np.abs(np.diff(middle, axis=0, prepend=middle[:1])) > np.maximum(np.pi, 3 * np.nan_to_num(half))
    return np.where(jumps, np.nan, middle), half


def strips(found: Check) -> tuple[list[tuple[float, float]], np.ndarray]:
    """The strips of time, s, and z of each residual, drive and strip; NaN where there are too few residuals."""
    cells = found.misfit.of_map("drive and time")
    times = sorted({cell.where["time"] for cell, _ in cells})
    grid = np.full((len(found.residuals), len(found.data), len(times)), np.nan)
    for cell, z in cells:
        grid[cell.residual, cell.where["drive"], times.index(cell.where["time"])] = z
    return times, grid


def lost_horizons(found: Check) -> list[str]:
    """Horizons at which the program predicts worse than the vehicle that keeps its velocity: the mean difference over
    drives of the squared errors is above zero by 1.6 of its standard errors."""
    if isinstance(found.reference, str):
        return []
    lost = []
    for name, horizon in found.horizons.items():
        ours, theirs = found.predictions[horizon], found.reference.predictions[horizon]
        there = ours.observed & theirs.observed
        scale = torch.where(there, theirs.error, 0.0).square().sum((0, 1)) / there.sum((0, 1)).clamp(min=1)
        worse = torch.where(there, (ours.error.square() - theirs.error.square()) / scale.clamp(min=1e-300), 0.0)
        of_drive = worse.sum((0, 2))[there.any(-1).any(0)]
        error = float(of_drive.std()) / math.sqrt(len(of_drive)) if len(of_drive) > 1 else 0.0
        if len(of_drive) and float(of_drive.mean()) > 1.645 * error:
            lost.append(name)
    return lost


def verdict(found: Check) -> str:
    """The first line of `steady check`: one sentence, after a first one on the time step where that is too coarse."""
    first, blame = found.step.sentence, found.blame
    discover = "`steady discover` tests the physical effects by name"
    if first:
        first = f"{first[0].upper()}{first[1:]}: refit at that step first; what follows is of the coarse one. "
    if blame.kind == "nothing found":
        drives, alone = len(found.data), len(found.misfit.significant)
        where = "in no place, time or regime more than" if not alone else "over all tests no more than"
        which = "this trajectory" if drives == 1 else f"these {drives} trajectories"
        said = f"Nothing found: on {which} the model errs {where}"
        said += " on simulated trajectories of its own, which is no proof"
        said += f" ({alone} of {len(found.misfit.cells)} cells would stand out by themselves)" if alone else ""
        said += "; `steady discover` says what could not have been seen"
    else:
        said = "The model does not fit these trajectories: "
        if blame.p_values["parameters"] <= blame.level:
            (fault, _), (_, beside) = VERDICTS["parameters"], VERDICTS[blame.kind]
            said += f"{fault}{_parameters(blame)}{_of_fit(found.information)}"
            said += f"; beside them {beside}{_most_clearly(blame)}" if beside else ""
            said += f"; {discover}" if _is_done(found.information) else f"; otherwise {discover}"
        else:
            of_noise = "the effects of kind noise in `steady discover` say how"
            next_command = of_noise if blame.kind == "noise" else discover
            said += f"{VERDICTS[blame.kind][0]}{_most_clearly(blame)}; {next_command}"
    if loses := lost_horizons(found):
        said += f"; it predicts worse than constant velocity ({', '.join(loses)} ahead)"
    return f"{first}{said}."


def _is_done(fitted: ParameterInformation | None) -> bool:
    """Whether a longer fit would gain nothing."""
    return fitted is not None and fitted.gain < MIN_GAIN_OF_FIT


def _of_fit(fitted: ParameterInformation | None) -> str:
    """What to do where parameters do not suit: what a fit that has ended leaves is structure."""
    again = "fit it again first (more --steps, or --recipe likelihood)"
    if fitted is None:
        return f": {again}"
    if _is_done(fitted):
        return ", although the fit has converged: these trajectories are of another vehicle, or an effect is missing"
    return f", and the fit has not converged (a longer one gains {fitted.gain:.2g} nats, linearised): {again}"


def _most_clearly(blame: Attribution) -> str:
    if blame.kind == "noise":
        name = max(blame.noise, key=lambda name: abs(blame.noise[name]))
        return f", most clearly the {name}, {'more' if blame.noise[name] > 0 else 'less'} than the model says"
    if blame.kind == "cannot tell":
        close = sorted(blame.explained, key=lambda kind: -blame.explained[kind])[:2]
        alike = len(close) == 2 and min(blame.explained[kind] for kind in close) > 3
        return f" ({close[0]} and {close[1]} fit them nearly alike)" if alike else ""
    _, name, z = blame.evidence[0]
    return f", most clearly the {name} (score {z:+.1f} standard deviations)"


def _parameters(blame: Attribution) -> str:
    """The parameter that explains most alone, and those that explain nearly as much."""
    order = sorted(blame.parameters.items(), key=lambda item: -abs(item[1]))
    least = order[0][1] ** 2 - 2 * MIN_GAIN_OF_KIND * max(1.0, blame.dispersion)
    alike = [f"{name} ({'larger' if z > 0 else 'smaller'} fits better)" for name, z in order if z**2 >= least]
    return f", most clearly {' or '.join(alike)}"


def subject(found: Check, residual: int) -> str:
    """What a residual is of, in words."""
    name = found.residuals[residual]
    return name if residual < len(found.program.measurement_names) else f"{name} acceleration"


def sentence(found: Check, finding: SignificantCell) -> str:
    """A finding in words."""
    cell = finding.cell
    name, more, where = subject(found, cell.residual), finding.z > 0, place(found, cell)
    if cell.map == "memory":
        return f"the misfit of {name} {'keeps' if more else 'changes'} its sign {where}"
    if cell.map == "lag":
        return f"the misfit of {name} goes {'with' if more else 'against'} {where}"
    if cell.residual >= len(found.program.measurements):
        return f"{name} {'above' if more else 'below'} the model's{where}"
    size = f"{abs(cell.mean or 0.0):.2g} {found.program.measurement_units[cell.residual]} ".replace("  ", " ")
    return f"{name} measured {size}{'above' if (cell.mean or 0.0) > 0 else 'below'} its prediction{where}"


def place(found: Check, cell: Cell) -> str:
    """Where a cell is, in words with units."""
    seconds = found.data.median_step
    if cell.map == "memory":
        return f"{cell.where['lag'] * seconds:.2g} s later"
    if cell.map == "lag":
        ((name, lag),) = cell.where.items()
        return f"the {name} {f'{lag * seconds:.2g} s before' if lag else 'at the same time'}"
    words = []
    for key, value in cell.where.items():
        if key == "drive":
            words.append(f"on trajectory {found.data.labels[value]}")
        elif key == "time":
            words.append(f"between {value[0]:.1f} and {value[1]:.1f} s")
        else:
            span = f"{key} is between {value[0]:.3g} and {value[1]:.3g} {unit_of(found.program, key)}".rstrip()
            words.append(f"{'and' if words else 'while'} {span}")
    return "".join(f" {word}" for word in words)


def _plain(found: Check, key: str, value: Any) -> Any:
    return found.data.labels[value] if key == "drive" else list(value) if isinstance(value, tuple) else value


def strongest(findings: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The strongest findings, one of a map, residual and variables each."""
    kept: dict[Any, dict[str, Any]] = {}
    for finding in findings:
        kept.setdefault((finding["map"], finding["residual"], tuple(finding["where"])), finding)
    return list(kept.values())[:MAX_FINDINGS_SHOWN]
