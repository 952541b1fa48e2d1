"""How many threads and processes a computation takes: one thread each, on the cores that this process may use.

The engine's tensors are small. Torch's threads wait for one another by spinning, so that on a busy machine two threads
took 20 to 55 times the CPU time of one, in filters of 20,000 to 500 particles a drive. On quiet cores two threads
brought a filter of 100,000 particles in plain torch from 3.5 s to 2.5 s, its kernels nothing, and smaller filters lost.

Coarse jobs run side by side, in processes that are forked: they have what this one has, so that nothing is sent to
them, and their results come back as safetensors. On other systems than Linux, or where CUDA is in use, no fork is safe,
and jobs run one after another. This module loads no torch, which reads `ONE_THREAD` as it loads.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor

Result = tuple[Mapping[str, "Tensor"], Mapping[str, Any]]  # tensors, and what JSON can hold
Job = Callable[[], Result]
MOST = 8  # processes at once: each has memory of its own
DIE_WITH_PARENT = 1  # of Linux's prctl
POOLS = ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMBA", "NUMEXPR")
ONE_THREAD = dict.fromkeys([*(f"{name}_NUM_THREADS" for name in POOLS), "VECLIB_MAXIMUM_THREADS"], "1")
"""Environment of a process whose libraries have one thread each; they read it as they load."""

_lock = threading.Lock()
_inside, _given = 0, 1  # how many blocks are on one thread, and how many threads there were before the first
_most: ContextVar[int] = ContextVar("how many processes the block may take", default=MOST)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute the block on one thread; also a decorator. When the last block ends, it has as many threads as
    before the first one.

    A result then depends neither on the machine's cores nor on the caller's setting.
    """
    import torch

    global _inside, _given
    with _lock:
        if _inside == 0:
            _given = torch.get_num_threads()
        _inside += 1
    if torch.get_num_threads() != 1:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0 and torch.get_num_threads() != _given:
                torch.set_num_threads(_given)


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
            from steady_ppl.utils.tensor_files import packed

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
        from steady_ppl.utils.tensor_files import unpacked

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
    import torch

    if sys.platform != "linux" or torch.cuda.is_initialized():
        return 1
    return len(os.sched_getaffinity(0))
