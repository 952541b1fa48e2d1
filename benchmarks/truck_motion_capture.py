"""Say what the AlphaTruck does in continuous time, from its 100 Hz motion capture.

    python benchmarks/truck_motion_capture.py --data FOLDER --json FILE --markdown FILE

FOLDER holds train/, valid/ and test/ with the authors' logs. No code of steady-ppl is used: the numbers are a
reference for what is found from bearings alone. Here are the analysis of all splits and its page; the logs, the linear
laws and the responses are in `truck_capture_logs.py`, `truck_capture_regressions.py` and `truck_capture_responses.py`.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from truck_capture_logs import BLOCK, DEGREE, WINDOW, LogError, Segment, as_rows, numbered, read_split
from truck_capture_regressions import (
    LATERAL,
    euler_from_continuous,
    lateral,
    lateral_by_euler,
    lateral_by_instruments,
    steady_gains,
)
from truck_capture_responses import CHOSEN, RESPONSES, Numbers, fitted, process_noise

OTHER_WINDOWS = (0.15, 0.41)  # s
SPLITS = ("train", "valid", "test")
TOGETHER = "together"

UNITS = {
    "lever": "m",
    "slip": "s",
    "crab": "rad",
    "offset": "m/s",
    "yaw_lag": "m s",
    "settling": "s",
    "gain": "1",
    "lag": "s",
    "delay": "s",
    "bias": "m/s²",
    "turning": "1",
    "limit": "m/s²",
    "integral": "1/s²",
    "share": "1",
    "caster": "1/m",
    "reverse": "1",
    "understeer": "s²/m²",
    "forwards": "1",
    "backwards": "1",
}
PER_ROW = {"forward": "m/s²", "lateral": "m/s²", "yaw": "rad/s²"}


def values(fit: Mapping[str, Any]) -> dict[str, float]:
    """Return the best parameters of a fit."""
    return {name: entry["value"] for name, entry in fit["parameters"].items()}


def analyse(
    data: Path, *, window: float = WINDOW, block: float = BLOCK, draws: int = 1000, seed: int = 0
) -> dict[str, Any]:
    """Fit everything on each split and on all together, and what hinges on a choice on all together.

    Returns:
        `fits`: part, split, variant, form, parameters, rms, blocks; `euler`: what the Euler form is predicted to
        find, by split; `noise`: by split.
    """
    options: dict[str, Any] = {"draws": draws, "seed": seed}

    def load(**more: Any) -> dict[str, list[Segment]]:
        splits = {name: read_split(data / name, **({"window": window, "block": block} | more)) for name in SPLITS}
        return splits | {TOGETHER: numbered([segment for name in SPLITS for segment in splits[name]])}

    fits: list[dict[str, Any]] = []

    def note(part: str, split: str, form: str, fit: dict[str, Any], variant: str = "") -> dict[str, Any]:
        fits.append({"part": part, "split": split, "variant": variant or f"{window:g} s", "form": form} | fit)
        return fit

    euler, noise = {}, {}
    for split, raw in load().items():
        segments = numbered(raw)
        for form, names in LATERAL.items():
            note("lateral velocity", split, form, lateral(segments, names, **options))
            if "yaw_lag" not in names:
                note("lateral velocity, Euler", split, form, lateral_by_euler(segments, names, **options), "10 Hz")
        found = values(lateral(segments, LATERAL["lever, slip"], **options))
        euler[split] = euler_from_continuous(segments, **found)
        note("steady speed", split, "forwards, backwards", steady_gains(segments, **options))
        rows, held = as_rows(segments), as_rows(segments, held=True)
        numbers = {}
        for part, responses in RESPONSES.items():
            for form, response in responses.items():
                note(part, split, form, fitted(response, segments, **options))
                if "integral" not in response.names:  # whose state a row does not know
                    fit = note(f"{part}, a row ahead", split, form, fitted(response, rows, **options))
                    numbers |= {part: values(fit)} if form == CHOSEN[part] else {}
                    if "delay" in response.names:
                        fit = fitted(response, held, **options)
                        note(f"{part}, a row ahead", split, form, fit, "commands of 10 Hz rows")
        noise[split] = process_noise(segments, numbers, **options)
    variants: list[tuple[str, dict[str, Any], float]] = [
        *((f"{other:g} s", {"window": other}, math.inf) for other in OTHER_WINDOWS),
        ("stamps of late messages kept", {"late": True}, math.inf),
        ("slower than 2.5 m/s", {}, 2.5),
    ]
    for variant, more, fastest in variants:
        segments = load(**more)[TOGETHER]
        for form in ("lever alone", "lever, slip", "lever, slip, crab, offset"):
            fit = lateral(segments, LATERAL[form], fastest=fastest, **options)
            note("lateral velocity", TOGETHER, form, fit, variant)
        if fastest == math.inf:
            for part, form in CHOSEN.items():
                note(part, TOGETHER, form, fitted(RESPONSES[part][form], segments, **options), variant)
    odd, even = (load(frames=slice(first, None, 2))[TOGETHER] for first in (0, 1))
    for form in ("lever alone", "lever, slip"):
        fit = lateral_by_instruments(odd, even, LATERAL[form], **options)
        note("lateral velocity", TOGETHER, form, fit, "every other frame, the others as instruments")
    settings = {"window [s]": window, "degree": DEGREE, "block [s]": block, "draws": draws, "seed": seed}
    return {"settings": settings, "fits": fits, "euler": euler, "noise": noise}


def number(value: float | None) -> str:
    """Return a number to three decimals without the zero before the point; a dash for none."""
    if value is None:
        return "–"
    return f"{value:.3f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.3f}"


def spread(entry: Numbers) -> str:
    """Return value ± sd [low, high]."""
    return f"{number(entry['value'])} ± {number(entry['sd'])} [{number(entry['low'])}, {number(entry['high'])}]"


def with_interval(name: str, entry: Numbers) -> str:
    """Return name, value ± sd and 95 % interval with the unit."""
    unit = "" if UNITS[name] == "1" else f" {UNITS[name]}"
    if entry["low"] is None:
        return f"{name} {number(entry['value'])} (not determined)"
    return f"{name} {spread(entry)}{unit}"


def table(rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; the first row is its head."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]])


def markdown(result: Mapping[str, Any]) -> str:
    """Return the tables: fits by part, what the Euler form makes of them, residual accelerations."""
    settings = result["settings"]
    texts = [
        f"Savitzky-Golay filters of degree {settings['degree']} over {settings['window [s]']:g} s; 95 % intervals by "
        f"resampling blocks of {settings['block [s]']:g} s {settings['draws']} times. Delays count from a command's "
        "stamp; each command is held until the next."
    ]
    for part in dict.fromkeys(fit["part"] for fit in result["fits"]):
        rows = [["form", "split", "smoothing", "value ± sd [95 % interval]", "rms", "blocks"]]
        for fit in sorted((fit for fit in result["fits"] if fit["part"] == part), key=lambda fit: fit["form"]):
            found = "; ".join(with_interval(name, entry) for name, entry in fit["parameters"].items())
            rows.append([fit["form"], fit["split"], fit["variant"], found, number(fit["rms"]), str(fit["blocks"])])
        texts += [f"## {part.capitalize()}", table(rows)]
    heads = list(result["euler"][TOGETHER])
    rows = [["split", *heads]] + [[k, *(number(entry[h]) for h in heads)] for k, entry in result["euler"].items()]
    texts += ["## What the Euler form must find, from the continuous lever and slip", table(rows)]
    rows = [
        [
            "channel",
            "split",
            "sd ± its sd [95 % interval]",
            "middle",
            "calm",
            "busy",
            "correlation after .1, .2, .5, 1 s",
        ]
    ]
    for split, noise in result["noise"].items():
        for channel, entry in noise["channels"].items():
            sd = f"{spread(entry['sd'])} {PER_ROW[channel]}"
            parts = [number(entry[name]) for name in ("middle", "calm", "busy")]
            rows.append([channel, split, sd, *parts, ", ".join(number(c) for c in entry["correlation"].values())])
    texts += ["## Residual accelerations, held over rows of .1 s", table(rows)]
    return "\n\n".join(texts) + "\n"


def write(path: Path, text: str) -> None:
    """Write a file as a whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        beside.write_text(text, encoding="utf-8")
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code: 0, or 2 where the logs are missing or cannot be read."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with train/, valid/ and test/")
    parser.add_argument("--json", type=Path, help="file for the numbers")
    parser.add_argument("--markdown", type=Path, help="file for the tables")
    parser.add_argument("--window", type=float, default=WINDOW, help="of the Savitzky-Golay filters, s")
    parser.add_argument("--block", type=float, default=BLOCK, help="of the bootstrap, s")
    parser.add_argument("--draws", type=int, default=1000, help="of the bootstrap")
    parser.add_argument("--seed", type=int, default=0, help="of the bootstrap")
    given = parser.parse_args(arguments)
    for low, high, name in ((0.05, 1.0, "window"), (1.0, 60.0, "block"), (2, 10**6, "draws")):
        if not low <= getattr(given, name) <= high:
            print(f"--{name}: expected {low:g} to {high:g}, got {getattr(given, name):g}", file=sys.stderr)
            return 2
    missing = [name for name in SPLITS if not (given.data / name).is_dir()]
    if missing:
        print(f"skipped: {given.data} holds no folder {missing[0]}/ of AlphaTruck logs", file=sys.stderr)
        return 2
    try:
        result = analyse(given.data, window=given.window, block=given.block, draws=given.draws, seed=given.seed)
    except LogError as error:
        print(f"skipped: {error}", file=sys.stderr)
        return 2
    text = markdown(result)
    if given.json:
        write(given.json, json.dumps(result, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    if given.markdown:
        write(given.markdown, text)
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
