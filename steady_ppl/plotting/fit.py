"""Pictures of a fit: its posterior and forecasts, and the history of its training.

Functions draw on `axes`, on new ones where none are given, and return them. `posterior` is that of `Fit.posterior`, and
`trajectory` the label of one of its drives; another label is a `UsageError`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes

from steady_ppl.errors import UsageError
from steady_ppl.runs.fit import Fit
from steady_ppl.utils.angles import nearest_turn
from steady_ppl.utils.text import with_unit

if TYPE_CHECKING:
    import arviz

BLUE, ORANGE, BLACK = "#0072b2", "#d55e00", "black"  # Okabe and Ito


def posterior_trajectories(
    posterior: arviz.InferenceData,
    trajectory: str,
    *,
    plane: tuple[str, str] = ("x", "y"),
    landmarks: Sequence[Sequence[float]] | torch.Tensor = (),
    axes: Axes | None = None,
    color: str = BLUE,
    label: str = "posterior draws",
    shown: int = 50,
) -> Axes:
    """Draws of one trajectory in the plane, with the truth where it is known, and the landmarks.

    Args:
        plane: the state components that are drawn against each other.
        landmarks: `(K, 2)`, in the plane's units.
        shown: draw at most so many paths.

    Raises:
        UsageError: there is no such trajectory, or the program has no such states.
    """
    _, draws, true = _drawn(posterior, trajectory, plane)
    axes = axes if axes is not None else plt.subplots(figsize=(5, 5))[1]
    lines = axes.plot(*(one[:shown].T for one in draws), color=color, alpha=0.15, lw=0.8, rasterized=True)
    plt.setp(lines[:1], label=label)
    if true is not None:
        axes.plot(*true, color=BLACK, lw=1.4, ls="--", label="truth")
    if len(landmarks):
        xs, ys = torch.as_tensor(landmarks).detach().cpu().unbind(-1)
        axes.plot(xs, ys, "^", color=ORANGE, ms=8, label="landmark", clip_on=True)
    units = [one.attrs.get("units") for one in draws]
    axes.set(xlabel=with_unit(plane[0], units[0]), ylabel=with_unit(plane[1], units[1]))
    if units[0] == units[1]:
        axes.set_aspect("equal", "box")
    axes.set_title(f"trajectory {trajectory}", parse_math=False)
    return axes


def posterior_states(
    posterior: arviz.InferenceData,
    trajectory: str,
    components: Sequence[str],
    *,
    axes: Sequence[Axes] | None = None,
    color: str = BLUE,
    label: str = "posterior",
) -> Sequence[Axes]:
    """State components over time, one axes each: median and 90 % of the draws, and the truth where it is known.

    Raises:
        UsageError: there is no such trajectory, or the program has no such states.
    """
    time, draws, true = _drawn(posterior, trajectory, components)
    called = [with_unit(name, one.attrs.get("units")) for name, one in zip(components, draws, strict=True)]
    return _bands(axes, time, called, draws, true, color, label)


def posterior_velocities(
    posterior: arviz.InferenceData,
    trajectory: str,
    *,
    axes: Sequence[Axes] | None = None,
    color: str = BLUE,
    label: str = "posterior",
) -> Sequence[Axes]:
    """Longitudinal and lateral velocity of a planar vehicle in the body frame, on two axes, as in `posterior_states`.

    Raises:
        UsageError: there is no such trajectory, or the program has not the states heading, vx and vy.
    """
    time, draws, true = _drawn(posterior, trajectory, ("heading", "vx", "vy"))
    called = [with_unit(name, draws[1].attrs.get("units")) for name in ("longitudinal", "lateral")]
    bodily = None if true is None else _in_body_frame(*true)
    return _bands(axes, time, called, _in_body_frame(*draws), bodily, color, label)


def effective_sizes(posterior: arviz.InferenceData, trajectory: str, *, axes: Axes | None = None) -> Axes:
    """How many particles the filter had in effect in each row, of N; a UsageError where there is no such trajectory."""
    time = _time(posterior, trajectory)
    axes = axes if axes is not None else plt.subplots(figsize=(6, 3), layout="constrained")[1]
    sizes = posterior["sample_stats"]["effective_size"].sel(trajectory=trajectory, chain=0)
    about = posterior["posterior"].attrs
    axes.plot(time, sizes, color=BLUE, label=about["filter"])
    axes.axhline(about["particles"], color="black", lw=0.6, label="N")
    axes.set(yscale="log", xlabel="time [s]", ylabel="effective sample size [particles]")
    axes.legend(fontsize=8)
    return axes


def forecast_band(
    found: arviz.InferenceData, trajectory: str, of: str, *, axes: Axes | None = None, color: str = ORANGE
) -> Axes:
    """Median and 90 % of a forecast, what was measured before and, where the table has any, after the moment.

    Args:
        found: of `Fit.forecast`.
        of: a state component or a measurement; `measured_…` for a measurement that is called like a state.

    Raises:
        UsageError: there is no such trajectory, or nothing of that name was forecast.
    """
    time = _time(found, trajectory)
    variables, later = found["predictions"], found["predictions_constant_data"]
    name = of if of in variables else f"measured_{of}"
    if name not in variables:
        raise UsageError(f"no forecast of {of!r}; there are {', '.join(map(str, variables.data_vars))}")
    axes = axes if axes is not None else plt.subplots(figsize=(7, 3), layout="constrained")[1]
    draws = variables[name].sel(trajectory=trajectory, chain=0)
    there = np.isfinite(draws.values).all(0)
    low, median, high = np.quantile(draws.values[:, there], [0.05, 0.5, 0.95], axis=0)
    axes.fill_between(time[there], low, high, color=color, alpha=0.25, lw=0, label="forecast, 90 %")
    axes.plot(time[there], median, color=color, lw=1.4, label="forecast, median")
    if name in found["observed_data"]:
        axes.plot(time, found["observed_data"][name].sel(trajectory=trajectory), ".", color=BLACK, ms=3, label="used")
        after = later[name].sel(trajectory=trajectory).values[there]
        if np.isfinite(after).any():
            after = nearest_turn(after, median) if variables[name].attrs["circular"] else after
            axes.plot(time[there], after, "x", color=BLACK, ms=4, label="measured later")
    elif f"true_{of}" in found["constant_data"]:
        truth = found["constant_data"][f"true_{of}"].sel(trajectory=trajectory)
        axes.plot(time, truth, "--", color=BLACK, label="truth")
    axes.set(xlabel="time [s]", ylabel=with_unit(of, variables[name].attrs.get("units")))
    axes.legend(fontsize=8)
    return axes


def held_out_curve(fit: Fit, *, axes: Axes | None = None, label: str = "held-out log p(y)") -> Axes:
    """Held-out log p(y), the mean of a trajectory, over the steps; the step whose parameters were kept is marked.

    Raises:
        UsageError: the fit was not trained, or without held-out trajectories.
    """
    steps, values = _logged(fit, "log_likelihood", "it was fitted without held-out trajectories")
    axes = _over_steps(axes, "held-out log p(y) [nats a trajectory]")
    (line,) = axes.plot(steps, values, "o-", ms=3, label=label)
    assert fit.trained is not None
    if fit.trained.rise:
        axes.plot(fit.trained.kept, fit.trained.rise[1], "*", ms=11, color=line.get_color(), mec="black", label="kept")
    return axes


def observation_noise(fit: Fit, *, axes: Axes | None = None, label: str = "as the E step saw it") -> Axes:
    """The observations' noise over the steps, relative to the program's: an observation weight w widens a normal
    density by 1/√w, a KL weight κ of SVI by √κ.

    Raises:
        UsageError: the fit was not trained, or nothing was tempered.
    """
    annealed = fit.trained is not None and any("kl_weight" in entry for entry in fit.trained.history)
    figure = "kl_weight" if annealed else "observation_weight"
    steps, weights = _logged(fit, figure, "its observations were not tempered")
    factors = [math.sqrt(weight) if annealed else 1 / math.sqrt(weight) for weight in weights]
    axes = _over_steps(axes, "observation noise / the model's")
    axes.plot(steps, factors, "o-", ms=3, label=label)
    axes.axhline(1, color="black", lw=0.6)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("{x:g}")
    return axes


def particle_curve(fit: Fit, *, axes: Axes | None = None) -> Axes:
    """Effective sample size of the E step's filter and starts with descendants, of N particles, over the steps.

    Raises:
        UsageError: the fit was not trained, or its guide has no particles.
    """
    why_not = f"guide {fit.settings.get('guide', fit.recipe)} has no particles"
    steps, sizes = _logged(fit, "ess", why_not)
    _, roots = _logged(fit, "roots", why_not)
    axes = _over_steps(axes, "particles")
    axes.plot(steps, sizes, "o-", ms=3, color=BLUE, label="effective sample size")
    axes.plot(steps, roots, "s--", ms=3, color=ORANGE, label="starts with descendants")
    if fit.settings.get("particles"):
        axes.axhline(fit.settings["particles"], color="black", lw=0.6, label="N")
    axes.set_yscale("log")
    axes.legend(fontsize=8)
    return axes


def _time(found: arviz.InferenceData, trajectory: str) -> Any:
    """The times of a trajectory's rows, s; a label that no drive has is refused."""
    known = found["posterior"]["trajectory"].values
    if trajectory not in known:
        raise UsageError(f"no trajectory {trajectory!r}; there are {', '.join(map(str, known))}")
    return found["constant_data"]["time"].sel(trajectory=trajectory)


