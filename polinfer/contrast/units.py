"""The pixels of two regions, and the units that differ from each other at random: samples, tiles or pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import boolean_array, broadcast, integer, real_array

__all__ = ["Regions", "gather", "tiles"]

# Pixels that are taken as independent are dealt at random into so many groups a region: groups of independent pixels
# are as independent, and sixty units are enough to learn how much they differ.
GROUPS = 30


@dataclass(frozen=True)
class Regions:
    """values, units: of the pixels of the first and of the second region, each (pixels,); count: of units; left_out:
    pixels with NaN; independent: whether the units are groups of independent pixels."""

    values: tuple[np.ndarray, np.ndarray]
    units: tuple[np.ndarray, np.ndarray]
    count: int
    left_out: int
    independent: bool

    @property
    def pixels(self) -> tuple[int, int]:
        """Of each region."""
        return self.values[0].size, self.values[1].size

    @property
    def held(self) -> np.ndarray:
        """Which units hold pixels of which region, bool (count, 2)."""
        return np.stack([np.bincount(u, minlength=self.count) > 0 for u in self.units], axis=1)


def _labels(name: str, value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "iu":
        raise TypeError(f"{name} must be integers, got {array.dtype}; convert them.")
    return array


def gather(
    values: Any,
    labels: Any,
    regions: tuple[int, int],
    samples: Any,
    mask: Any,
    generator: np.random.Generator,
) -> Regions:
    """The pixels of two regions with the units that they belong to; NaN is left out and counted."""
    array, regional = real_array("values", values).astype(np.float64), _labels("labels", labels)
    shapes = {"values": array.shape, "labels": regional.shape}
    given = None if samples is None else _labels("samples", samples)
    used = np.bool_(True) if mask is None else boolean_array("mask", mask)
    shapes |= {"mask": np.shape(used)} | ({} if given is None else {"samples": given.shape})
    shape = broadcast(**shapes)
    array, regional, used = (np.broadcast_to(x, shape) for x in (array, regional, used))
    if np.isinf(array).any():
        raise ValueError("values must be finite or NaN (no answer), got an infinite one; mask or mend it.")
    first, second = (integer("regions", r) for r in regions)
    if first == second:
        raise ValueError(f"regions must be two different labels, got {first} twice.")
    known = ~np.isnan(array)
    chosen = [used & (regional == region) for region in (first, second)]
    picked = [array[c & known] for c in chosen]
    for region, x in zip((first, second), picked, strict=True):
        if x.size == 0:
            raise ValueError(f"labels has no pixel of region {region} with a value; there is nothing to compare.")
    left_out = int(sum(np.count_nonzero(c & ~known) for c in chosen))
    if given is not None:
        owner = np.broadcast_to(given, shape)
        names, index = np.unique(np.concatenate([owner[c & known] for c in chosen]), return_inverse=True)
        units = (index[: picked[0].size], index[picked[0].size :])
        return Regions((picked[0], picked[1]), units, names.size, left_out, False)
    counts = [min(GROUPS, x.size) for x in picked]
    dealt = [generator.permutation(np.arange(x.size) % n) for x, n in zip(picked, counts, strict=True)]
    return Regions((picked[0], picked[1]), (dealt[0], dealt[1] + counts[0]), sum(counts), left_out, True)


def tiles(shape: tuple[int, ...], size: int) -> np.ndarray:
    """Numbers of square tiles of ``size`` x ``size`` pixels, integers (..., y, x), for ``samples`` of a single image.

    Neighbouring pixels are alike, so they are not independent; tiles several correlation lengths (of filtered maps:
    windows) wide nearly are. Every frame of a series has tiles of its own. Tiles at the ends may be smaller.

    Raises
    ------
    TypeError, ValueError: a size below 1, fewer than two axes.

    >>> tiles((3, 4), 2).tolist()
    [[0, 0, 1, 1], [0, 0, 1, 1], [2, 2, 3, 3]]
    """
    size = integer("size", size, low=1)
    lengths = tuple(integer("shape", n, low=1) for n in shape)
    if len(lengths) < 2:
        raise ValueError(f"shape must have at least the axes (y, x), got {lengths}.")
    *lead, rows, columns = lengths
    down, along = -(-rows // size), -(-columns // size)
    frames = np.arange(int(np.prod(lead))).reshape(*lead, 1, 1)
    return frames * (down * along) + (np.arange(rows)[:, None] // size) * along + np.arange(columns) // size
