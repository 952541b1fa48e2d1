"""What the site makes of the pages: the README is its front page, the benchmarks' results and the notebooks are pages,
the page of the command line lists every option, mathematics is MathML. All pages can be read in the repository too."""

from __future__ import annotations

import re
from pathlib import Path

import site_commands
import site_notebooks
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
SEARCH = 'data-md-component="search" role="dialog"'
CODE = re.compile(r"(```.*?```|`[^`\n]*`)", re.DOTALL)


def on_files(files: Files, config) -> Files:
    """Add pages that live outside docs/."""
    pages = PAGES | {
        f"benchmarks/results/{file.name}": f"benchmarks/results/{file.name}"
        for file in sorted((ROOT / "benchmarks" / "results").glob("*.md"))
    }
    for name, source in pages.items():
        files.append(File.generated(config, name, content=(ROOT / source).read_text(encoding="utf-8")))
    for file in sorted((ROOT / "notebooks").glob("*.ipynb")):
        files.append(File.generated(config, f"notebooks/{file.stem}.md", content=site_notebooks.page(file)))
    return files


def on_page_markdown(markdown: str, page, config, files) -> str:
    """Links as they are on the site, options, and formulas."""
    if page.file.src_uri == "cli.md":
        markdown += f"\n{site_commands.page()}"
    text = re.sub(r"\]\(docs/", "](", markdown) if page.file.src_uri in PAGES else markdown
    text = re.sub(r"\]\((?:\.\./)+(models/[^)]*)\)", r"](\1)", text)
    text = re.sub(r"\]\((?:\.\./)*(notebooks/[^)]*)\.ipynb\)", r"](\1.md)", text)
    for here in (r"(?:models|LICENSE)[^)]*", r"[^)]*\.jsonl"):  # files of the repository, not of the site
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


def on_post_page(output: str, page, config) -> str:
    return _accessible(output)


def on_post_template(output: str, template_name: str, config) -> str:
    return _accessible(output) if template_name.endswith(".html") else output


def _accessible(text: str) -> str:
    """Name the theme's search, and make cells without text in the heads of tables plain ones."""
    text = text.replace(SEARCH, f'{SEARCH} aria-label="Search"')
    return re.sub(r"<th( [^>]*)?></th>", r"<td\1></td>", text)


def _formulas(text: str) -> str:
    text = re.sub(r"\$\$(.+?)\$\$", _block, text, flags=re.DOTALL)
    return re.sub(r"(?<![\w$\\])\$([^$\n]+?)\$(?![\w$])", lambda one: convert(one[1]), text)


def _block(formula: re.Match[str]) -> str:
    return f'<div class="formula">{convert(formula[1].strip(), display="block")}</div>'
