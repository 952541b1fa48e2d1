"""The documentation: its examples run, its commands parse, its generated pages are those of the code."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from rover_logs import px4, world
from small import blocks, commands, simulated

import steady_ppl as st
from steady_ppl.cli.main import GLOBAL_OPTIONS, app, main
from steady_ppl.effects import catalogue

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [*sorted(DOCS.glob("*.md")), *sorted(ROOT.glob("*.md"))]
RUN = (
    "own-effect",
    "own-recipe",
    "import-log",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("cli", "own-data", "own-sensor", "control", "vehicles")),
    *(pytest.param(name, marks=pytest.mark.exhaustive) for name in ("own-program", "time-steps", "start-prior")),
)


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=lambda page: page.stem)
def test_every_command_parses(page: Path) -> None:
    group = typer.main.get_command(app)
    for words in commands(page):
        name, *rest = [word for word in words if word not in GLOBAL_OPTIONS]
        command = group.commands[name]
        while hasattr(command, "commands"):
            name, *rest = rest
            command = command.commands[name]
        command.make_context(name, rest)


def test_the_readme_points_at_the_page_that_has_every_command() -> None:
    text = (DOCS / "cli.md").read_text()
    names = [one.name for one in (*app.registered_commands, *app.registered_groups)]
    assert [name for name in names if f"`steady {name}`" not in text] == []
    assert "](docs/cli.md)" in (ROOT / "README.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("name", RUN)
def test_the_examples_of_a_page_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a folder as `steady init` makes it, a namespace for the page; blocks with a title are files."""
    for room in ("models", "inference"):
        (tmp_path / room).symlink_to(ROOT / room)
    for seed, table in enumerate(("train", "valid", "test")):
        st.write_table(simulated(rows=21, seed=seed), tmp_path / f"{table}.csv")
    (tmp_path / "drive.ulg").write_bytes(px4(world(10.0)))
    monkeypatch.chdir(tmp_path)
    program = []
    page = DOCS / f"{name}.md"
    for about, text in [*blocks(page, "toml"), *blocks(page, "python")]:
        titled = re.search(r'title="([^"]+)"', about)
        if titled:
            (tmp_path / titled[1]).write_text(text)
        else:
            program.append(text)
    (tmp_path / "page.py").write_text("\n".join(program))
    done = subprocess.run([sys.executable, "page.py"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


@pytest.mark.exhaustive
def test_the_study_of_the_page_is_computed_and_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With fewer drives and seeds."""
    ((about, text),) = blocks(DOCS / "studies.md", "toml")
    for many, few in (("[1, 2, 3]", "[1, 2]"), ("[2, 8, 32]", "[2, 4]"), ("= 16", "= 2"), ("test = 32", "test = 2")):
        assert many in text
        text = text.replace(many, few)
    assert 'title="drives.toml"' in about
    (tmp_path / "drives.toml").write_text(text)
    (tmp_path / "models").symlink_to(ROOT / "models")
    monkeypatch.chdir(tmp_path)
    here = [words for words in commands(DOCS / "studies.md") if "--cluster" not in words]
    assert [main(words) for words in here] == [0, 0] and Path("drives/study.png").is_file()
    for page in ("studies", "cluster"):
        ((_, looked),) = blocks(DOCS / f"{page}.md", "python")
        done = subprocess.run([sys.executable, "-c", looked], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0 and (page != "cluster" or "hours of one core" in done.stdout), done.stderr


def test_a_recipe_of_the_page_fits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ((_, text),) = [one for one in blocks(DOCS / "own-recipe.md", "python") if "several_starts.py" in one[0]]
    (tmp_path / "several_starts.py").write_text(text)
    (tmp_path / "models").symlink_to(ROOT / "models")
    st.write_table(simulated(rows=21), tmp_path / "train.csv")
    monkeypatch.chdir(tmp_path)
    (words,) = commands(DOCS / "own-recipe.md")
    assert main(words) == 0
    assert st.Fit.load("runs/several").recipe == "several-starts"


def test_the_gallery_is_that_of_the_catalogue() -> None:
    """`python docs/gallery.py` brings it up to date."""
    spec = importlib.util.spec_from_file_location("gallery", DOCS / "gallery.py")
    gallery = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(gallery)
    assert (DOCS / "gallery.md").read_text() == gallery.page()
    assert {f"{gallery.slug(effect)}.png" for effect in catalogue()} == {
        file.name for file in (DOCS / "gallery").glob("*.png")
    }


def test_every_effect_says_where_it_is_met() -> None:
    assert [effect.name for effect in catalogue() if not effect.occurs] == []


def anchors(page: Path) -> set[str]:
    """Those of a page's headings."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower()) for title in titles}


def test_links_lead_somewhere() -> None:
    for page in [*PAGES, *sorted((ROOT / "benchmarks").rglob("*.md"))]:
        for link, _, anchor in re.findall(r"\]\(([^)#\s]*)(#([^)\s]*))?\)", page.read_text()):
            target = page.parent / link if link else page
            assert link.startswith("http") or target.exists(), f"{page.name}: {link}"
            assert target.suffix != ".md" or not anchor or anchor in anchors(target), f"{page.name}: {link}#{anchor}"
