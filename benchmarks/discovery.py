"""How often `discover` is right: the development benchmark, and its rivals on the same tables.

    python benchmarks/discovery.py [--quick] [--rivals] [--results FILE] [--workers 2] [--scores]

Every set is one line of the results file; sets that are there already are left out, so that it can be interrupted and
gone on with. The table of scores is printed at the end and written beside the results (`.md`); `--scores` does only
that, with the records that are there.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import torch
from discovery_scores import rivals_table, scores_table
from discovery_sets import BenchmarkSet, benchmark_sets, owner, quick, tables
from resumable import digest, plain, run, stored

import steady_ppl
from steady_ppl import for_program
from steady_ppl.comparison.prove import prove
from steady_ppl.discovery.discover import discover
from steady_ppl.discovery.refits import Refit, refit_with
from steady_ppl.discovery.result import Discovery, ranked
from steady_ppl.effects import attached, chosen_variant, parsed

RESULTS = Path(__file__).parent / "results" / "discovery.jsonl"
RIVAL_SETS, BRUTE_SETS = 140, 40


def judged(chosen: BenchmarkSet) -> dict[str, Any]:
    """A set's record."""
    torch.set_num_threads(1)
    train, valid, test = tables(chosen)
    began = time.perf_counter()
    found = discover(owner(chosen.known), train, valid, known_start=True, withheld=chosen.withheld, seed=chosen.seed)
    seconds = time.perf_counter() - began
    figures = found.figures
    record = {
        "stratum": chosen.stratum,
        "effects": list(chosen.effects),
        "withheld": list(chosen.withheld),
        "seed": chosen.seed,
        "seconds": round(seconds, 1),
        "verdict": figures["verdict"],
        "p_value": figures["p_value"],
        "class": figures["class"],
        "confidence": figures["confidence"],
        "ranking": [t.variant.name for t in ranked(found) if not (t.is_curve or t.departure)][:5],
        "found": [
            {
                key: one[key]
                for key in ("effect", "kind", "class", "coefficient", "interval_90", "heldout_gain", "options")
            }
            for one in figures["effects"]
        ],
        "gain": found.search.gain,
        "shape": found.search.curve.variant.at if found.search.curve else None,
        "curve_gain": max((c.total for c in found.search.curves if isinstance(c.refit, Refit)), default=None),
        "rounds": [one["p_value"] for one in figures["rounds"]],
        "converged": found.search.base.converged,
    }
    if chosen.stratum != "clean":
        record |= _improvement(chosen, found, test)
    return plain(record)


def _improvement(chosen: BenchmarkSet, found: Discovery, test: Any) -> dict[str, Any]:
    """3-s open-loop errors on the locked drives, before, after and of the true structure fitted alike."""
    oracle: Refit | str = found.search.base
    for text in chosen.effects:
        name, at, options, value = parsed(text)
        if isinstance(oracle, Refit):
            variant = chosen_variant(found.search.base.program, name, at, **options)
            if variant.name not in [known.name for known in attached(oracle.program)]:  # noise that came first
                oracle = refit_with(oracle, variant, value)
    rows: dict[str, Any] = {"before": found.before.program, "after": found.after.program}
    if found.shape is not None and found.search.curve and isinstance(found.search.curve.refit, Refit):
        rows["after"] = found.search.curve.refit.mean_program()
    rows["oracle"] = found.before.program if isinstance(oracle, str) else oracle.mean_program()
    proof = prove(rows, for_program(owner(), test), known_start=True, with_constant_velocity=False, horizons=(1.0, 3.0))
    errors = {}
    for row in proof.figures["rows"]:
        (measured,) = row["measurement"].values()
        errors[row["row"]] = {
            "open_loop_3s": measured.get("3 s"),
            "location_3s": row["state"].get("location", {}).get("3 s"),
            "log_likelihood": row["log_likelihood"],
        }
    gain = None if isinstance(oracle, str) else float((oracle.held_out - found.search.base.held_out).sum())
    return {"errors": errors, "oracle_gain": gain}


def rivals_of(chosen: BenchmarkSet, brute: bool) -> dict[str, Any]:
    """The rankings of all rivals on a set."""
    from discovery_rivals import RIVALS, fitted

    torch.set_num_threads(1)
    made, program = tables(chosen), owner(chosen.known)
    base = fitted(made, program, True)
    found = {}
    for name, rival in RIVALS.items():
        if name != "brute force" or brute:
            for called, ranking in rival(made, program, known_start=True, withheld=chosen.withheld, base=base).items():
                found[called] = {
                    "first": list(ranking.effects[:3]),
                    "detected": ranking.detected,
                    "seconds": round(ranking.seconds, 1),
                }
    return plain({"stratum": chosen.stratum, "effects": list(chosen.effects), "rivals": found})


ENGINE = digest(Path(steady_ppl.__file__).parent)


def run_sets(work: Any, chosen: list[tuple[Any, ...]], file: Path, workers: int) -> list[dict[str, Any]]:
    """Records of all sets, each the first of its arguments, in the order in which they were made."""
    jobs = {arguments[0].name: arguments for arguments in chosen}
    return run(work, jobs, file, version=ENGINE, workers=workers)


def main() -> None:
    """Run what is left and print the scores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a few sets of every kind, in about five minutes")
    parser.add_argument("--rivals", action="store_true", help="the rivals as well")
    parser.add_argument("--results", type=Path, help="benchmarks/results/discovery.jsonl, with --quick …-quick.jsonl")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--scores", action="store_true", help="run nothing")
    options = parser.parse_args()
    sets = quick() if options.quick else benchmark_sets()
    results = options.results or (RESULTS.with_stem(RESULTS.stem + "-quick") if options.quick else RESULTS)

    def made(work: Any, chosen: list[tuple[Any, ...]], file: Path) -> list[dict[str, Any]]:
        return [*stored(file).values()] if options.scores else run_sets(work, chosen, file, options.workers)

    records = made(judged, [(one,) for one in sets], results)
    results.with_suffix(".md").write_text(scores_table(records))
    print(scores_table(records))
    if options.rivals:
        named = [one for one in sets if one.stratum in ("single", "clean")]
        chosen = named[:: max(1, len(named) // RIVAL_SETS)][:RIVAL_SETS]
        every = max(1, len(chosen) // BRUTE_SETS)
        judging = [(one, index % every == 0) for index, one in enumerate(chosen)]
        beside = results.with_stem(results.stem + "-rivals")
        text = rivals_table(records, made(rivals_of, judging, beside))
        beside.with_suffix(".md").write_text(text)
        print(text)


if __name__ == "__main__":
    main()
