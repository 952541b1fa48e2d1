"""`discover`, `prove` and `fit` on what other people measured or described, each beside what is right.

    python benchmarks/others.py --cases FOLDER [--only emps …] [--simulations 100] [--results [FILE]] [--workers 1]

FOLDER has a folder a case, with tables and a program; a case that is absent is left out. Commands are typed as a person
would, each a process of its own, whose processor seconds and peak memory count. What is right comes from motion
capture, a published model, a known map, an exact likelihood or a robust least-squares fit: no search has seen it.
Writes `results/others.md` where `--results` names no file, and exits with 1 when something is not as it should be.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

from loop import environment, measured
from loop_steps import ROOT
from resumable import Record, digest, run

RESULT = Path(__file__).parent / "results" / "others.jsonl"
MAX_CPU, MAX_MEMORY = 300.0, 2048.0  # seconds and MiB of a search
ANTENNA = ("lever_arm", "antenna_offset", "steering", "actuator_delay", "actuator_lag", "gain_error", "curve")
MASS = """
import sys
from steady_ppl import Fit, for_program, read_table
from steady_ppl.likelihood.maximize import fit_by_likelihood
from steady_ppl.likelihood.parameter_posterior import ridged_inverse
fit = Fit.load(sys.argv[1])
found = fit_by_likelihood(fit.program, for_program(fit.program, read_table(sys.argv[2])))
share = float(ridged_inverse(found.information).diagonal()[found.names.index("mass")].sqrt())
print(float(fit.program.mass), float(fit.program.mass) * share)
"""
PROGRESS = re.compile(r"steady: [^…]*… [\w ]+ gone by(, about [\w ]+ (left|to end))?\s*")
DISCOVER = "{train} --valid {valid} --simulations {simulations} --out {out}/after --json {out}/discover.json"


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


def _effects(found: Said) -> list[str]:
    """Those that were found, less corrections of the declared noise."""
    return [one["effect"] for one in found["effects"] if not one.get("correction")]


def _interval(found: Said, name: str) -> str:
    """An effect's coefficients with their intervals."""
    (one,) = [one for one in found["effects"] if one["effect"].partition(":")[0] == name]
    pairs = zip(one["coefficient"], one["interval_90"], strict=True)
    return ", ".join(f"{value:.4g} [{low:.4g}, {high:.4g}]" for value, (low, high) in pairs)


def _silverbox(said: Said) -> Iterator[Asked]:
    effects = _effects(said["discover"])
    spring = "cubic_stiffness" in [name.partition(":")[0] for name in effects]
    yield Asked("the cubic spring", _interval(said["discover"], "cubic_stiffness") if spring else "–", spring)
    noise = [name for name in effects if "noise" in name or "tails" in name]
    yield Asked("nothing of noise among what was found", ", ".join(effects), not noise)


def _emps(said: Said) -> Iterator[Asked]:
    effects = sorted(name.partition(":")[0] for name in _effects(said["discover"]))
    right = ["acceleration_bias", "coulomb_friction", "linear_drag"]
    yield Asked("Coulomb and viscous friction and the offset, nothing else", ", ".join(effects), effects == right)
    mass, sd = map(float, said["mass"].split())
    yield Asked("mass 95.1 kg within two standard deviations", f"{mass:.2f} ± {sd:.2f}", abs(mass - 95.1) < 2 * sd)


def _victoria_park(said: Said) -> Iterator[Asked]:
    found, proof = said["discover"], said["prove"]
    wrong, has_tails = len(found["outliers"]), any(one["effect"] == "heavy_tails" for one in found["effects"])
    value = "heavy tails" if has_tails else f"{wrong} wrong readings"
    yield Asked("jumps of the GPS are wrong readings or heavy tails", value, has_tails or wrong > 0)
    effects = _effects(found)
    is_right = found["verdict"] == "other" or any(name.startswith(ANTENNA) for name in effects)
    yield Asked("an antenna or steering effect, or none of the catalogue", ", ".join(effects) or "none", is_right)
    before, after = (row["measurement"]["m"]["3 s"] for row in proof["rows"][:2])
    yield Asked("3-s error on test drives falls", f"{before:.2f} → {after:.2f} m", after < before)


def _mrclam(said: Said) -> Iterator[Asked]:
    yield Asked("a verdict", said["discover"]["sentence"], bool(said["discover"]["sentence"]))


def _unicycle(said: Said) -> Iterator[Asked]:
    yield Asked("nothing found", said["discover"]["sentence"], not _effects(said["discover"]))


def _short_drives(said: Said) -> Iterator[Asked]:
    for name, exact, error in (("gain", 1.394, 0.025), ("damping", 0.774, 0.079)):
        (value,) = re.findall(rf"[(, ]{name}=([^,)]+)", said["fit"])
        yield Asked(f"{name} {exact} within one standard error", value, abs(float(value) - exact) < error)


