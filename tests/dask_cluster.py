"""A Dask cluster on this machine: a scheduler and workers, each a process, on loopback."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path


class Dask:
    """A scheduler and workers, which their own process ids end.

    Args:
        folder: of their log and of what workers put aside.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.processes, self.port = folder, list[subprocess.Popen](), free_port()

    @property
    def address(self) -> str:
        """Of the scheduler."""
        return f"tcp://127.0.0.1:{self.port}"

    def start(self, *words: str, **environment: str) -> subprocess.Popen:
        """One of Dask's commands."""
        command = [sys.executable, "-m", "distributed.cli.dask_" + words[0], *words[1:]]
        alone = {**os.environ, "OMP_NUM_THREADS": "1"}
        with (self.folder / "dask.log").open("a") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log, env=alone | environment, cwd=self.folder)
        self.processes.append(process)
        return process

    def scheduler(self) -> subprocess.Popen:
        """Start it, at the address; returns when it answers."""
        words = ("--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard", "--no-show")
        process = self.start("scheduler", *words)
        wait_for(lambda: answers(self.port))
        return process

    def worker(self, *more: str, **environment: str) -> subprocess.Popen:
        """Start one of a single thread, unless more is said, which lives as long as its scheduler."""
        return self.start("worker", self.address, "--no-nanny", *self._words, *more, **environment)

    def nanny(self) -> subprocess.Popen:
        """Start one whose process is replaced when it dies."""
        return self.start("worker", self.address, *self._words)

    @property
    def _words(self) -> tuple[str, ...]:
        return ("--nthreads", "1", "--no-dashboard", "--local-directory", str(self.folder))

    def end(self) -> None:
        """End all that were started."""
        for process in reversed(self.processes):
            process.terminate()  # a nanny takes its worker with it
        for process in self.processes:
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def free_port() -> int:
    """A port of loopback that nobody uses."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def answers(port: int) -> bool:
    """Whether somebody listens there."""
    with socket.socket() as caller:
        return caller.connect_ex(("127.0.0.1", port)) == 0


def wait_for(condition: Callable[[], bool], seconds: float = 60) -> None:
    """Until it holds; an error if it does not in time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)
