"""Independent pieces of work on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

from .precision import double_precision, is_double

__all__ = ["each"]

MOST_THREADS = 8


def each(work: Callable[[int], None], items: Iterable[int]) -> None:
    """``work(item)`` for every item, in any order; compiled code and large NumPy operations release the lock.

    The first exception that a piece raises is raised. JAX's precision is that of the caller.
    """
    items = list(items)
    cores = os.cpu_count() or 1
    if len(items) == 1 or cores == 1:
        for item in items:
            work(item)
        return
    double = is_double()

    def alike(item: int) -> None:
        with double_precision(double):
            work(item)

    with ThreadPoolExecutor(min(cores, MOST_THREADS)) as pool:
        list(pool.map(alike, items))
