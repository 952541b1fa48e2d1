"""The public namespace."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import steady_ppl


def test_every_public_name_is_there() -> None:
    for name in steady_ppl.__all__:
        assert getattr(steady_ppl, name).__name__ == name
    assert set(dir(steady_ppl)) == set(steady_ppl.__all__)


def test_type_checkers_see_the_same_names() -> None:
    tree = ast.parse(Path(steady_ppl.__file__).read_text())
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    seen = {alias.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert seen == {name: f"steady_ppl.{module}" for name, module in steady_ppl._HOME.items()}


def test_an_unknown_name_is_an_ordinary_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'steady'"):
        steady_ppl.steady  # noqa: B018


def test_importing_the_package_loads_no_torch() -> None:
    code = "import steady_ppl, steady_ppl.command_line, sys; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
