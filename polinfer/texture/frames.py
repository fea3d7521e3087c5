"""One distribution in the sliding windows of frames: arguments in, maps out."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..checks import boolean_array, integer, real_array
from ..neighbours import plane
from .base import Distribution, Wanted
from .families import distribution_of
from .windows import Sweep, sweep

__all__ = ["broadcast_to", "check_range", "checked_size", "filtered"]


class _Frame(Sweep):
    """One frame: its pixels, and the maps that are filled."""

    def __init__(
        self,
        values: np.ndarray,
        noise: np.ndarray | None,
        used: np.ndarray | None,
        distribution: Distribution,
        fewest: int,
        maps: dict[str, np.ndarray],
    ) -> None:
        self.values, self.noise, self.used = values, noise, used
        self.distribution, self.fewest, self.maps = distribution, fewest, maps
        self.features = distribution.features(noise is not None)
        self.single = values.dtype == np.float32 and distribution.single and noise is None
        self.again: list[slice] = []

    def run(self, size: int) -> None:
        """Fill the maps."""
        shape = self.values.shape
        if self.single:
            sweep(self, shape, size, np.dtype(np.float32))
            self.single = False
            if self.again:
                sweep(self, shape, size, np.dtype(np.float64), self.again)
        else:
            sweep(self, shape, size, np.dtype(np.float64))

    def load(self, rows: slice, out: np.ndarray) -> None:
        values = self.values[rows]
        noise = None if self.noise is None else self.noise[rows]
        used = np.isfinite(values)
        if self.used is not None:
            used &= self.used[rows]
        if noise is not None:
            used &= np.isfinite(noise)
            noise = np.where(used, noise, 0).astype(out.dtype, copy=False)
        values = np.where(used, values, 0).astype(out.dtype, copy=False)
        self.distribution.load(values, noise, used, out)

    def finish(self, rows: slice, sums: np.ndarray, spare: np.ndarray) -> None:
        high, wide = rows.stop - rows.start, self.values.shape[1]
        wanted = Wanted("expectation" in self.maps, "entropy" in self.maps)
        found = self.distribution.finish(sums, spare, self.noise is not None, wanted)
        few = found.count.reshape(high, -1)[:, :wide] < self.fewest
        for name, target in self.maps.items():
            target[rows] = getattr(found, name).reshape(high, -1)[:, :wide]
            if name != "count":
                target[rows][few] = np.nan
        if self.single and wanted.entropy and np.any(self.maps["entropy"][rows] < self.distribution.single_floor):
            self.again.append(rows)


def filtered(
    names: tuple[str, ...], image: Any, size: int, distribution: Any, mask: Any, std: Any, fewest: int
) -> dict[str, np.ndarray]:
    """The maps of these names, after a check of the arguments."""
    values = real_array("image", image)
    family = distribution_of("distribution", distribution)
    size = checked_size(size)
    fewest = integer("fewest", fewest, low=3)
    used = None if mask is None else broadcast_to("mask", boolean_array("mask", mask), values.shape)
    noise = None if std is None else broadcast_to("std", real_array("std", std, low=0), values.shape)
    check_range("image", values, used, family)
    kept = values.dtype if values.dtype in (np.float32, np.float64) else np.dtype(np.float64)
    if noise is not None:
        names = (*names, "noise_entropy") if "count" in names else names
    maps = {name: np.empty(values.shape, kept) for name in names}
    for number in range(int(np.prod(values.shape[:-2]))):
        own = _frame(values, number)
        widths = None if noise is None else _frame(noise, number)
        inside = None if used is None else _frame(used, number)
        filled = {name: _frame(x, number) for name, x in maps.items()}
        _Frame(own, widths, inside, family, fewest, filled).run(size)
    return maps


def check_range(name: str, values: np.ndarray, used: np.ndarray | None, family: Distribution) -> None:
    """Raise ValueError if a pixel that counts lies where the distribution has none."""
    with np.errstate(invalid="ignore"):
        outside = family.outside(values)
    if outside is None:
        return
    if used is not None:
        outside = outside & used
    outside &= np.isfinite(values)
    if np.any(outside):
        raise ValueError(
            f"{name} has {int(outside.sum())} values, such as {float(values[outside][0]):g}, that are impossible for "
            f"{type(family).__name__}: they must be {family.allowed}."
        )


def _frame(values: np.ndarray, number: int) -> np.ndarray:
    """One of the frames that stand in the leading axes, a view."""
    rows, columns = plane(values.shape)
    return values.reshape(-1, rows, columns)[number]


def checked_size(size: int) -> int:
    """Side of a window: odd, from 3."""
    size = integer("size", size, low=3)
    if size % 2 == 0:
        raise ValueError(f"size must be odd, so that the window has a centre, got {size}.")
    return size


def broadcast_to(name: str, values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """``values`` with the shape of the image, or an error."""
    try:
        return np.broadcast_to(values, shape)
    except ValueError:
        raise ValueError(f"{name} has shape {values.shape}, which does not fit the image, {shape}.") from None
