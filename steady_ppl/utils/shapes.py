"""Shapes of tensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """The shape that all of these go together to. `torch.broadcast_shapes` loads sympy, half a second.

    Raises:
        RuntimeError: they do not go together.

    Example:
        >>> broadcast_shapes((3, 1), (2,))
        torch.Size([3, 2])
    """
    if not all(type(length) is int for shape in shapes for length in shape):  # what traces and exports pass on
        return torch.broadcast_shapes(*shapes)
    try:
        return torch.Size(np.broadcast_shapes(*map(tuple, shapes)))
    except ValueError as error:
        raise RuntimeError(str(error)) from None
