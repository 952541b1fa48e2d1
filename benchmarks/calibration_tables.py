"""The tables of the calibration suite, and what of it must hold."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import calibration_parameters
import numpy as np
from discovery_scores import covered, interval, uniformity
from scipy import stats
from uniformity import near

Record = dict[str, Any]
CHANCE = 0.01  # a must that holds is missed so often
CERTAIN = 1e-3  # p-value below which what must fail has failed
STANDARD_ERRORS = 4.0
FEW = 5  # p-values of which a test of uniformity can say nothing
NEAR = 0.1  # posterior standard deviations; where an engine scatters much, 4 standard errors are no bound
EXACT = ("lookahead 1000", "gaussian")  # guides whose ranks must be uniform, the second where its posterior is exact
NORMAL = ("cart", "hovercraft")  # programs whose posterior is normal, or nearly


class Musts:
    """Which of them hold."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.missed = 0

    def add(self, what: str, found: str, holds: bool, *, able: bool = True) -> None:
        """One more; `able` is whether so few could have missed it."""
        said = ("yes" if able else "too few to tell") if holds else "**no**"
        self.lines.append(f"| {what} | {found} | {said} |")
        self.missed += not holds


def tables(records: Sequence[Record]) -> tuple[str, int]:
    """All tables, and how many musts are missed."""
    kinds: dict[str, list[Record]] = {}
    for record in records:
        kinds.setdefault(record.get("kind", "failed"), []).append(record)
    musts = Musts()
    musts.add(
        "every job ran", f"{len(records) - len(kinds.get('failed', []))} of {len(records)}", "failed" not in kinds
    )
    parts = [
        _states(kinds["states"], musts),
        _nuts(kinds["nuts"], musts),
        _evidence(kinds["evidence"], musts),
        _parameters(kinds["parameters"], musts),
        _discovery(kinds["discovery"], musts),
        _check(kinds["check"], musts),
    ]
    head = "\n".join(["| must | found | holds |", "|---|---|---|", *musts.lines])
    return "\n\n".join([head, *parts]) + "\n", musts.missed


def _states(records: Sequence[Record], musts: Musts) -> str:
    lines = [
        f"**Smoothed states**, ranks of the true states among 99 draws, {len(records[0]['inside_90'])} drives each.",
        "",
        "| program | guide | p of uniform ranks | in 50 % intervals | in 90 % intervals |",
        "|---|---|---|---|---|",
    ]
    for record in records:
        problem, guide, _ = record["of"]
        half, most = (near(np.array(record[key]), share) for key, share in (("inside_50", 0.5), ("inside_90", 0.9)))
        lines.append(f"| {problem} | {guide} | {record['p_value']:.2g} | {half[0]} | {most[0]} |")
        if guide == "bootstrap 200":
            p = record["p_value"]
            musts.add(f"states of the {problem}: bootstrap 200 fails", f"p = {p:.1g}", p < CERTAIN)
        elif guide == EXACT[0] or (guide == EXACT[1] and problem in NORMAL):
            musts.add(
                f"states of the {problem}: {guide} is uniform, 90 % intervals hold 90 %",
                f"p = {record['p_value']:.2g}, {most[0]}",
                record["p_value"] >= CHANCE and most[1],
            )
    return "\n".join(lines)


def _nuts(records: Sequence[Record], musts: Musts) -> str:
    lines = [
        "**Beside NUTS**, the worst of all states' means and standard deviations: in standard errors of 40 runs and of "
        "NUTS, and the mean's error in posterior standard deviations.",
        "",
        "| program | guide | standard errors | standard deviations |",
        "|---|---|---|---|",
    ]
    for record in records:
        problem, guide = record["of"]
        lines.append(f"| {problem} | {guide} | {record['standard_errors']:.2f} | {record['sds']:.3f} |")
        if guide in ("bootstrap 4000", "lookahead 1000") or (guide == "gaussian" and problem in NORMAL):
            found, off = record["standard_errors"], record["sds"]
            musts.add(
                f"moments of the {problem}: {guide} meets NUTS",
                f"{found:.2f} SE, {off:.3f} sd",
                found < STANDARD_ERRORS and off < NEAR,
            )
    return "\n".join(lines)


