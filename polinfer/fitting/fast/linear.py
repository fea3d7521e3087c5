"""Symmetric systems of at most five unknowns, written out: every entry is an array of pixels.

Every entry ends in a division. XLA computes a cheap expression anew for each of its uses, and a chain of substitutions
would grow exponentially; it keeps the result of a division.
"""

from __future__ import annotations

from functools import reduce
from typing import Any, NamedTuple

import jax.numpy as jnp

__all__ = ["Factor", "Triangle", "factorise", "inverse", "solve"]

Triangle = dict[tuple[int, int], Any]


class Factor(NamedTuple):
    """The lower triangle L, and the pivots."""

    lower: Triangle
    pivots: list[Any]

    @property
    def smallest(self) -> Any:
        """The smallest pivot."""
        return reduce(jnp.minimum, self.pivots)


def factorise(a: Triangle, n: int, floor: float | None = None, begun: Factor | None = None, first: int = 0) -> Factor:
    """``a = L L^T`` from the upper triangle of ``a``.

    With a ``floor`` pivots are made positive and at least that large, so that a solution is a way uphill. ``begun`` is
    the factor of a matrix that differs from ``a`` from the column ``first`` on only.
    """
    lower: Triangle = {} if begun is None else {(i, j): x for (i, j), x in begun.lower.items() if j < first}
    pivots = [] if begun is None else begun.pivots[:first]
    for j in range(first, n):
        pivot = a[j, j] - sum((lower[j, k] * lower[j, k] for k in range(j)), start=0.0)
        pivots.append(pivot)
        lower[j, j] = jnp.sqrt(pivot if floor is None else jnp.maximum(jnp.abs(pivot), floor))
        for i in range(j + 1, n):
            rest = a[j, i] - sum((lower[i, k] * lower[j, k] for k in range(j)), start=0.0)
            lower[i, j] = rest / lower[j, j]
    return Factor(lower, pivots)


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
