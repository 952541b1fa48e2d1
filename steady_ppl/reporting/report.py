"""One page of HTML about runs: the table, a check of each, a proof of two or more, and what `discover` found."""

import html
import inspect
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from latex2mathml.converter import convert
from markupsafe import Markup, escape
from plotly.offline import get_plotlyjs

from steady_ppl.comparison.prove import prove, unconverged
from steady_ppl.comparison.result import Proof
from steady_ppl.criticism.check import check
from steady_ppl.criticism.result import Check, strongest
from steady_ppl.data.doctor import Examination
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects import Effect, attached, written_class
from steady_ppl.errors import SteadyError, UsageError
from steady_ppl.model.program import for_program, parameter_rows
from steady_ppl.reporting.drives import Shown, chosen_drives, common_data, data_of_run, where_to_look
from steady_ppl.runs.diagnostics import doctor
from steady_ppl.runs.fit import Fit, versions
from steady_ppl.utils.cores import one_thread
from steady_ppl.utils.files import finite_json, whole_file
from steady_ppl.utils.progress import stages

SCRIPTS = ("page.js", "curves.js", "maps.js", "choosing.js")


@dataclass(frozen=True)
class Report:
    """A page and what it is made of.

    Attributes:
        title: of the page.
        table: what is suspicious in the table.
        fits, checks: by the runs' labels.
        proof: of the runs against the first one, or why there is none.
        discovery: the figures of `discover`, if there are any.
        shown: the trajectories that the page has row by row.
        drives: what is shown of them, and of each run's predictions and states.
        how: lines that say how to repeat it.
        notes: what a reader must know before believing it.
    """

    title: str
    table: Examination
    fits: Mapping[str, Fit]
    checks: Mapping[str, Check]
    proof: Proof | str
    discovery: Mapping[str, Any] | None
    shown: Shown
    drives: Mapping[str, Any]
    how: Sequence[str]
    notes: Sequence[str] = field(default_factory=list)

    @property
    def html(self) -> str:
        """The page, whole: style, scripts and data are in it; whatever comes from a table or a program is escaped."""
        templates = Environment(
            loader=PackageLoader("steady_ppl.reporting", "."),
            autoescape=True,
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        templates.filters |= {"number": rounded, "signed": signed, "interval": interval, "spread": spread, "said": said}
        figures = {label: one.figures for label, one in self.checks.items()}
        curves = {} if isinstance(self.proof, str) else _curves(self.proof)
        drawn = ("candidates", "effects", "shape")  # the rest of a discovery is in the text
        discovery = {name: self.discovery[name] for name in drawn} if self.discovery else None
        content = {
            "title": self.title,
            "table": self.table,
            "notes": self.notes,
            "checks": figures,
            "strongest": {label: _linked(one["findings"], self, label) for label, one in figures.items()},
            "proof": self.proof if isinstance(self.proof, str) else self.proof.figures,
            "discovery": self.discovery,
            "programs": [_program(label, fit) for label, fit in self.fits.items()],
            "shown": self.shown.note,
            "how": self.how,
            "versions": versions(),
            "style": _asset("page.css"),
            "script": Markup("\n").join(_asset(name) for name in SCRIPTS),
            "plotly": Markup(get_plotlyjs().replace("</script", "<\\/script")),
            "data": _data({**self.drives, "discovery": discovery, "curves": curves}),
        }
        return templates.get_template("page.html").render(content)

    def write(self, path: str | Path) -> None:
        """Write the page whole or not at all.

        Raises:
            UsageError: the file cannot be written.
        """
        with whole_file(Path(path)) as beside:
            beside.write_bytes(self.html.encode(errors="backslashreplace"))  # a file's name need not be UTF-8

    def _repr_html_(self) -> str:
        title, page = html.escape(self.title), html.escape(self.html)
        return f'<iframe title="{title}" srcdoc="{page}" style="width:100%;height:40em;border:0"></iframe>'


def _linked(findings: list[dict[str, Any]], found: Report, label: str) -> list[dict[str, Any]]:
    """The strongest findings of a run, each with the address of its place on the page."""
    check, run = found.checks[label], list(found.checks).index(label)
    places = [where_to_look(check, one.cell) for one in check.misfit.significant]
    rows = []
    for finding in strongest([{**one, "place": place} for one, place in zip(findings, places, strict=True)]):
        link = drive = None
        if finding["place"] is not None:
            number, start, end = finding["place"]
            drive = check.data.labels[number]
            if number in found.shown.drives:
                link = f"#run={run}&drive={found.shown.drives.index(number)}&from={start:.2f}&to={end:.2f}"
        rows.append({**finding, "link": link, "drive": drive})
    return rows


def _curves(proof: Proof) -> dict[str, Any]:
    """Root mean square error against the seconds ahead: of → row → pairs."""
    curves: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for name in proof.rows:
        for (kind, of), curve in proof.open_loop(name).items():
            curves.setdefault(f"measured [{of}]" if kind == "measurement" else of, {})[name] = curve
    return curves


def _asset(name: str) -> Markup:
    return Markup((files("steady_ppl.reporting") / name).read_text(encoding="utf-8"))


def _data(content: Mapping[str, Any]) -> Markup:
    """JSON that cannot end the element that holds it; ComputationError where a figure is not finite."""
    text = finite_json(content, "the page", separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def rounded(value: Any, digits: int = 3) -> str:
    """A figure with so many digits, a list of them, or a dash."""
    if isinstance(value, list | tuple):
        return ", ".join(rounded(one, digits) for one in value)
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}g}".replace("-", "−")


