"""`fit`, `discover` and `prove` on what other people measured or described, each beside what is right.

    python benchmarks/others.py --cases FOLDER [--only emps …] [--simulations N] [--results FILE] [--workers 1]

FOLDER has a folder a case, with tables and a program; a case that is absent is left out. Commands are typed as a person
would, each a process of its own with empty caches of machine code. What is right comes from motion capture, a published
model, a known map, an exact likelihood or robust least squares: no search has seen it. Writes `results/others.md` if
all cases go to the usual file. Exits with 1 when something is not as it should be.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

from loop import environment, measured
from loop_steps import ROOT
from resumable import Record, digest, run

RESULT = Path(__file__).parent / "results" / "others.jsonl"
MAX_CPU, MAX_MEMORY = 300.0, 2048.0  # seconds and MiB that MRCLAM's search may take
MRCLAM_MINUTES = 4.5  # after which its search is told to end
MAX_MILLIVOLTS = 5.5  # of Silverbox's free run on the multisine
MAX_SD = 5.0  # kg, of EMPS's mass: less says nothing
OF_MEANS = "first_order_hold"  # true of EMPS's table: it has the mean of a force that changes within 20 ms
PROGRESS = re.compile(r"steady: (?:(?!steady: )[^…])*… [\w ]+ gone by(, about (to end|[\w ]+ left))?\s*")
MASS = """
import sys
from steady_ppl import Fit, for_program, read_table, seeded
from steady_ppl.likelihood.maximize import fit_by_likelihood
from steady_ppl.likelihood.parameter_posterior import ridged_inverse
fit = Fit.load(sys.argv[1])
mass = float(fit.program.mass)
with seeded(0, "paths"):
    found = fit_by_likelihood(fit.program, for_program(fit.program, read_table(sys.argv[2])))
share = float(ridged_inverse(found.information).diagonal()[found.names.index("mass")].sqrt())
print(mass, mass * share)
"""
FREE = """
import sys
from dataclasses import replace
import torch
from steady_ppl import Fit, for_program, read_table, roll_out, seeded
from steady_ppl.gaussian.smoother import find_path, smooth
from steady_ppl.likelihood.scores import measured
from steady_ppl.model.handlers import AtMean
from steady_ppl.model.problem import Problem
from steady_ppl.model.substeps import acting_controls
WINDOW = 50
program = Fit.load(sys.argv[1]).program
data = for_program(program, read_table(sys.argv[2]))
begun = replace(data.with_rows(lambda values: values[: WINDOW + 1]), lengths=data.lengths.clamp(max=WINDOW + 1))
problem = Problem(program, begun)
with seeded(0, "paths"), torch.no_grad():
    start = smooth(problem, find_path(problem)).path(begun).states[-1]
    given = (part[WINDOW:-1].unsqueeze(1) for part in (acting_controls(program, data), data.elapsed))
    run = roll_out(program, start[None, None], *given, data.steps[WINDOW:].unsqueeze(1), handler=AtMean())
    readings = measured(program, torch.cat([state[0] for state in run])).reading
