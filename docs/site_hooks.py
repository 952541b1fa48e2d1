"""What the site makes of the pages: the README is its front page, the benchmarks' results are pages, mathematics is
MathML; all of them are written to be read in the repository as well."""

from __future__ import annotations

import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
LINKS = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
}
PAGES = {name: source for source, name in LINKS.items()} | {"benchmarks/README.md": "benchmarks/README.md"}
CODE = re.compile(r"(```.*?```|`[^`\n]*`)", re.DOTALL)


def on_files(files: Files, config) -> Files:
    """Add pages that live outside docs/."""
    pages = PAGES | {
        f"benchmarks/results/{file.name}": f"benchmarks/results/{file.name}"
        for file in sorted((ROOT / "benchmarks" / "results").glob("*.md"))
    }
    for name, source in pages.items():
        files.append(File.generated(config, name, content=(ROOT / source).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page, config, files) -> str:
    """Links as they are on the site, and formulas."""
    text = re.sub(r"\]\(docs/", "](", markdown) if page.file.src_uri in PAGES else markdown
    text = re.sub(r"\]\((?:\.\./)+(models/[^)]*)\)", r"](\1)", text)
    for here in (r"(?:models|LICENSE)[^)]*", r"[^)]*\.(?:ipynb|jsonl)"):  # files of the repository, not of the site
        text = re.sub(rf"\[([^\]]*)\]\({here}\)", r"\1", text)
    depth = page.file.src_uri.count("/")
    for source, name in LINKS.items():
        text = re.sub(rf"\]\((?:\.\./)*{source}", f"]({'../' * depth}{name}", text)
    if depth == 0:
        text = re.sub(r"\]\((?:\.\./)+benchmarks/", "](benchmarks/", text)
    else:
        text = re.sub(r"\]\((?:\.\./)+docs/", f"]({'../' * depth}", text)
    parts = CODE.split(text)
    parts[::2] = [_formulas(part) for part in parts[::2]]
    return "".join(parts)


def _formulas(text: str) -> str:
    text = re.sub(r"\$\$(.+?)\$\$", lambda one: convert(one[1].strip(), display="block"), text, flags=re.DOTALL)
    return re.sub(r"(?<![\w$\\])\$([^$\n]+?)\$(?![\w$])", lambda one: convert(one[1]), text)