def _evidence(records: Sequence[Record], musts: Musts) -> str:
    lines = [
        f"**p(y)**, the mean of {records[0]['of'][-1]} runs (SVI: of twenty times as many draws) over the exact value "
        "(of the cart) or the finest filter's; beside it how far log p(y) of the linearised program is off, which the "
        "Gaussian guide goes by.",
        "",
        "| program | filter | mean ratio | standard errors | sd of log p(y), nats | linearised, nats |",
        "|---|---|---|---|---|---|",
    ]
    for record in records:
        problem, which, _ = record["of"]
        lines.append(
            f"| {problem} | {which} | {record['ratio']:.4f} ± {record['error']:.4f} | "
            f"{record['standard_errors']:+.2f} | {record['sd_nats']:.3f} | {record['linearised_off_nats']:+.4f} |"
        )
    worst = max(abs(record["standard_errors"]) for record in records)
    musts.add("p(y): every estimate is unbiased", f"at most {worst:.2f} SE of {len(records)}", worst < STANDARD_ERRORS)
    return "\n".join(lines)


def _parameters(records: Sequence[Record], musts: Musts) -> str:
    names = records[0]["names"]
    lines = [
        f"**Learned parameters**, ranks of the true ones among 99 draws, {len(records)} data sets of "
        f"{calibration_parameters.DRIVES} drives.",
        "",
        f"| likelihood | p of uniform ranks | {' | '.join(names)} | in 50 % intervals | in 90 % intervals | reliable |",
        "|---" * (len(names) + 5) + "|",
    ]
    blind = f"bootstrap {calibration_parameters.BLIND}"
    for which in ("linearised", blind):
        found = calibration_parameters.summary(list(records), which)
        half, most = (near(found[key].mean(1), share) for key, share in (("inside_50", 0.5), ("inside_90", 0.9)))
        each = " | ".join(f"{p:.2g}" for p in found["p_values"].values())
        reliable = f"{found['reliable']} of {len(records)}"
        lines.append(f"| {which} | {found['p_value']:.2g} | {each} | {half[0]} | {most[0]} | {reliable} |")
        if which == blind:
            p = found["p_value"]
            musts.add(f"parameters: weighed by {blind} they fail", f"p = {p:.1g}", p < CERTAIN)
        else:
            musts.add(
                "parameters: uniform, 50 % intervals hold 50 % and 90 % intervals 90 %",
                f"p = {found['p_value']:.2g}, {half[0]}, {most[0]}",
                found["p_value"] >= CHANCE and half[1] and most[1],
            )
    return "\n".join(lines)


def _discovery(records: Sequence[Record], musts: Musts) -> str:
    clean, single = ([one for one in records if one["of"][0] == stratum] for stratum in ("clean", "single"))
    p = stats.kstest([record["p_value"] for record in clean], "uniform").pvalue
    accused = sum(record["verdict"] != "none" for record in clean)
    holds = covered(single)
    alarms, hits = interval(accused, len(clean)), interval(sum(holds), len(holds))
    uniform = "discover: p-values of clean sets are uniform"
    musts.add(uniform, uniformity(clean), p >= CHANCE, able=len(clean) >= FEW)
    may, able = _may_be(accused, len(clean), 0.05)
    musts.add("discover: 5 % of clean sets are accused", alarms, may, able=able)
    may, able = _may_be(sum(holds), len(holds), 0.9)
    musts.add("discover: 90 % intervals hold the coefficient", hits, bool(holds) and may, able=able)
    return "\n".join(
        [
            "**Discovery**, sets that the discovery benchmark has not seen.",
            "",
            "| | figure |",
            "|---|---|",
            f"| p-values of clean sets: distance from uniform (Kolmogorov–Smirnov), its p | {uniformity(clean)} |",
            f"| clean sets that are accused | {alarms} |",
            f"| planted effects that are named, of {len(single)} | {sum(bool(covered([one])) for one in single)} |",
            f"| 90 % intervals that hold the coefficient | {hits} |",
        ]
    )


def _check(records: Sequence[Record], musts: Musts) -> str:
    lines = [
        "**Check** of drives that the program itself made, 100 simulated sets each, nominal 5 %.",
        "",
        "| drives | accused | with a finding in the maps |",
        "|---|---|---|",
    ]
    for kind in dict.fromkeys(record["of"][0] for record in records):
        some = [record for record in records if record["of"][0] == kind]
        accused = sum(record["who"] != "nothing found" for record in some)
        said = interval(accused, len(some))
        lines.append(f"| {kind} | {said} | {interval(sum(record['findings'] > 0 for record in some), len(some))} |")
        may, able = _may_be(accused, len(some), 0.05, alternative="greater")
        musts.add(f"check: of {kind} at most 5 % are accused", said, may, able=able)
    return "\n".join(lines)


def _may_be(hits: int, of: int, share: float, alternative: str = "two-sided") -> tuple[bool, bool]:
    """Whether so many are likely enough, and whether any number of them would not be."""
    if not of:
        return True, False
    likely = [stats.binomtest(count, of, share, alternative=alternative).pvalue >= CHANCE for count in range(of + 1)]
    return likely[hits], not all(likely)