def _drawn(posterior: arviz.InferenceData, trajectory: str, components: Sequence[str]) -> tuple[Any, list[Any], Any]:
    """Times, draws of these state components, and their true values where all are known beyond a start."""
    time, states = _time(posterior, trajectory), posterior["posterior"]
    plain = [str(name) for name, values in states.data_vars.items() if values.ndim == 4]
    if lacking := [name for name in components if name not in plain]:
        raise UsageError(f"no state {', '.join(lacking)} in this posterior; there are {', '.join(plain)}")
    constants = posterior["constant_data"].sel(trajectory=trajectory)
    true = [constants.get(f"true_{name}") for name in components]
    known = all(one is not None and int(one.notnull().sum()) > 1 for one in true)
    draws = [states[name].sel(trajectory=trajectory, chain=0) for name in components]
    return time, draws, true if known else None


def _bands(
    axes: Sequence[Axes] | None, time: Any, called: list[str], draws: Sequence[Any], true: Any, color: str, label: str
) -> Sequence[Axes]:
    """Median and 90 % of the draws over time, one axes each; the truth where no other picture has drawn it yet."""
    if axes is None:
        size = (7, 0.5 + 2 * len(draws))
        axes = list(plt.subplots(len(draws), 1, figsize=size, sharex=True, squeeze=False)[1][:, 0])
    for index, (one, name) in enumerate(zip(axes, called, strict=True)):
        low, median, high = draws[index].quantile([0.05, 0.5, 0.95], dim="draw")
        one.fill_between(time, low, high, color=color, alpha=0.25, lw=0)
        one.plot(time, median, color=color, lw=1.4, label=label)
        if true is not None and not any(line.get_label() == "truth" for line in one.get_lines()):
            one.plot(time, true[index], color=BLACK, lw=1.2, ls="--", label="truth")
        one.set_ylabel(name)
    axes[-1].set_xlabel("time [s]")
    return axes


def _in_body_frame(heading: Any, vx: Any, vy: Any) -> tuple[Any, Any]:
    cos, sin = np.cos(heading), np.sin(heading)
    return cos * vx + sin * vy, cos * vy - sin * vx


def _logged(fit: Fit, figure: str, why_not: str) -> tuple[list[float], list[float]]:
    if fit.trained is None:
        raise UsageError(f"recipe {fit.recipe} does not train: there is no history to draw")
    if not (entries := [entry for entry in fit.trained.history if figure in entry]):
        raise UsageError(f"the history has no {figure}: {why_not}")
    return [entry["step"] for entry in entries], [entry[figure] for entry in entries]


def _over_steps(axes: Axes | None, label: str) -> Axes:
    axes = axes if axes is not None else plt.subplots(figsize=(6, 3), layout="constrained")[1]
    axes.set(xlabel="step", ylabel=label)
    return axes
