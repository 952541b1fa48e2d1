"""A notebook with its stored outputs as Markdown."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

FILE = re.compile(r"%%writefile (\S+)\n")


def page(notebook: Path) -> str:
    """Return text, code and outputs in their order; a picture is named after the heading above it."""
    title, parts = "", list[str]()
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            title = [title, *re.findall(r"^#+ (.+)$", source, re.MULTILINE)][-1]
            parts.append(source)
            continue
        file = FILE.match(source)
        about = f' title="{file[1]}"' if file else ""
        parts.append(f"```python{about}\n{FILE.sub('', source, count=1)}\n```")
        parts += [part for output in cell["outputs"] for part in _shown(output, title)]
    return "\n\n".join(parts) + "\n"


def _shown(output: Mapping[str, Any], title: str) -> Iterator[str]:
    """What a notebook shows of an output: HTML, else a picture, else text."""
    data = {kind: "".join(lines) for kind, lines in output.get("data", {"text/plain": output.get("text")}).items()}
    if "text/html" in data:
        yield _html(data["text/html"])
    elif "image/png" in data:
        source = f"data:image/png;base64,{data['image/png'].strip()}"
        yield f'<p><img alt="{html.escape(title)}" src="{source}"></p>'
    else:
        yield f"```text\n{data['text/plain'].rstrip()}\n```"


def _html(text: str) -> str:
    """Tables as the site draws its own, in one block."""
    text = re.sub(r"<style.*?</style>", "", text, flags=re.DOTALL)
    text = re.sub(r'<table border="1" class="dataframe">', "<table>", text).replace("<th></th>", "<td></td>")
    return "<div>" + re.sub(r"\n\s*\n", "\n", text).strip() + "</div>"
