"""How many threads and processes a computation takes: one thread each, on the cores that this process may use.

The engine's tensors are small. Torch's threads wait for one another by spinning: on a busy machine two took 20 to 55
times the CPU time of one. On quiet cores two helped a filter of 100,000 particles in plain torch alone, 3.5 to 2.5 s.

Coarse computations run in parallel, in processes that are forked: they have what this one has, so that nothing is sent
to them, and their results come back as safetensors. On other systems than Linux, off the main thread, or where CUDA is
in use, no fork is safe, and they run one after another. This module loads no torch, which reads `ONE_THREAD` as it
loads.
"""

import ctypes
import json
import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from contextvars import ContextVar
from functools import partial
from multiprocessing.connection import wait
from typing import IO, TYPE_CHECKING, Any

from steady_ppl.utils.context import bound
from steady_ppl.utils.progress import unheard

if TYPE_CHECKING:
    from torch import Tensor

Output = tuple[Mapping[str, "Tensor"], Mapping[str, Any]]  # tensors, and what JSON can hold
Computation = Callable[[], Output]
MAX_PROCESSES = 8  # at once: each has memory of its own
MIN_PATIENCE_SECONDS, MAX_SLOWDOWN = 10.0, 5.0  # and times its own share's, that this process waits for another
DIE_WITH_PARENT = 1  # of Linux's prctl
ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, *([signal.SIGALRM] if hasattr(signal, "SIGALRM") else []))
END_MARK = b"whole"
THREAD_POOLS = ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMBA", "NUMEXPR")
ONE_THREAD = dict.fromkeys([*(f"{name}_NUM_THREADS" for name in THREAD_POOLS), "VECLIB_MAXIMUM_THREADS"], "1")
"""Environment of a process whose libraries have one thread each; they read it as they load."""

_lock = threading.Lock()
_inside, _given = 0, 1  # how many blocks are on one thread, and how many threads there were before the first
_most: ContextVar[int] = ContextVar("how many processes the block may take", default=MAX_PROCESSES)


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


def one_core() -> AbstractContextManager[None]:
    """Run all computations of the block in this process, for example where many such processes run."""
    return bound(_most, 1)


def run_in_parallel(computations: Sequence[Computation]) -> list[Output]:
    """What they return, in their order. They draw no random numbers, print nothing and change nothing that is shared.

    Those whose process fails, hangs or cannot be had are run here, where their errors are raised as any other.
    """
    with one_thread(), ExitStack() as ends:  # of two threads one would be missing after a fork
        processes = _processes(len(computations))
        shares = [range(first, len(computations), processes) for first in range(processes)]
        children = []
        for share in shares[1:]:
            children.append(_Child(computations, share))
            ends.callback(children[-1].end)
            children[-1].begin()
        began = time.monotonic()
        found = {index: computations[index]() for index in shares[0]}
        patience = MIN_PATIENCE_SECONDS + MAX_SLOWDOWN * (time.monotonic() - began)
        for child in children:
            found.update(child.results(patience))
        return [found[index] if index in found else computations[index]() for index in range(len(computations))]


def in_batches(computations: Sequence[Computation]) -> list[Computation]:
    """Computations with the same outputs, each to be called once and in order. One whose output is not there yet runs
    the next ones on other cores meanwhile. What fails there runs again in its turn."""
    found: dict[int, Output] = {}
    here = os.getpid()
    nothing: Output = ({}, {})

    def elsewhere(index: int) -> Output:
        return nothing if os.getpid() == here else computations[index]()

    def output(index: int) -> Output:
        if index not in found:
            last = min(index + _processes(len(computations)), len(computations))
            later = [other for other in range(index + 1, last) if other not in found]
            jobs: list[Computation] = [computations[index], *(partial(elsewhere, other) for other in later)]
            outputs = zip((index, *later), run_in_parallel(jobs), strict=True)
            found.update({at: one for at, one in outputs if one is not nothing})
        return found.pop(index)

    return [partial(output, index) for index in range(len(computations))]


class _Child:
    """A forked process that runs a share of the computations, and the memory in which it leaves their results."""

    def __init__(self, computations: Sequence[Computation], share: Sequence[int]) -> None:
        self.computations, self.share = computations, share
        self.pid, self.handle = 0, -1  # a handle stays that of the process when its number is another's
        self.file: IO[bytes] | None = None

    def begin(self) -> None:
        """Fork; without a process where the system has none to give."""
        with suppress(OSError), _no_signals():
            self.file = os.fdopen(os.memfd_create("results"), "w+b")
            parent = os.getpid()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # there are other threads, which the child has not
                self.pid = os.fork()
            if self.pid == 0:
                self._run(parent)
            self.handle = os.pidfd_open(self.pid)

    def _run(self, parent: int) -> None:
        """In the child, which ends here."""
        try:
            from steady_ppl.utils.tensor_files import packed

            ctypes.CDLL(None).prctl(DIE_WITH_PARENT, signal.SIGKILL)
            signal.set_wakeup_fd(-1)
            for ending in ENDING_SIGNALS:
                signal.signal(ending, signal.SIG_DFL)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING_SIGNALS)
            if self.file is not None and os.getppid() == parent:
                with one_core(), unheard():
                    for index in self.share:
                        tensors, values = self.computations[index]()
                        content = packed(tensors, {"values": json.dumps(values)})
                        self.file.write(len(content).to_bytes(8, "little") + content)
                self.file.write(END_MARK)
                self.file.flush()
        finally:
            os._exit(0)

    def results(self, patience: float) -> dict[int, Output]:
        """By their numbers, when it has ended; nothing if it failed, or does not end within so many seconds."""
        from steady_ppl.utils.tensor_files import unpacked

        if self.file is None or self.handle < 0 or not wait([self.handle], patience):
            return {}
        size = self.file.seek(0, os.SEEK_END)
        self.file.seek(max(0, size - len(END_MARK)))
        if self.file.read() != END_MARK:
            return {}
        self.file.seek(0)
        found: dict[int, Output] = {}
        for index in self.share:
            tensors, text = unpacked(self.file.read(int.from_bytes(self.file.read(8), "little")))
            found[index] = tensors, json.loads(text["values"])
        return found

    def end(self) -> None:
        """Stop it if it still runs."""
        if self.handle >= 0:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self.handle, signal.SIGKILL)
            os.close(self.handle)
        elif self.pid:
            os.kill(self.pid, signal.SIGKILL)
        if self.pid:
            with suppress(ChildProcessError):  # whoever else waits for processes had it
                os.waitpid(self.pid, 0)
        if self.file is not None:
            self.file.close()


@contextmanager
def _no_signals() -> Iterator[None]:
    """Keep signals until the block has ended: an interrupt in a child would unwind its parent's stack."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _processes(most: int) -> int:
    """How many to take, of so many at most."""
    return max(1, min(_most.get(), _cores(), most))


def _cores() -> int:
    """That this process may use, one where forks are not safe: another thread may hold a lock that a child would wait
    for, and a process of a pool has its core."""
    import torch
    from joblib.externals.loky import cpu_count

    if sys.platform != "linux" or not hasattr(os, "pidfd_open") or torch.cuda.is_initialized():
        return 1
    if threading.current_thread() is not threading.main_thread() or multiprocessing.parent_process() is not None:
        return 1
    return int(cpu_count())
