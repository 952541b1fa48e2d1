"""The README is short; it and the pages below are plain: sentences of few words, the field's terms, no history."""

from __future__ import annotations

import re
from pathlib import Path
from statistics import median

import pytest

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
NOT_YET = ("gallery", "reference")  # written from docstrings
PAGES = [
    *sorted(ROOT.glob("*.md")),
    *(page for page in sorted((ROOT / "docs").glob("*.md")) if page.stem not in NOT_YET),
]
UNWANTED = re.compile(
    r"\b(believ\w*|accus\w*|innocent|swallow\w*|guilty|(?:model|program|particle|score)s? (?:explains?|knows?)"
    r"|looks? ahead|blows? up|yardsticks?|rivals?|hostile|begun|gone on with|falls? short)\b",
    re.IGNORECASE,
)
ENDS = re.compile(r"(?:(?<=[.!?])|(?<=[.!?]\)))\s+(?=[A-Z0-9(“\"])")
COMMIT = re.compile(r"\b(?=[0-9a-f]*\d)(?=[0-9a-f]*[a-f])[0-9a-f]{7}\b")


def prose(text: str) -> list[str]:
    """Paragraphs and list items, without code, tables, headings, pictures and targets of links."""
    text = re.sub(r"^```.*?^```$", "\n", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^(?:#|\||!\[).*$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"`[^`\n]+`", "Code", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text).replace("*", "")
    return [part.strip() for part in re.split(r"\n\s*\n|\n(?=- )", text) if part.strip("- \n")]


def sentences(text: str) -> list[str]:
    return [one for part in prose(text) for one in ENDS.split(part)]


def lengths(text: str) -> list[int]:
    return [len(re.findall(r"\S*\w\S*", one)) for one in sentences(text)]


def test_sentences_are_told_apart_and_counted() -> None:
    text = (
        "# A\n\nOne two .3 m [and more](x.md) `steady fit --out x`. **Two.** A\nthird!\n\n- four\n- five six\n\n| 7 |"
    )
    assert lengths(text) == [7, 1, 2, 1, 2]
    assert UNWANTED.search("the program explains it") and not UNWANTED.search("it is explained")
    assert COMMIT.search("by commit aee9f21") and not COMMIT.search("effaced by 1234567 particles")


def test_the_readme_is_short() -> None:
    text = README.read_text()
    assert len(text.split()) <= 1100 and len(text.splitlines()) <= 150
    assert median(lengths(text)) <= 17 and max(lengths(text)) <= 30


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_is_plain(page: Path) -> None:
    text = page.read_text()
    assert median(lengths(text)) <= 18
    assert [one for one, length in zip(sentences(text), lengths(text), strict=True) if length > 25] == []
    assert UNWANTED.findall(" ".join(prose(text))) == []
    assert COMMIT.findall(text) == []  # history belongs to benchmarks/


def test_the_model_of_the_readme_is_that_of_the_file() -> None:
    (block,) = re.findall(r"^```python\n(.*?)^```", README.read_text(), re.MULTILINE | re.DOTALL)
    model = (ROOT / "models" / "hovercraft.py").read_text().splitlines()
    assert [line for line in block.splitlines() if line not in model] == []
