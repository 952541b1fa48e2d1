"""Pictures as files, whole or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from steady_ppl.errors import UsageError
from steady_ppl.harmless import harmless
from steady_ppl.whole_file import require_place, whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def require_picture(path: Path | None) -> None:
    """Refuse a name whose ending is no picture's, or a place that there is not, before anything is computed; None is no
    picture.

    Raises:
        UsageError: naming the endings that matplotlib writes, or the folder.
    """
    require_place(path)
    if path is None:
        return
    from matplotlib.figure import Figure

    formats = set(Figure().canvas.get_supported_filetypes()) - {"pgf"}  # which needs TeX
    if path.suffix.lower()[1:] not in formats:
        raise UsageError(f"{path}: expected a picture's name that ends in one of {', '.join(sorted(formats))}")


def write_picture(figure: Figure, path: Path) -> None:
    """Write a picture whole or not at all.

    Raises:
        UsageError: the file cannot be written.
    """
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_text(harmless(text.get_text()))  # matplotlib draws no name that is not UTF-8
    with whole_file(path) as beside:
        figure.savefig(beside, format=path.suffix.lower()[1:], dpi=150)