def _product(said: Said) -> Iterator[Asked]:
    yield Asked("only the product of torque and gain", said["fit"], "product of torque and gain" in said["fit"])


def _stiff(said: Said) -> Iterator[Asked]:
    says = "the model itself diverges at this step"
    yield Asked(f"“{says}”", said["fit"], says in said["fit"])


CASES = {
    "exact_unicycle": Case({"discover": f"discover unicycle.py {DISCOVER}"}, _unicycle),
    "victoria_park": Case(
        {
            "fit": "fit car.py {train} --valid {valid} --recipe likelihood --out {out}/before",
            "discover": f"discover {{out}}/before {DISCOVER}",
            "prove": "prove {out}/before {out}/after test.csv --json {out}/prove.json",
        },
        _victoria_park,
    ),
    "mrclam": Case({"discover": f"discover robot.py {DISCOVER}"}, _mrclam),
    "silverbox": Case({"discover": f"discover silverbox.py {DISCOVER}"}, _silverbox),
    "silverbox_rescaled": Case({"discover": f"discover slow.py {DISCOVER}"}, _silverbox, "slow_{}.csv"),
    "emps": Case({"discover": f"discover emps.py {DISCOVER}", "mass": "python {out}/after {train}"}, _emps),
    "short_drives": Case({"fit": "fit cart.py drives.csv --recipe likelihood --out {out}/fit"}, _short_drives),
    "product": Case({"fit": "fit product.py drives.csv --recipe likelihood --out {out}/fit"}, _product),
    "stiff": Case({"fit": "fit stiff.py drives.csv --out {out}/fit"}, _stiff),
}


def work(name: str, cases: str, simulations: int) -> Record:
    """The record of a case."""
    case, said, cost = CASES[name], dict[str, Any](), dict[str, dict[str, float]]()
    with tempfile.TemporaryDirectory() as out:
        environ = environment(ROOT, Path(out) / "caches") | {"OMP_NUM_THREADS": "1"}
        tables = {one: case.tables.format(one) for one in ("train", "valid")}
        for step, command in case.commands.items():
            words = command.format(simulations=simulations, out=out, **tables).split()
            told = ["-c", MASS, *words[1:]] if words[0] == "python" else ["-m", "steady_ppl.cli.main", *words]
            try:
                done = measured(told, Path(cases) / name, environ, says=10_000)
            except RuntimeError as error:
                said[step] = PROGRESS.sub("", str(error))
                break
            written = Path(out) / f"{step}.json"
            said[step] = json.loads(written.read_text()) if written.exists() else PROGRESS.sub("", done["said"])
            cost[step] = {of: done[of] for of in ("wall", "cpu", "peak")}
    try:
        asked = [one._asdict() for one in case.asked(said)]
    except (KeyError, TypeError, ValueError) as error:
        asked = [Asked("an answer", f"{error!r}; {list(said.values())[-1]}"[:300], False)._asdict()]
    if "discover" in cost:
        spent, most = cost["discover"]["cpu"], cost["discover"]["peak"]
        is_cheap = spent <= MAX_CPU and most <= MAX_MEMORY
        asked.append(Asked("5 processor minutes, 2 GiB", f"{spent:.0f} s, {most:.0f} MiB", is_cheap)._asdict())
    found = said.get("discover")
    told = {"sentence": found["sentence"], "effects": found["effects"]} if isinstance(found, dict) else {}
    return {"case": name, "simulations": simulations, "asked": asked, "cost": cost, "found": told}


def page(records: Sequence[Record]) -> str:
    """The table."""
    lines = ["# Other people's data", "", "| case | asked for | found | met |", "|---|---|---|---|"]
    for record in sorted(records, key=lambda record: list(CASES).index(record["set"])):
        failed = [Asked("a record", record.get("failed", ""), False)._asdict()]
        for one in record.get("asked", failed):
            value = one["value"].replace("|", "/")
            lines.append(f"| {record['set']} | {one['what']} | {value} | {'yes' if one['is_met'] else '**no**'} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--only", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--simulations", type=int, default=100)
    parser.add_argument("--results", type=Path, nargs="?", const=RESULT, default=RESULT)
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    folder = given.cases.resolve()
    absent = [name for name in given.only if not (folder / name).is_dir()]
    if absent:
        print(f"left out, for {folder.name} has no folder of theirs: {', '.join(absent)}", file=sys.stderr)
    jobs = {name: (name, str(folder), given.simulations) for name in given.only if name not in absent}
    version = digest(files=[Path(__file__), *(ROOT / "steady_ppl").rglob("*.py")])
    records = run(work, jobs, given.results, version=version, workers=given.workers)
    print(page(records))
    if given.results == RESULT:
        RESULT.with_suffix(".md").write_text(page(records))
    return int(not all(one["is_met"] for record in records for one in record.get("asked", [{"is_met": False}])))


if __name__ == "__main__":
    sys.exit(main())
