"""One thread, whatever there was before."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest
import torch
from small import TRUTH

import steady_ppl as st
from steady_ppl.utils.cores import ONE_THREAD, one_thread


@pytest.fixture(autouse=True)
def _three_threads() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(threads)


def test_a_block_runs_on_one_thread_and_the_callers_setting_comes_back() -> None:
    with one_thread():
        with one_thread():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 3


def test_the_setting_comes_back_after_an_error() -> None:
    with pytest.raises(KeyError), one_thread():
        raise KeyError
    assert torch.get_num_threads() == 3


class Seen(Exception):
    """Somebody looked at a `Watched`."""


class Watched:
    """Says how many threads there were when a function first looked at its argument."""

    def __getattr__(self, name: str) -> None:
        raise Seen(torch.get_num_threads())

    def __len__(self) -> int:
        raise Seen(torch.get_num_threads())


FILTER = {"particles": 2, "known_start": False}
ENTRIES: dict[str, dict[str, object]] = {
    "check": {},
    "discover": {},
    "fit_by_likelihood": {},
    "fixes": {},
    "log_likelihood": FILTER,
    "parameter_posterior": {},
    "particle_filter": FILTER,
    "prove": {},
    "run_filter": FILTER,
    "smoothed_states": {"known_start": False},
    "train": {"validation": None, "optimization": st.Optimization()},
}


@pytest.mark.parametrize("name", ENTRIES)
def test_a_public_function_computes_on_one_thread(name: str) -> None:
    guide = [Watched()] if name == "train" else []
    with pytest.raises(Seen) as seen:
        getattr(st, name)(Watched(), *guide, Watched(), **ENTRIES[name])
    assert seen.value.args == (1,)
    assert torch.get_num_threads() == 3


def test_a_program_moves_on_one_thread() -> None:
    seen, program = set(), st.load_program(TRUTH)
    program.duration, move = 3 * program.step, program.transition

    def transition(*arguments: torch.Tensor) -> torch.Tensor:
        seen.add(torch.get_num_threads())
        return move(*arguments)

    program.transition = transition  # type: ignore[method-assign]
    st.simulate(program, 2)
    assert seen == {1} and torch.get_num_threads() == 3


@pytest.mark.slow
def test_the_command_has_one_thread_whatever_the_environment_says() -> None:
    code = (
        "import sys; from steady_ppl.cli.main import run\n"
        "sys.argv = ['steady', 'effects']\n"
        "try: run()\n"
        "except SystemExit: pass\n"
        "import torch; print(torch.get_num_threads())"
    )
    asked = {**os.environ, **dict.fromkeys(ONE_THREAD, "3")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=asked)
    assert done.stdout.splitlines()[-1] == "1"
