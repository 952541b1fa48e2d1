"""Pictures of a fit's history: held-out log p(y), the noise that the observations were given, particles."""

from __future__ import annotations

import math

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from steady_ppl.errors import UsageError
from steady_ppl.runs.fit import Fit

COLOR, MARK = "#0072b2", "#d55e00"  # Okabe and Ito


def held_out_curve(fit: Fit, *, axes: Axes | None = None, label: str = "held-out log p(y)") -> Axes:
    """Held-out log p(y), the mean of a drive, over the steps; the step whose parameters were kept is marked.

    Raises:
        UsageError: the fit was not trained, or without held-out drives.
    """
    steps, values = _logged(fit, "log_likelihood", "it was fitted without held-out drives")
    axes = _over_steps(axes, "held-out log p(y) [nats a drive]")
    (line,) = axes.plot(steps, values, "o-", ms=3, label=label)
    assert fit.trained is not None
    kept = dict(zip(steps, values, strict=True)).get(fit.trained.kept)
    if kept is not None:
        axes.plot(fit.trained.kept, kept, "*", ms=11, color=line.get_color(), mec="black", label="kept")
    return axes


def observation_noise(fit: Fit, *, axes: Axes | None = None, label: str = "as the E step saw it") -> Axes:
    """The observations' noise over the steps, relative to the program's: an observation weight w widens a normal
    density by 1/√w, a KL weight κ of SVI by √κ.

    Raises:
        UsageError: the fit was not trained, or nothing was tempered.
    """
    if fit.trained is not None and any("kl_weight" in entry for entry in fit.trained.history):
        steps, weights = _logged(fit, "kl_weight", "")
        factors = [math.sqrt(weight) for weight in weights]
    else:
        steps, weights = _logged(fit, "observation_weight", "its observations were not tempered")
        factors = [1 / math.sqrt(weight) for weight in weights]
    axes = _over_steps(axes, "observation noise / the program's")
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
    guide = fit.settings.get("guide", fit.recipe)
    steps, sizes = _logged(fit, "ess", f"guide {guide} has no particles")
    _, roots = _logged(fit, "roots", f"guide {guide} has no particles")
    axes = _over_steps(axes, "particles")
    axes.plot(steps, sizes, "o-", ms=3, color=COLOR, label="effective sample size")
    axes.plot(steps, roots, "s--", ms=3, color=MARK, label="starts with descendants")
    if fit.settings.get("particles"):
        axes.axhline(fit.settings["particles"], color="black", lw=0.6, label="N")
    axes.set_yscale("log")
    axes.legend(fontsize=8)
    return axes


def _logged(fit: Fit, figure: str, why_not: str) -> tuple[list[float], list[float]]:
    if fit.trained is None:
        raise UsageError(f"recipe {fit.recipe} does not train: there is no history to draw")
    entries = [entry for entry in fit.trained.history if figure in entry]
    if not entries:
        raise UsageError(f"the history has no {figure}: {why_not}")
    return [entry["step"] for entry in entries], [entry[figure] for entry in entries]


def _over_steps(axes: Axes | None, label: str) -> Axes:
    axes = axes if axes is not None else plt.subplots(figsize=(6, 3), layout="constrained")[1]
    axes.set(xlabel="step", ylabel=label)
    return axes
