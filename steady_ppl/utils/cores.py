"""Independent jobs beside each other, one thread each, on the cores that this process may use.

Other processes are forked: they have what this one has, so that nothing is sent to them, and their results come back as
safetensors. On other systems than Linux, or where CUDA is in use, no fork is safe, and jobs run one after another.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from typing import IO, Any

import torch
from torch import Tensor

from steady_ppl.utils.tensor_files import packed, unpacked

Result = tuple[Mapping[str, Tensor], Mapping[str, Any]]  # tensors, and what JSON can hold
Job = Callable[[], Result]
MOST = 8  # processes at once: each has memory of its own
DIE_WITH_PARENT = 1  # of Linux's prctl

_most: ContextVar[int] = ContextVar("how many processes the block may take", default=MOST)


@contextmanager
def one_core() -> Iterator[None]:
    """Run all jobs of the block in this process, for example where many such processes run."""
    token = _most.set(1)
    try:
        yield
    finally:
        _most.reset(token)


def side_by_side(jobs: Sequence[Job]) -> list[Result]:
    """What jobs return, in their order. They draw no random numbers, print nothing and change nothing that is shared.

    Jobs whose process fails are run here, where their errors are raised as any other.
    """
    processes = max(1, min(_most.get(), _cores(), len(jobs)))
    shares = [range(first, len(jobs), processes) for first in range(processes)]
    with ExitStack() as ends:
        children = []
        for share in shares[1:]:
            children.append(_Child(jobs, share, ends.enter_context(tempfile.TemporaryFile())))
            ends.callback(children[-1].end)
        found = {index: jobs[index]() for index in shares[0]}
        for child in children:
            found.update(child.results())
    return [found[index] if index in found else jobs[index]() for index in range(len(jobs))]


class _Child:
    """A forked process that runs a share of the jobs."""

    def __init__(self, jobs: Sequence[Job], share: Sequence[int], file: IO[bytes]) -> None:
        self.share, self.file = share, file
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # there are other threads, which the child has not
            self.pid = os.fork()
        if self.pid == 0:
            self._run(jobs)

    def _run(self, jobs: Sequence[Job]) -> None:
        """In the child, which ends here."""
        status = 1
        try:
            ctypes.CDLL(None).prctl(DIE_WITH_PARENT, signal.SIGKILL)
            _most.set(1)
            for index in self.share:
                tensors, values = jobs[index]()
                content = packed(tensors, {"values": json.dumps(values)})
                self.file.write(len(content).to_bytes(8, "little") + content)
            self.file.flush()
            status = 0
        finally:
            os._exit(status)

    def results(self) -> dict[int, Result]:
        """By the jobs' numbers, when it has ended; nothing if it failed."""
        if self._wait() != 0:
            return {}
        self.file.seek(0)
        found: dict[int, Result] = {}
        for index in self.share:
            tensors, text = unpacked(self.file.read(int.from_bytes(self.file.read(8), "little")))
            found[index] = tensors, json.loads(text["values"])
        return found

    def end(self) -> None:
        """Stop it if it still runs."""
        if self.pid:
            os.kill(self.pid, signal.SIGKILL)
            self._wait()

    def _wait(self) -> int:
        pid, self.pid = self.pid, 0
        return os.waitpid(pid, 0)[1]


def _cores() -> int:
    """Of this process, one where forks are not safe."""
    if sys.platform != "linux" or torch.cuda.is_initialized():
        return 1
    return len(os.sched_getaffinity(0))
