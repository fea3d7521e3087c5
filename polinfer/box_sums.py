"""Sums over windows whose cost hardly depends on the size of the window, and which keep their digits."""

from __future__ import annotations

import numpy as np

__all__ = ["run_sums"]


def run_sums(values: np.ndarray, length: int, step: int, spare: np.ndarray) -> np.ndarray:
    """``sum of values[i + j * step] for j < length`` at every i where all of these exist; values has one axis.

    Sums of 1, 2, 4, ... elements are made of each other and put together: ``2 log2(length)`` additions at most, each
    of whole arrays. Nothing is subtracted, so a sum is as exact as its own elements allow, whatever stands beside
    them; differences of running totals would lose digits to everything before.

    Parameters
    ----------
    values: any type that adds, shape (n,). length: odd, >= 1. step: >= 1, ``(length - 1) * step < n``.
    spare: shape (3, n) of the same type, overwritten. The result is the beginning of ``spare[0]``, or of ``values`` if
        length is 1.

    >>> run_sums(np.arange(8.0), 3, 2, np.empty((3, 8))).tolist()
    [6.0, 9.0, 12.0, 15.0]
    """
    size = len(values) - (length - 1) * step
    # total: sums as long as the lowest bits of length say; doubled: as long as the next power of two
    total, reach = values, 1
    doubled, power = values, 1
    here, there = spare[1], spare[2]
    while 2 * power <= length:
        left = len(doubled) - power * step
        doubled = np.add(doubled[:left], doubled[power * step :], out=here[:left])
        here, there = there, here
        power *= 2
        if length & power:
            left = len(doubled) - reach * step
            total = np.add(total[:left], doubled[reach * step :], out=spare[0][:left])
            reach += power
    return total[:size]