def signed(value: float | None) -> str:
    """A difference with its sign, or nothing."""
    return "" if value is None else f"{value:+.1f}".replace("-", "−")


def spread(candidate: Mapping[str, Any]) -> str:
    """Coefficients with their standard deviations, component by component."""
    values, sds = (one if isinstance(one, list) else [one] for one in (candidate["coefficient"], candidate["sd"]))
    pairs = zip(values, sds if len(sds) == len(values) else [None] * len(values), strict=True)
    return ", ".join(rounded(value) + (f" ± {rounded(sd, 2)}" if sd is not None else "") for value, sd in pairs)


def said(sentence: str) -> Markup:
    """A sentence of a verdict: commands in it as code, signs as minus, no line broken before a per cent sign."""
    parts = enumerate(re.sub(r"(?<![\w.])-(?=[\d.])", "−", sentence).replace(" %", "\u00a0%").split("`"))
    return Markup("").join(Markup("<code>{}</code>").format(part) if i % 2 else escape(part) for i, part in parts)


def interval(pair: Any) -> str:
    """Both ends, or nothing."""
    return "" if pair is None else f"[{rounded(pair)}]"


def _program(label: str, fit: Fit) -> dict[str, Any]:
    """Name, equations of its effects as MathML, values of its parameters, its class as it is written."""
    kind = written_class(fit.program)
    try:
        text = inspect.getsource(kind)
    except (TypeError, OSError):
        text = ""
    return {
        "label": label,
        "name": kind.__name__,
        "about": inspect.cleandoc(kind.__doc__ or ""),
        "effects": [(one.label, _equation(one.effect), one.effect.feels) for one in attached(fit.program)],
        "parameters": parameter_rows(fit.program),
        "text": text,
        "fit": fit,
    }


def _equation(effect: Effect) -> Markup:
    """As MathML; in words where somebody's own LaTeX is none."""
    try:
        return Markup(convert(effect.equation))
    except Exception:  # the converter raises many kinds
        return escape(effect.text)


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
    horizons: Sequence[float] = (),
    seed: int = 0,
) -> Report:
    """Say on one page what fitted programs explain of some trajectories, where they fail and what they lack.

    Args:
        runs: label → fit, the one before first.
        data: trajectories, best those that no run has used. Their true states, where the table has them, are drawn and
            used for nothing else.
        discovery: `discover(…).figures`; the page says how to come by them when not given.
        title: of the page.
        how: commands that lead here.
        notes: shown above everything else.
        simulations: sets of trajectories simulated for the bands of each run's `check`.
        draws: of the posterior of each run's states.
        horizons: seconds ahead; those that suit the trajectories where none is given, see `data.horizons`.
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
    table = doctor(data, next(iter(runs.values())).program)
    plan = [(f"checking {label}", 4) for label in runs] + [(f"drawing {label}", 1) for label in runs]
    with stages(*plan, ("comparing", len(runs))) as begin:
        checks, table_of_all = {}, data
        for label, fit in runs.items():
            begin()
            known = fit.information
            seen = known is not None and known.has_seen(for_program(fit.program, table_of_all))
            checks[label] = check(fit, data, simulations=simulations, horizons=horizons, has_seen=seen, seed=seed)
            data = checks[label].outliers.without(data)  # what a run finds wrong is left out for all that follow
        shown = chosen_drives(list(checks.values()))
        drawn = []
        for label, fit in runs.items():
            begin()
            drawn.append({"label": label, **data_of_run(checks[label], fit, data, shown, draws=draws, seed=seed)})
        begin()
        proof: Proof | str = "There is one run only: name the run before and the one after to compare them."
        if len(runs) > 1:
            try:
                paths = {label: one.path for label, one in checks.items()}
                proof = prove(runs, data, paths=paths, horizons=horizons, seed=seed)
            except SteadyError as error:
                proof = f"The runs cannot be compared: {error}."
    return Report(
        title=title,
        table=table,
        fits=dict(runs),
        checks=checks,
        proof=proof,
        discovery=discovery,
        shown=shown,
        drives=common_data(next(iter(checks.values())), shown) | {"runs": drawn},
        how=list(how),
        notes=[*notes, *unconverged(runs)],
    )
