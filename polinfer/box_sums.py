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
    values: any type that adds, shape (n,). length: >= 1. step: >= 1, ``(length - 1) * step < n``.
    spare: shape (3, n) of the same type, overwritten. The result is the beginning of ``spare[0]`` for odd lengths from
        3, and a view of ``spare`` or ``values`` for others.

    >>> run_sums(np.arange(8.0), 3, 2, np.empty((3, 8))).tolist()
    [6.0, 9.0, 12.0, 15.0]
    """
    size = len(values) - (length - 1) * step
    # total holds the sums of the lowest bits of length, double those of the next power of two
    total, reach = (values, 1) if length & 1 else (None, 0)
    double, power = values, 1
    here, there = spare[1], spare[2]
    while 2 * power <= length:
        left = len(double) - power * step
        double = np.add(double[:left], double[power * step :], out=here[:left])
        here, there = there, here
        power *= 2
        if length & power:
            if total is None:
                total = double
            else:
                left = min(len(total), len(double) - reach * step)
                total = np.add(total[:left], double[reach * step : reach * step + left], out=spare[0][:left])
            reach += power
    assert total is not None
    return total[:size]
