"""What Jupyter shows of tables, fits and results when they are a cell's last line."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from functools import partial, singledispatch
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure

from steady_ppl.comparison.result import Proof, verdict as comparison_verdict
from steady_ppl.criticism.result import Check, verdict as criticism_verdict
from steady_ppl.data.table import to_frame
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.discovery.result import Discovery, sentences
from steady_ppl.model.program import parameter_rows
from steady_ppl.plotting.check import check_picture
from steady_ppl.plotting.comparison import proof_picture
from steady_ppl.plotting.discovery import discovery_picture
from steady_ppl.runs.fit import Fit

DOTS_PER_INCH = 90  # an inch, of pictures
SENTENCE, PARAGRAPH = Markup("<p><strong>{}</strong></p>"), Markup("<p>{}</p>")


@singledispatch
def html(value: Any) -> str:
    """The HTML of a table, a fit or a result."""
    raise TypeError(f"no HTML is written of a {type(value).__name__}")


@html.register
def _(data: Trajectories) -> str:
    """How many drives and rows, and what is in each column."""
    frame = to_frame(data)
    shortest, longest = int(data.lengths.min()), int(data.lengths.max())
    lengths = f"{longest}" if shortest == longest else f"{shortest} to {longest}"
    rows = []
    for name in frame.columns.drop("trajectory"):
        values = frame[name].dropna()
        ends = (f"{values.min():.4g}", f"{values.max():.4g}") if len(values) else ("–", "–")
        rows.append((name, *ends, f"{1 - len(values) / len(frame):.1%}"))
    count = "1 trajectory" if len(data) == 1 else f"{len(data)} trajectories"
    about = f"{count} of {lengths} rows, a row every {data.median_step:.3g} s"
    return str(SENTENCE.format(about) + _table(("column", "least", "most", "empty"), rows))


@html.register
def _(fit: Fit) -> str:
    """Program, recipe, parameters, how it was judged, and what must be known of it."""
    trained = fit.trained
    how = f"fitted by {fit.recipe}" if trained else f"recipe {fit.recipe}, nothing learned"
    said = SENTENCE.format(f"{type(fit.program).__name__}, {how}")
    if trained and trained.rise:
        first, kept = trained.rise
        said += PARAGRAPH.format(
            f"held-out log p(y) {first:.2f} → {kept:.2f} nats a trajectory, kept at step {trained.kept}"
        )
    said += _table(("parameter", "value"), parameter_rows(fit.program))
    for note in fit.notes:
        said += PARAGRAPH.format(f"note: {note}")
    return str(said)


def _of_result(verdict: Callable[[Any], str], picture: Callable[[Any], Figure], found: Any) -> str:
    """A verdict, its picture, and all figures as text to unfold."""
    file = io.BytesIO()
    picture(found).savefig(file, format="png", dpi=DOTS_PER_INCH)
    said, image = verdict(found), base64.b64encode(file.getvalue()).decode()
    return str(
        SENTENCE.format(said)
        + Markup('<img style="max-width:100%" alt="{}" src="data:image/png;base64,{}">').format(said, image)
        + Markup("<details><summary>all figures</summary><pre>{}</pre></details>").format(found)
    )


html.register(Check, partial(_of_result, criticism_verdict, check_picture))
html.register(Proof, partial(_of_result, comparison_verdict, proof_picture))
html.register(Discovery, partial(_of_result, lambda found: " ".join(sentences(found)), discovery_picture))


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> Markup:
    head = Markup("").join(Markup('<th scope="col">{}</th>').format(cell) for cell in header)
    cells = (Markup("").join(Markup("<td>{}</td>").format(cell) for cell in row) for row in rows)
    body = Markup("").join(Markup("<tr>{}</tr>").format(row) for row in cells)
    return Markup("<table><thead><tr>{}</tr></thead><tbody>{}</tbody></table>").format(head, body)
