"""The public namespace."""

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import steady_ppl
from steady_ppl.utils import context

STUB = Path(steady_ppl.__file__).with_suffix(".pyi")


def test_every_public_name_is_there() -> None:
    for name in set(steady_ppl.__all__) - {"effects"}:
        assert getattr(steady_ppl, name).__name__ == name
    assert steady_ppl.effects.__name__ == "steady_ppl.effects"
    assert set(dir(steady_ppl)) == set(steady_ppl.__all__)


def test_a_public_name_is_re_exported_for_type_checkers() -> None:
    named = [alias for node in ast.parse(STUB.read_text()).body for alias in node.names]  # type: ignore[attr-defined]
    assert all(alias.asname == alias.name for alias in named)
    assert {alias.name for alias in named} == set(steady_ppl.__all__)


def test_an_unknown_name_is_an_ordinary_error() -> None:
    with pytest.raises(AttributeError, match="steady_ppl attribute steady"):
        steady_ppl.steady  # noqa: B018


def test_importing_the_package_loads_no_torch() -> None:
    code = "import steady_ppl, steady_ppl.cli.main, sys; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


def test_the_root_says_what_lower_packages_call_of_higher_ones() -> None:
    assert context.__annotations__.keys() <= vars(context).keys() and context.html is not repr


def test_the_citation_is_of_this_version() -> None:
    root = Path(__file__).parents[2]
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    given = dict(re.findall(r"^(\w+): (.+)$", (root / "CITATION.cff").read_text(), re.MULTILINE))
    assert (given["version"], given["title"], given["license"]) == (
        project["version"],
        project["name"],
        project["license"],
    )
    assert given["abstract"] == f"{project['description']}."
    assert f"## {project['version']}" in (root / "CHANGELOG.md").read_text()
    assert (STUB.parent / "py.typed").is_file()
