"""Random streams keyed by what they are for, so that a resumed run draws what the uninterrupted one would have."""

import zlib
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch


@contextmanager
def seeded(*key: int | str) -> Iterator[None]:
    """Run a block under a torch generator keyed by, say, `(seed, "step", 17)`; the caller's are left as they were.

    Equal keys give equal draws. Zeros at the end do not tell keys apart: give every purpose its own name.
    """
    words = [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in key]
    with torch.random.fork_rng():
        torch.manual_seed(int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0] >> 1))
        yield
