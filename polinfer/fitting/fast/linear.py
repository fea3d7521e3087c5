"""Symmetric systems of at most five unknowns, written out: every entry is an array of pixels.

Every entry ends in a division. XLA computes a cheap expression anew for each of its uses, and a chain of substitutions
would grow exponentially; it keeps the result of a division.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

__all__ = ["Triangle", "factorise", "inverse", "solve"]

Triangle = dict[tuple[int, int], Any]


def factorise(a: Triangle, n: int, floor: float | None = None) -> tuple[Triangle, Any]:
    """``a = L L^T`` from the upper triangle of ``a``: the lower triangle L, and the smallest pivot.

    With a ``floor`` pivots are made positive and at least that large, so that a solution is a way uphill.
    """
    lower: Triangle = {}
    smallest: Any = None
    for j in range(n):
        pivot = a[j, j] - sum((lower[j, k] * lower[j, k] for k in range(j)), start=0.0)
        smallest = pivot if smallest is None else jnp.minimum(smallest, pivot)
        lower[j, j] = jnp.sqrt(pivot if floor is None else jnp.maximum(jnp.abs(pivot), floor))
        for i in range(j + 1, n):
            rest = a[j, i] - sum((lower[i, k] * lower[j, k] for k in range(j)), start=0.0)
            lower[i, j] = rest / lower[j, j]
    return lower, smallest


def solve(lower: Triangle, b: list[Any]) -> tuple[list[Any], Any]:
    """``x`` with ``L L^T x = b``, and ``b^T x``."""
    n = len(b)
    y: list[Any] = []
    for i in range(n):
        y.append((b[i] - sum((lower[i, k] * y[k] for k in range(i)), start=0.0)) / lower[i, i])
    x: list[Any] = [None] * n
    for i in reversed(range(n)):
        x[i] = (y[i] - sum((lower[k, i] * x[k] for k in range(i + 1, n)), start=0.0)) / lower[i, i]
    return x, sum(part * part for part in y)


def inverse(lower: Triangle, n: int) -> Triangle:
    """Upper triangle of the inverse of ``L L^T``."""
    left: Triangle = {}
    for j in range(n):
        left[j, j] = 1 / lower[j, j]
        for i in range(j + 1, n):
            left[i, j] = -sum(lower[i, k] * left[k, j] for k in range(j, i)) / lower[i, i]
    return {(i, j): sum(left[k, i] * left[k, j] for k in range(j, n)) for i in range(n) for j in range(i, n)}