seen = data.observed[WINDOW + 1 :]
print(float((readings - data.measurements[WINDOW + 1 :])[seen].square().mean().sqrt()))
"""
"""How far a fit's measurements are from those of a table without noise and without looking, from the state that the
first 50 rows of each trajectory tell (the window of the published comparisons)."""
SCRIPTS = {"mass": MASS, "free": FREE}
DISCOVER = "{train} --valid {valid} {simulations} --out {out}/after --json {out}/discover.json"


class Asked(NamedTuple):
    """What a case is asked for."""

    what: str
    value: str
    is_met: bool


Said = Mapping[str, Any]  # of each command of a case: its JSON, or its text


@dataclass(frozen=True)
class Case:
    """Commands in the folder of a case by a name, with {train}, {valid}, {simulations} and {out}, and what is right."""

    commands: Mapping[str, str]
    asked: Callable[[Said], Iterator[Asked]]
    tables: str = "{}.csv"
    is_limited: bool = False  # to `MAX_CPU` and `MAX_MEMORY`


def _effects(found: Said) -> list[str]:
    """Those that were found, less corrections of the declared noise."""
    return [one["effect"] for one in found["effects"] if not one.get("correction")]


def _shown(found: Said) -> str:
    """The verdict, and effects with their coefficients and intervals."""
    said = []
    for one in found["effects"]:
        pairs = zip(one["coefficient"], one["interval_90"], strict=True)
        values = ", ".join(f"{value:.4g} [{low:.4g}, {high:.4g}]" for value, (low, high) in pairs)
        said.append(f"{one['effect']} {values}{' (noise)' if one.get('correction') else ''}")
    return f"{found['verdict']}: {'; '.join(said) or 'nothing'}"


def _silverbox(said: Said) -> Iterator[Asked]:
    found, effects = said["discover"], _effects(said["discover"])
    yield Asked("the cubic spring", _shown(found), any(name.startswith("cubic_stiffness") for name in effects))
    kinds = {one["effect"]: one["kind"] for one in found["candidates"]}
    noise = [name for name in effects if kinds.get(name) == "noise"]
    yield Asked("no noise among what was found", ", ".join(noise) or "none", bool(effects) and not noise)
    error = 1000 * float(said["free"].split()[0])
    yield Asked(f"free run of validation pieces ≤ {MAX_MILLIVOLTS} mV", f"{error:.2f} mV", error <= MAX_MILLIVOLTS)


def _emps(said: Said) -> Iterator[Asked]:
    effects = sorted({name.partition(":")[0] for name in _effects(said["discover"])} - {OF_MEANS})
    right = ["acceleration_bias", "coulomb_friction", "linear_drag"]
    asked = "Coulomb and viscous friction and the offset, nothing else but the force's course in a row"
    yield Asked(asked, _shown(said["discover"]), effects == right)
    mass, sd = map(float, said["mass"].split()[:2])
    is_met = abs(mass - 95.1) < 2 * sd and sd < MAX_SD
    yield Asked("mass 95.1 kg within two standard deviations", f"{mass:.2f} ± {sd:.2f}", is_met)


def _victoria_park(said: Said) -> Iterator[Asked]:
    found, proof = said["discover"], said["prove"]
    drives = {(one["drives"], one["trajectory"]) for one in found["outliers"]}
    has_tails = any(one["effect"] == "heavy_tails" for one in found["effects"])
    value = "heavy tails" if has_tails else f"wrong readings in {len(drives)} of 54 drives"
    yield Asked("jumps of the GPS are wrong readings or heavy tails", value, has_tails or len(drives) >= 6)
    effects = _effects(found)
    is_right = [name.startswith("lever_arm") or name.endswith(":steering") for name in effects]
    is_met = found["verdict"] == "other" or (bool(effects) and all(is_right))
    yield Asked("an antenna or steering effect, or none that has a name", _shown(found), is_met)
    before, after = proof["rows"][:2]
    against = after["against_reference"]
    neglected = [row["neglected"] for row in (before, after)]
    more = None if None in neglected else against["log_likelihood"]["difference"] + neglected[1] - neglected[0]
    told = "no particle filter followed" if more is None else f"{more:+.1f} nats a test drive"
    yield Asked("particles say the same", told, more is not None and more > 0)
    errors = [row["measurement"]["m"]["3 s"] for row in (before, after)]
    low, high = against["measurement"]["m"]["3 s"]["interval"]
    told = f"{errors[0]:.2f} → {errors[1]:.2f} m ({low:+.0%}, {high:+.0%})"
    yield Asked("3-s error on test drives falls", told, high < 0)


def _mrclam(said: Said) -> Iterator[Asked]:
    yield Asked("a verdict", _shown(said["discover"]), said["discover"]["verdict"] != "undecided")


def _unicycle(said: Said) -> Iterator[Asked]:
    yield Asked("nothing found", _shown(said["discover"]), said["discover"]["verdict"] == "none")


def _short_drives(said: Said) -> Iterator[Asked]:
    for name, exact, error in (("gain", 1.394, 0.025), ("damping", 0.774, 0.079)):
        (value,) = re.findall(rf"[(, ]{name}=([^,)]+)", said["fit"])
        yield Asked(f"{name} {exact} within one standard error", value, abs(float(value) - exact) < error)


def _says(text: str) -> Callable[[Said], Iterator[Asked]]:
    """That a fit says so."""

    def asked(said: Said) -> Iterator[Asked]:
        yield Asked(f"“{text}”", said["fit"], text in said["fit"])

    return asked


FIT_CART = {"fit": "fit ../cart.py drives.csv --recipe likelihood --out {out}/fit"}
RUN_FREE = "free {out}/after {valid}"
CASES = {
    "exact_unicycle": Case({"discover": f"discover unicycle.py {DISCOVER}"}, _unicycle),
    "victoria_park": Case(
        {
            "fit": "fit car.py {train} --valid {valid} --recipe likelihood --out {out}/before",
            "discover": f"discover {{out}}/before {DISCOVER}",
            "prove": "prove {out}/before {out}/after test.csv --horizon 3 --json {out}/prove.json",
        },
        _victoria_park,
    ),
    "mrclam": Case({"discover": f"discover robot.py {DISCOVER} --minutes {MRCLAM_MINUTES}"}, _mrclam, is_limited=True),
    "silverbox": Case({"discover": f"discover silverbox.py {DISCOVER}", "free": RUN_FREE}, _silverbox),
    "silverbox_rescaled": Case(
        {"discover": f"discover slow.py {DISCOVER}", "free": RUN_FREE}, _silverbox, "slow_{}.csv"
    ),
    "emps": Case({"discover": f"discover emps.py {DISCOVER}", "mass": "mass {out}/after {train}"}, _emps),
    "short_drives": Case({"fit": "fit cart.py drives.csv --recipe likelihood --out {out}/fit"}, _short_drives),
    "product": Case(
        {"fit": "fit product.py drives.csv --recipe likelihood --out {out}/fit"}, _says("product of torque and gain")
    ),
    "stiff": Case({"fit": "fit stiff.py drives.csv --out {out}/fit"}, _says("the model itself diverges at this step")),
    "sentinel": Case(FIT_CART, _says("-9999")),
    "epoch_ns": Case(FIT_CART, _says("nanoseconds")),
    "header_blanks": Case(FIT_CART, _says("Cart(")),
    "units_row": Case(FIT_CART, _says("row of units")),
    "degrees": Case({"fit": f"fit {ROOT}/models/gps_boat.py drives.csv --out {{out}}/fit"}, _says("degrees")),
}


def work(name: str, cases: str, simulations: int | None) -> Record:
    """The record of a case."""
    case, said, cost, asked = CASES[name], dict[str, Any](), dict[str, dict[str, float]](), list[Asked]()
    sets = "" if simulations is None else f"--simulations {simulations}"
    with tempfile.TemporaryDirectory() as out:
        environ = environment(ROOT, Path(out) / "caches") | {"OMP_NUM_THREADS": "1"}
        tables = {one: case.tables.format(one) for one in ("train", "valid")}
        for step, command in case.commands.items():
            words = command.format(simulations=sets, out=out, **tables).split()
            script, rest = SCRIPTS.get(words[0]), words[1:]
            told = ["-c", script, *rest] if script else ["-m", "steady_ppl.cli.main", *words]
            try:
                done = measured(told, Path(cases) / name, environ, whole_output=True)
            except RuntimeError as error:
                said[step] = _without_progress(str(error), out)
                break
            written = Path(out) / f"{step}.json"
            text = _without_progress(f"{done['said']} {done['noted']}", out)
            said[step] = json.loads(written.read_text()) if written.exists() else text
            cost[step] = {of: done[of] for of in ("wall", "cpu", "peak")}
    try:
        for one in case.asked(said):
            asked.append(one)
    except (KeyError, TypeError, ValueError) as error:
        asked.append(Asked("an answer", f"{error!r}; {list(said.values())[-1]}"[:300], False))
    if case.is_limited and "discover" in cost:
        spent, most = cost["discover"]["cpu"], cost["discover"]["peak"]
        is_cheap = spent <= MAX_CPU and most <= MAX_MEMORY
        asked.append(Asked("5 processor minutes, 2 GiB", f"{spent:.0f} s, {most:.0f} MiB", is_cheap))
    found = said.get("discover")
    told = {"sentence": found["sentence"], "effects": found["effects"]} if isinstance(found, dict) else {}
    return {"asked": [one._asdict() for one in asked], "simulations": simulations, "cost": cost, "found": told}


def _without_progress(text: str, out: str) -> str:
    return " ".join(PROGRESS.sub("", text.replace(f"{out}/", "")).split())


def page(records: Sequence[Record], title: str, cases: Iterable[str]) -> str:
    """The table, in the order of cases."""
    order = list(cases)
    lines = [f"# {title}", "", "| case | asked for | found | met | CPU s |", "|---|---|---|---|---|"]
    for record in sorted(records, key=lambda record: order.index(record["set"])):
        spent = f"{sum(step['cpu'] for step in record.get('cost', {}).values()):.0f}"
        for one in record.get("asked") or [Asked("a record", record.get("failed", ""), False)._asdict()]:
            value, met = one["value"].replace("|", "/"), "yes" if one["is_met"] else "**no**"
            lines.append(f"| {record['set']} | {one['what']} | {value} | {met} | {spent} |")
            spent = ""
    return "\n".join(lines) + "\n"


def concluded(records: Sequence[Record], text: str, result: Path | None) -> int:
    """Print a page, keep it beside a file of records, and return 1 where something is not met."""
    print(text)
    if result is not None:
        result.with_suffix(".md").write_text(text)
    return int(not all(one["is_met"] for record in records for one in record.get("asked") or [{"is_met": False}]))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--only", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--simulations", type=int, help="sets for the calibration, in place of the command's own")
    parser.add_argument("--results", type=Path, default=RESULT)
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    folder = given.cases.resolve()
    absent = [name for name in given.only if not (folder / name).is_dir()]
    if absent:
        print(f"left out, for {folder.name} has no folder of theirs: {', '.join(absent)}", file=sys.stderr)
    jobs = {name: (name, str(folder), given.simulations) for name in given.only if name not in absent}
    sources = [file for place in ("steady_ppl", "inference") for file in (ROOT / place).rglob("*.py")]
    version = f"{digest(files=[Path(__file__), *sources])} {given.simulations or 'own'} sets"
    records = run(work, jobs, given.results, version=version, workers=given.workers)
    text = page(records, "Other people's data", CASES)
    return concluded(records, text, RESULT if given.results == RESULT and set(given.only) == set(CASES) else None)


if __name__ == "__main__":
    sys.exit(main())
