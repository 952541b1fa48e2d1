"""Write docs/gallery.md and its pictures: python docs/gallery.py

Each effect of the catalogue with its equation, where it occurs, the same trajectory with it and without it, and what it
was confused with in the discovery benchmark.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from steady_ppl import Program, Trajectories, from_arrays, load_program, simulate
from steady_ppl.effects import Effect, catalogue
from steady_ppl.model.program import for_program, names, unit_of, units
from steady_ppl.sensors import BodyVelocity

DOCS = Path(__file__).parent
ROOT = DOCS.parent
RECORDS = ROOT / "benchmarks" / "results" / "discovery-continuous.jsonl"
# the first that can have an effect shows it
PROGRAMS = ("hovercraft", "truck", "pendulum", "car", "differential_drive")
QUIET = 0.1  # of the channels' noise, so that the effect is seen; but for effects on that noise
# of drives on which much happens
SEEDS = {"hovercraft": 4, "truck": 3, "pendulum": 4, "car": 1, "differential_drive": 1}
LONG_ROW, SWING = 1.0, 1.2  # s, rad/s: rows and controls that show what a control does within a row
WITH, WITHOUT = "#d55e00", "#0072b2"  # Okabe and Ito
HEAD = """# Effect gallery

Every effect of the catalogue: its equation, its look, and the effects it is confused with.

Each picture has one trajectory twice, with the same controls and noise: blue without the effect, orange with it at \
its typical size. The noise is a tenth of the model's, except for effects on that noise. `first_order_hold` has rows \
of 1 s.

Confusions are counted in the [discovery benchmark](../benchmarks/results/discovery-continuous.md): hovercraft \
trajectories with one effect, in most sets a small one. An effect is *in the class* if the search named it, or \
reported that the data cannot tell it from the one it named. Where more data would not end a confusion, other \
controls do: `steady discover` proposes them.

[The catalogue as a table](effects.md) has units, typical sizes and options; [how a search decides](discovery.md).
"""


def main() -> None:
    (DOCS / "gallery").mkdir(exist_ok=True)
    for effect in catalogue():
        picture(effect).savefig(DOCS / "gallery" / f"{slug(effect)}.png", dpi=70, metadata={"Software": None})
        print(slug(effect), file=sys.stderr)
    (DOCS / "gallery.md").write_text(page())


def page() -> str:
    """The gallery in Markdown."""
    records = [json.loads(line) for line in RECORDS.read_text().splitlines()]
    lines = [HEAD]
    for verdict in dict.fromkeys(effect.verdict for effect in catalogue()):
        lines += [f"## {verdict.capitalize()}", ""]
        for effect in catalogue():
            if effect.verdict == verdict:
                lines += entry(effect, records)
    return "\n".join(lines).rstrip() + "\n"


def entry(effect: Effect, records: list[dict]) -> list[str]:
    """One effect."""
    title = f"`{effect.name}`" + (f" on a {program_of(effect)[0]}" if slug(effect) != effect.name else "")
    typical = effect.typical if isinstance(effect.typical, tuple) else (effect.typical,)
    unit = "" if effect.unit == "1" else f" {effect.unit}"
    return [
        f"### {title}",
        "",
        f"$${effect.equation}$$",
        "",
        f"**Feels:** {effect.feels}. **Where:** {effect.occurs}. "
        f"Typically c = {', '.join(f'{value:.3g}' for value in typical)}{unit}.",
        "",
        f"![The same trajectory with and without {effect.name}](gallery/{slug(effect)}.png)",
        "",
        confusions(effect, records),
        "",
    ]


def confusions(effect: Effect, records: list[dict]) -> str:
    """What it was taken for when it was planted alone, counted over the benchmark's sets."""
    planted = [
        record
        for record in records
        if not record["withheld"] and [name_of(one) for one in record["effects"]] == [effect.name]
    ]
    if not planted or program_of(effect)[0] != "hovercraft":
        return "Confused with: not measured; the benchmark's hovercraft cannot have it, or it was not planted there."
    inside = sum(effect.name in map(name_of, record["class"]) for record in planted)
    others = Counter(one for record in planted for one in {*map(name_of, record["class"])} - {effect.name})
    behind = Counter(
        next((one for one in map(name_of, record["ranking"]) if one != effect.name), None) for record in planted
    )
    said = ", ".join(f"`{name}` ({count})" for name, count in others.most_common(3)) or "nothing"
    nearest = ", ".join(f"`{name}` ({count})" for name, count in behind.most_common(2))
    return (
        f"Confused with: in the class in {inside} of {len(planted)} sets; also there: {said}. "
        f"Ranked next to it most often: {nearest}."
    )


