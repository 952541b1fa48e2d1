"""The reference pages have every option, every public name and every key of a file."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import re
import textwrap
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import typer

import steady_ppl as st
from steady_ppl import plotting
from steady_ppl.cli.main import app
from steady_ppl.comparison import evaluate
from steady_ppl.comparison.result import Proof, _by_key
from steady_ppl.comparison.scores import Change
from steady_ppl.criticism import result as checks
from steady_ppl.criticism.step_size import StepCheck
from steady_ppl.data.doctor import Examination
from steady_ppl.data.suspicions import Suspicion
from steady_ppl.discovery import finding, result as discoveries
from steady_ppl.likelihood.outliers import Outliers
from steady_ppl.runs import folder, recipes

DOCS = Path(__file__).parents[2] / "docs"
FORMATS = (DOCS / "formats.md").read_text()


def loaded(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def commands(name: str, group: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for called, one in group.commands.items():
        found |= commands(f"{name} {called}", one) if hasattr(one, "commands") else {f"{name} {called}": one}
    return found


def test_the_site_lists_every_option_with_its_help() -> None:
    text, _, _ = loaded("site_commands").page().partition("## Every setting of a recipe")
    sections = dict(re.findall(r"^### `(.+?)`\n(.*?)(?=^### |\Z)", text, re.M | re.S))
    group = typer.main.get_command(app)
    expected = {"steady": group} | commands("steady", group)
    assert sections.keys() == expected.keys()
    for name, command in expected.items():
        assert all(parameter.help for parameter in command.params), name
        options = [one for parameter in command.params for one in parameter.opts if one.startswith("-")]
        assert [one for one in options if one not in sections[name]] == [], name
        assert sections[name].count("\n| `") == len(command.params)


def test_the_site_lists_every_setting_of_a_recipe_with_its_default_and_meaning() -> None:
    site = loaded("site_commands")
    _, _, text = site.page().partition("## Every setting of a recipe")
    sections = dict(re.findall(r"^### `--recipe (.+?)`\n(.*?)(?=^### |\Z)", text, re.M | re.S))
    assert len(sections) == len(site.RECIPES) > 5
    for name, section in sections.items():
        settings = inspect.signature(recipes.find_recipe(name)).parameters.values()
        expected = [(one.name, str(one.default)) for one in settings if one.name not in site.SHARED]
        rows = re.findall(r"^\| `(\w+)` \| (.+?) \| (.+) \|$", section, re.M)
        assert [row[:2] for row in rows] == expected
    assert "| `steps` | 25 | scoring steps at most. |" in sections["likelihood"]


def test_the_reference_has_every_public_name() -> None:
    paths = re.findall(r"^::: (\S+)$", (DOCS / "reference.md").read_text(), re.MULTILINE)
    documented = {path.rpartition(".")[2] for path in paths}
    assert (set(st.__all__) | set(plotting.__all__)) - documented - {"effects"} == set()
    assert len(paths) == len(set(paths))


def keys(*functions: Any) -> set[str]:
    """Those of the dictionaries that stand in functions."""
    found = set[str]()
    for function in functions:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
        for node in ast.walk(tree):
            if isinstance(node, ast.Dict):
                found |= {key.value for key in node.keys if isinstance(key, ast.Constant)}
    return found


def fields(of: type) -> set[str]:
    return set(of.__annotations__)


def said(title: str) -> set[str]:
    """Every word in backticks of a section."""
    (section,) = re.findall(rf"^##+ {re.escape(title)}\n(.*?)(?=^##|\Z)", FORMATS, re.MULTILINE | re.DOTALL)
    return {word for code in re.findall(r"`([^`]+)`", section) for word in re.findall(r"[\w.]+", code)}


WRITTEN = {
    "`run.json`": keys(st.Fit.record, recipes.run_recipe, recipes.begun_record, folder.write_record, st.Fit.save_into)
    - {"checkpoint", "resume", "progress"},
    "Run folder": {*folder.FILES, folder.BACKUP, folder.LOCK, folder.JOURNAL},
    "JSON of `doctor`": keys(Examination.figures.fget) | fields(Suspicion),
    "JSON of `check`": keys(
        checks.Check.figures.fget, checks._component, StepCheck.figures.fget, Outliers.figures.fget
    ),
    "JSON of `discover`": keys(st.Discovery.figures.fget, discoveries._candidate, discoveries._finding)
    | fields(finding.Shape)
    | fields(finding.NextRun),
    "JSON of `prove`": keys(Proof.figures.fget, _by_key) | fields(Change),
    "JSON of `evaluate`": keys(evaluate.evaluate, evaluate._errors_of_map, evaluate.map_errors) - {"look_ahead"}
    | {"one_step", "coverage_90", *evaluate.OPEN_LOOP},
}


@pytest.mark.parametrize("title", WRITTEN)
def test_the_page_of_formats_has_every_key(title: str) -> None:
    assert WRITTEN[title] and WRITTEN[title] - said(title) == set()


def test_every_verdict_is_listed() -> None:
    assert {*checks.VERDICTS, "nothing found"} - {"cannot tell", "nothing found"} <= said("JSON of `check`")
    assert set(discoveries.VERDICT_PHRASES) <= said("JSON of `discover`")
