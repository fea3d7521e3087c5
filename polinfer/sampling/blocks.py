"""Pixels a few at a time, so that copies of their draws fit into the cache and the memory."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

__all__ = ["blocks", "flat", "rows"]

VALUES = 1 << 19  # numbers in a block: few calls, and temporary arrays of a few megabytes


def flat(values: np.ndarray) -> np.ndarray:
    """Draws ``(chain, draw, *P)`` with one pixel axis, ``(chain, draw, pixel)``."""
    values = np.asarray(values)
    return values.reshape(*values.shape[:2], int(np.prod(values.shape[2:])))


def rows(values: np.ndarray, pixels: np.ndarray, double: bool = True) -> np.ndarray:
    """Draws ``(chain, draw, pixel)`` of some pixels, ``(pixels, chain, draw)``, in double or their own precision."""
    first, last = pixels[0], pixels[-1]
    part = values[..., first : last + 1] if last - first + 1 == len(pixels) else values[..., pixels]
    kind = (np.complex128 if values.dtype.kind == "c" else np.float64) if double else values.dtype
    return np.ascontiguousarray(np.moveaxis(part, -1, 0), dtype=kind)


def blocks(pixels: np.ndarray, draws: int) -> Iterator[np.ndarray]:
    """The pixels, flat indices in ascending order, in parts whose draws are about ``VALUES`` numbers."""
    size = max(VALUES // max(draws, 1), 1)
    for begin in range(0, len(pixels), size):
        yield pixels[begin : begin + size]
