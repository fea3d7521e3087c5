"""Independent pieces of work on all cores, and how large a piece is."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax

from .precision import double_precision, is_double

__all__ = ["each", "piece"]

MOST_THREADS = 8


def _default_device() -> Any:
    return jax.config.jax_default_device  # type: ignore[attr-defined]


def piece(processor: int, accelerator: int) -> int:
    """Pixels of a piece: what a core's cache holds, or what fills the accelerator on which JAX computes here."""
    chosen = _default_device()
    platform = jax.default_backend() if chosen is None else getattr(chosen, "platform", chosen)
    return processor if platform == "cpu" else accelerator


def each(work: Callable[[int], None], items: Iterable[int]) -> None:
    """``work(item)`` for every item, in any order; compiled code and large NumPy operations release the lock.

    The first exception that a piece raises is raised. JAX's precision and default device are those of the caller.
    """
    items = list(items)
    cores = os.cpu_count() or 1
    if len(items) == 1 or cores == 1:
        for item in items:
            work(item)
        return
    double, device = is_double(), _default_device()

    def alike(item: int) -> None:
        with double_precision(double), jax.default_device(device):
            work(item)

    with ThreadPoolExecutor(min(cores, MOST_THREADS)) as pool:
        list(pool.map(alike, items))
