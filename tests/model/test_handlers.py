"""Shapes that go together, as torch has them, without what torch loads for it."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from steady_ppl.model.handlers import broadcast_shapes


@pytest.mark.parametrize(
    "shapes", [(), ((),), ((2,),), ((3, 1), (2,)), ((), (4, 1, 2)), (torch.Size([1]), [5, 1], (0, 5, 7)), ((1,), (0,))]
)
def test_shapes_go_together_as_torch_has_them(shapes) -> None:
    found = broadcast_shapes(*shapes)
    assert found == torch.broadcast_shapes(*shapes) and type(found) is torch.Size


def test_shapes_that_do_not_go_together_are_the_same_error() -> None:
    for function in (broadcast_shapes, torch.broadcast_shapes):
        with pytest.raises(RuntimeError):
            function((3,), (2,))


@pytest.mark.slow
def test_no_sympy_is_loaded_for_it() -> None:
    code = (
        "import sys; from steady_ppl.model.handlers import broadcast_shapes\n"
        "broadcast_shapes((3, 1), (2,)); print('sympy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
