"""Gather what a page says: of every run a check, of two or more a proof, and what `discover` found."""

from collections.abc import Mapping, Sequence
from typing import Any

from steady_ppl.comparison.prove import prove, unconverged
from steady_ppl.comparison.result import Proof
from steady_ppl.criticism.check import check
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import SteadyError, UsageError
from steady_ppl.reporting.drives import chosen_drives, common_data, data_of_run
from steady_ppl.reporting.html import Report
from steady_ppl.runs.fit import Fit
from steady_ppl.utils.cores import one_thread
from steady_ppl.utils.progress import stages


@one_thread()
def report(
    runs: Mapping[str, Fit],
    data: Trajectories,
    *,
    discovery: Mapping[str, Any] | None = None,
    title: str = "steady report",
    how: Sequence[str] = (),
    notes: Sequence[str] = (),
    simulations: int = 100,
    draws: int = 50,
    seed: int = 0,
) -> Report:
    """Say on one page what fitted programs explain of some drives, where they fail and what they lack.

    Args:
        runs: label → fit, the one before first.
        data: drives, best those that no run has used. Their true states, where the table has them, are drawn and used
            for nothing else.
        discovery: `discover(…).figures`; the page says how to come by them when not given.
        title: of the page.
        how: commands that lead here.
        notes: shown above everything else.
        simulations: sets of drives simulated for the bands of each run's `check`.
        draws: of the posterior of each run's states.
        seed: of simulations, draws and resampling.

    Raises:
        UsageError: no run, or a program that cannot be linearised.
        DataError: nothing to compare, or no known start.
        FilterError: a linearised program broke down.

    Example:
        >>> import steady_ppl as st  # doctest: +SKIP
        >>> runs = {name: st.Fit.load(f"runs/{name}") for name in ("before", "after")}  # doctest: +SKIP
        >>> st.report(runs, st.read_table("test.csv")).write("report.html")  # doctest: +SKIP
    """
    if not runs:
        raise UsageError("a report needs at least one run")
    plan = [(f"checking {label}", 4) for label in runs] + [(f"drawing {label}", 1) for label in runs]
    with stages(*plan, ("comparing", len(runs))) as begin:
        checks = {}
        for label, fit in runs.items():
            begin()
            checks[label] = check(fit, data, simulations=simulations, seed=seed)
        shown = chosen_drives(list(checks.values()))
        drawn = []
        for label, fit in runs.items():
            begin()
            drawn.append({"label": label, **data_of_run(checks[label], fit, data, shown, draws=draws, seed=seed)})
        begin()
        proof: Proof | str = "There is one run only: name the run before and the one after to compare them."
        if len(runs) > 1:
            try:
                proof = prove(runs, data, paths={label: one.path for label, one in checks.items()}, seed=seed)
            except SteadyError as error:
                proof = f"The runs cannot be compared: {error}."
    return Report(
        title=title,
        fits=dict(runs),
        checks=checks,
        proof=proof,
        discovery=discovery,
        shown=shown,
        drives=common_data(next(iter(checks.values())), shown) | {"runs": drawn},
        how=list(how),
        notes=[*notes, *unconverged(runs)],
    )