def name_of(text: str) -> str:
    """The effect's name in `NAME[:AT]…[=VALUE]`."""
    return text.split("=")[0].split(":")[0]


def slug(effect: Effect) -> str:
    """Its name, with the program's where two effects have one name."""
    alike = [other for other in catalogue() if other.name == effect.name]
    return effect.name if len(alike) == 1 else f"{effect.name}-{program_of(effect)[0]}"


def program_of(effect: Effect) -> tuple[str, Program]:
    """The program that shows it, quiet."""
    for name in PROGRAMS:
        program = load_program(ROOT / "models" / f"{name}.py")
        if name == "car":  # nobody knows of its antenna
            known = (replace(one, offset=None) if one.kind == "position" else one for one in program.sensors)
            program.sensors = (*known, BodyVelocity(sd=0.05, name="doppler"))
        if effect.lacks(program) is None:
            with torch.no_grad():
                program.noise = program.noise * (1.0 if effect.form in ("spread", "colour") else QUIET)
            return name, program.requires_grad_(False)
    raise SystemExit(f"no example model can have {effect.name}")


def picture(effect: Effect) -> Figure:
    """The path, or the phase plane, and over time what changed most."""
    name, program = program_of(effect)
    like = swinging(program) if effect.form == "between" else None
    drives = [simulate(one, 1, seed=SEEDS[name], like=like) for one in (program, program.with_effect(effect))]
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.6))
    across, up = ("x", "y") if "x" in drives[0].state_names else drives[0].state_names[:2]
    for drive, color, label in zip(drives, (WITHOUT, WITH), ("without", "with"), strict=True):
        states = dict(zip(drive.state_names, drive.states[:, 0].unbind(-1), strict=True))
        left.plot(states[across], states[up], color=color, label=label, lw=1.5, ls="-" if label == "with" else "--")
    left.legend(fontsize=8)
    for one, name in ((left.set_xlabel, across), (left.set_ylabel, up)):
        one(f"{name} [{unit_of(program, name)}]")
    if (across, up) == ("x", "y"):
        left.set_aspect("equal", "datalim")
    name, series = most_changed(effect, program, drives)
    for values, color in zip(series, (WITHOUT, WITH), strict=True):
        mark = "--" if color == WITHOUT else "-"
        right.plot(drives[0].time[:, 0], values, mark, color=color, lw=1.5)
    right.set_xlabel("time [s]")
    right.set_ylabel(name, fontsize=8)
    return figure


def swinging(program: Program) -> Trajectories:
    """Twenty seconds of long rows, with controls that change from each to the next."""
    time = np.arange(0, 20 + LONG_ROW / 2, LONG_ROW)
    controls = {f"u.{name}": 0.6 + 0.6 * np.sin(SWING * time / (i + 1)) for i, name in enumerate(program.control_names)}
    measured = {f"y.{name}": np.zeros_like(time) for name in program.measurement_names}
    return from_arrays([{"time": time, **controls, **measured}])


def most_changed(effect: Effect, program: Program, drives: list[Trajectories]) -> tuple[str, list[np.ndarray]]:
    """Velocities, or for what only measurements show these less what the vehicle without the effect would measure."""
    if effect.verdict == "sensor" or effect.form in ("blur", "tails"):
        clear, seen = (drive.measurements[:, 0] for drive in drives)
        change = torch.remainder(seen - clear + np.pi, 2 * np.pi) - np.pi if program.angles else seen - clear
        worst = int(change.abs().sum(0).argmax())
        label = f"{names(program.measurements)[worst]},\nthe effect's part [{units(program.measurements)[worst]}]"
        return label, [torch.zeros(len(change)).numpy(), change[:, worst].numpy()]
    velocities = [program.velocities(for_program(program, drive).states[:, 0]) for drive in drives]
    share = {name: float((velocities[1][name] - value).abs().mean()) for name, value in velocities[0].items()}
    worst = max(share, key=lambda name: share[name])
    unit = "rad/s" if worst == "yaw" or "rad/s" in unit_of(program, program.motion.get(worst, ("", ""))[1]) else "m/s"
    return f"{worst} velocity [{unit}]", [one[worst].numpy() for one in velocities]


if __name__ == "__main__":
    main()
