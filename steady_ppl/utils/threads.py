"""How many threads a computation takes: one, whatever the environment says.

The engine's tensors are small. Torch's threads wait for one another by spinning, so that on a busy machine two threads
took 20 to 55 times the CPU time of one, in filters of 20,000 to 500 particles a drive. On quiet cores two threads
brought a filter of 100,000 particles in plain torch from 3.5 s to 2.5 s, its kernels nothing, and smaller filters lost.
Where there are cores to use, processes take them, one thread each (`utils.cores`, `steady study`).
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

POOLS = ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMBA", "NUMEXPR")
ONE_THREAD = dict.fromkeys([*(f"{name}_NUM_THREADS" for name in POOLS), "VECLIB_MAXIMUM_THREADS"], "1")
"""Environment of a process whose libraries have one thread each; they read it as they load."""

_lock = threading.Lock()
_inside, _given = 0, 1  # how many blocks are on one thread, and how many threads there were before the first


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
