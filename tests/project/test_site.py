"""The site builds without a warning, and its pages are in order for readers who do not see them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HEADINGS = ("h1", "h2", "h3", "h4", "h5", "h6")


class Page(HTMLParser):
    """What of a page can be wrong for screen readers and keyboards."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.levels, self.without_alt, self.empty_heads = list[int](), 0, 0
        self.ids, self.unnamed, self.language = Counter[str](), list[str](), ""
        self._head: str | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.language = given.get("lang") or self.language if tag == "html" else self.language
        if tag in HEADINGS:
            self.levels.append(HEADINGS.index(tag) + 1)
        if tag == "img" and not given.get("alt"):
            self.without_alt += 1
        if tag == "th":
            self._head = ""
        if given.get("role") == "dialog" and not given.get("aria-label"):
            self.unnamed.append(str(given.get("class")))
        if name := given.get("id"):
            self.ids[name] += 1

    def handle_data(self, data: str) -> None:
        if self._head is not None:
            self._head += data

    def handle_endtag(self, tag: str) -> None:
        if tag == "th" and self._head is not None:
            self.empty_heads += not self._head.strip()
            self._head = None

    @property
    def faults(self) -> list[str]:
        jumps = [f"h{a} before h{b}" for a, b in zip([0, *self.levels], self.levels, strict=False) if b > a + 1]
        twice = [f"id {name} is there {count} times" for name, count in self.ids.items() if count > 1]
        found = [*jumps, *twice, *(f"a dialog without a name: {one}" for one in self.unnamed)]
        found += [f"{self.levels.count(1)} main headings"] * (self.levels.count(1) != 1)
        found += [f"{self.without_alt} pictures without alt"] * bool(self.without_alt)
        found += [f"{self.empty_heads} empty heads of columns"] * bool(self.empty_heads)
        return found + ["no language"] * (not self.language)


def test_each_fault_is_found() -> None:
    good = '<html lang="en"><h1>a</h1><h2 id="b">b</h2><img alt="c"><th>d</th>'
    assert Page(good).faults == []
    for old, new in (
        (' lang="en"', ""),
        ("h2", "h3"),
        ('alt="c"', ""),
        ("<th>d", "<th>"),
        ("<h1>a</h1>", ""),
        ("<th>", '<th><p id="b">'),
        ("<th>", '<p role="dialog"><th>'),
    ):
        assert Page(good.replace(old, new)).faults != [], new


@pytest.mark.slow
def test_every_page_is_in_order(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    pages = {page: Page(page.read_text(encoding="utf-8")) for page in tmp_path.rglob("*.html")}
    notebooks = {file.stem for file in (ROOT / "notebooks").glob("*.ipynb")}
    assert notebooks <= {page.stem for page in pages} and len(pages) > 50
    assert {str(page.relative_to(tmp_path)): one.faults for page, one in pages.items() if one.faults} == {}
