"""Sums of features of the pixels over a sliding window, strip by strip, on all cores."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod

import numpy as np

from ..box_sums import run_sums
from ..threads import MOST_THREADS, each

__all__ = ["Sweep", "sweep"]

# A strip with its buffers should stay in the cache, and its halo should cost little beside it.
STRIP_BYTES = 1 << 20
LEAST_ROWS = 32


class Sweep(ABC):
    """What to sum over the windows of a frame, and what to make of the sums."""

    features: int

    @abstractmethod
    def load(self, rows: slice, out: np.ndarray) -> None:
        """Write the features of these rows into ``out``, shape (features, rows, columns); 0 where there is no pixel."""

    @abstractmethod
    def finish(self, rows: slice, sums: np.ndarray, spare: np.ndarray) -> None:
        """Take the sums of the windows around these rows, shape (features, pixels), and keep what is made of them.

        The pixels are those of a strip that is wider than the frame: column x of row y is ``y * width + x``, of which
        the columns beyond the frame mean nothing. ``sums`` and ``spare``, shape (2 * features, pixels), may be
        overwritten.
        """


def sweep(job: Sweep, shape: tuple[int, int], size: int, dtype: np.dtype, strips: list[slice] | None = None) -> None:
    """Run ``job`` over a frame of ``shape``, windows of ``size`` (odd, >= 3) cut off at the edges.

    ``strips``: do these rows only; None: all. Cost a pixel: as :func:`polinfer.box_sums.run_sums`.
    """
    if strips is None:
        strips = cut(shape, size, job.features, dtype)
    lanes = min(len(strips), os.cpu_count() or 1, MOST_THREADS)
    tallest = max((strip.stop - strip.start for strip in strips), default=0)

    def lane(number: int) -> None:
        half, width = size // 2, shape[1] + size - 1
        # fresh memory for every operation would cost as much as the operation
        memory = np.empty(5 * job.features * (tallest + size - 1) * width, dtype)
        with np.errstate(all="ignore"):
            for strip in strips[number::lanes]:
                high = strip.stop - strip.start + size - 1
                used = memory[: 5 * job.features * high * width].reshape(5, -1)
                padded = used[0].reshape(job.features, high, width)
                padded[...] = 0
                first, last = max(strip.start - half, 0), min(strip.stop + half, shape[0])
                top = first - strip.start + half
                job.load(slice(first, last), padded[:, top : top + last - first, half : half + shape[1]])
                # one long line: what runs over the end of a row ends in the columns that nobody reads
                run_sums(used[0], size, width, used[1:4])
                run_sums(used[1], size, 1, used[2:5])
                pixels = (strip.stop - strip.start) * width
                sums = used[2].reshape(job.features, -1)[:, :pixels]
                spare = used[:2].reshape(2 * job.features, -1)[:, :pixels]
                job.finish(strip, sums, spare)

    each(lane, range(lanes))


def cut(shape: tuple[int, int], size: int, features: int, dtype: np.dtype) -> list[slice]:
    """Rows of the strips."""
    fitting = STRIP_BYTES // max(features * (shape[1] + size - 1) * np.dtype(dtype).itemsize, 1)
    rows = max(fitting - size + 1, LEAST_ROWS, 2 * size)
    return [slice(first, min(first + rows, shape[0])) for first in range(0, shape[0], rows)]
