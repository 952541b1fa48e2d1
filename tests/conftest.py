"""Every test starts from the same random numbers, and keeps kernels in a folder of its session."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from examples import drives, example
from hypothesis import HealthCheck, settings
from small import FEW, HOVERCRAFT, contents, simulated, steady, tree, written

settings.register_profile(
    "repeated", derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck)
)
settings.register_profile("long", settings.get_profile("repeated"), derandomize=False, max_examples=200)
settings.load_profile("repeated")

TOLD_AT_ONCE = 20.0  # seconds of a test or of what it needs


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--share", metavar="K/N", help="of the tests that are selected only every Nth, from number K on")


@pytest.hookimpl(trylast=True)  # after -m
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if share := config.getoption("--share"):
        first, shares = (int(number) for number in share.split("/"))
        others = [item for index, item in enumerate(items) if index % shares != first % shares]
        items[:] = items[first % shares :: shares]
        config.hook.pytest_deselected(items=others)


def pytest_configure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(LongTests(config))


class LongTests:
    """Names a test that takes long when it ends, so that a run that is stopped shows what took its time."""

    def __init__(self, config: pytest.Config) -> None:
        self.config = config

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.duration > TOLD_AT_ONCE:
            self.config.get_terminal_writer().line(f" {report.duration:.0f}s {report.when} {report.nodeid}")


@pytest.fixture(autouse=True)
def _same_random_numbers():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


@pytest.fixture(scope="session", autouse=True)
def _kernels_of_the_tests(tmp_path_factory: pytest.TempPathFactory):
    """Machine code is kept in a folder of this session: none comes from the user's, none goes there."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STEADY_KERNEL_CACHE", str(tmp_path_factory.mktemp("kernels")))
        yield


@pytest.fixture(scope="session")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tables, and a run of each of two recipes."""
    folder = tmp_path_factory.mktemp("work")
    written(folder / "train.csv")
    written(folder / "valid.parquet", simulated(trajectories=2, rows=33, seed=1))
    written(folder / "test.csv", simulated(trajectories=5, rows=13, seed=2))
    assert steady("fit", HOVERCRAFT, folder / "train.csv", "--recipe", "hand", "--out", folder / "hand") == 0
    assert steady("fit", HOVERCRAFT, folder / "train.csv", "--out", folder / "steady", *FEW) == 0
    return folder


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., None]:
    """Asserts that a command ends with a code and one line that says something, and that no file is touched."""

    def check(code: int, says: str, *arguments: object, folder: Path = tmp_path) -> None:
        capsys.readouterr()
        before = contents(folder), tree(folder)
        assert steady(*arguments) == code
        out, error = capsys.readouterr()
        assert error.startswith("steady: ") and 1 <= len(error.splitlines()) <= 2, error
        assert says in error
        assert out == ""
        assert (contents(folder), tree(folder)) == before

    return check


@pytest.fixture(scope="module")
def cart():
    return example("linear_gaussian").requires_grad_(False)


@pytest.fixture(scope="module")
def even(cart):
    """Three complete trajectories."""
    return drives(cart, 3, 12)


@pytest.fixture(scope="module")
def uneven(cart):
    """Lengths 12 and 10, gaps in the measurements, irregular steps."""
    return drives(cart, 3, 12, gaps=True)
