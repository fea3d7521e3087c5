"""Generalised contrast-to-noise ratio: one minus the overlap of two densities."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.special import betaincinv, ndtr, ndtri

from .bootstrap import Estimates, jackknife, symmetric_interval
from .units import Regions

__all__ = ["Overlap"]

BINS = 32
WIDTH = 1.5  # of the smoothing, bins
FEW = 2.0  # independent errors, below which their share is far from a normal variable
HIGHEST = 0.9998  # beyond it the scale is cut off


class Overlap:
    """gCNR as a function of the weights of units.

    The values are counted in bins, each of which holds as much of the mean of both densities as any other: gCNR does
    not change if the values are stretched, and neither do these. Resubstituted: a bin belongs to the region that is
    denser there, as seen in the smoothed counts, and ``g = sum over bins of +-(p_1 - p_2) / 2``: too large, as the same
    counts decide and are counted, even where the regions are alike. Crossed: each unit is counted in bins that were
    dealt out by all the other units: too small, as these know less. The two errors are about as large, and their mean
    is the estimate. Its scale is that of the distance of two normal densities, ``2 Phi^-1((1 + g) / 2)``.

    Where hardly any pixel is decided wrongly, a bootstrap sees too little of what might happen, and the low end is that
    of the shares of errors, with as many independent pixels as the likeness of those of a unit leaves (after E. L. Korn
    and B. I. Graubard, Survey Methodology 24, 193 (1998)).
    """

    def __init__(self, regions: Regions, period: float | None) -> None:
        self.regions = regions
        first, second = regions.values
        # an even number, so that separate regions of equal weight share no bin
        bins = 2 * int(np.clip(min(first.size, second.size) // 8, 1, BINS // 2))
        if period is not None:
            first, second = (x - period * np.floor(x / period) for x in (first, second))
        both = np.concatenate([first, second])
        share = np.concatenate([np.full(x.size, 0.5 / x.size) for x in (first, second)])
        order = np.argsort(both, kind="stable")
        # the last value of each bin; rounding must not move it by one
        edges = both[order][np.searchsorted(np.cumsum(share[order]), np.arange(1, bins) / bins - 1e-9)]
        counts = []
        for values, units in zip((first, second), regions.units, strict=True):
            index = units * bins + np.searchsorted(edges, values, side="left")
            counts.append(np.bincount(index, minlength=regions.count * bins).reshape(regions.count, bins))
        self.counts = np.stack(counts, axis=1).astype(float)  # (unit, region, bin)
        # either way of closing the ends keeps the sums
        self.smoothed = gaussian_filter1d(
            self.counts, WIDTH * bins / BINS, axis=-1, mode="reflect" if period is None else "wrap"
        )

    @staticmethod
    def _excess(counts: np.ndarray) -> np.ndarray:
        """p_1 - p_2 in each bin, of counts (..., region, bin)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            density = counts / counts.sum(axis=-1, keepdims=True)
        return np.asarray(density[..., 0, :] - density[..., 1, :])

    def both(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Resubstituted and crossed g (B,); and half the area between the smoothed densities, of all (B,) and without a
        copy of each unit (B, K)."""
        total, blurred = (np.tensordot(weights, x, axes=1) for x in (self.counts, self.smoothed))
        smoothed = self._excess(blurred)
        again = 0.5 * (np.sign(smoothed) * self._excess(total)).sum(axis=-1)
        others = self._excess(blurred[:, None] - self.smoothed)  # (B, unit, bin)
        pixels, decision = total.sum(axis=-1), np.sign(others)
        first, second = (
            np.einsum("km,bkm->bk", self.counts[:, r], decision) / pixels[:, r, None] for r in (0, 1)
        )  # fmt: skip
        crossed = 0.5 * (weights * np.where(weights > 0, first - second, 0.0)).sum(axis=1)
        return again, crossed, 0.5 * np.abs(smoothed).sum(axis=-1), 0.5 * np.abs(others).sum(axis=-1)

    @property
    def value(self) -> float:
        """Of all units; resubstituted where a region lies in a single one, which no others can judge."""
        again, crossed, *_ = self.both(np.ones((1, self.regions.count)))
        middle = 0.5 * (again[0] + crossed[0])
        return float(np.clip(again[0] if np.isnan(middle) else middle, 0.0, 1.0))

    def __call__(self, weights: np.ndarray) -> Estimates:
        again, crossed, area, without = self.both(weights)
        # the area varies smoothly where a unit is left out, the decisions do not
        _, error = jackknife(self.scale(area), self.scale(without), weights)
        own = self.scale(again)
        return Estimates(0.5 * (own + self.scale(crossed)), error, own)

    @staticmethod
    def scale(overlap: np.ndarray) -> np.ndarray:
        """To the scale of the interval."""
        return np.asarray(2 * ndtri(0.5 * (1 + np.clip(overlap, -HIGHEST, HIGHEST))))

    def ends(self, weights: np.ndarray, level: float) -> tuple[float, float]:
        """Interval from resampled weights (B, K)."""
        _, _, area, _ = self.both(np.ones((1, self.regions.count)))
        freedom = int(self.regions.held.sum(axis=0).min()) - 1
        low, high = (float(2 * ndtr(0.5 * x) - 1) for x in symmetric_interval(self, weights, level, freedom))
        if area[0] <= self.by_chance(weights, level):
            low = 0.0
        numbers, errors = self.effective_pixels(), self.errors()
        if np.any(numbers * errors < FEW):
            # Clopper and Pearson's bounds, each at the level at which the sum of two equal normal shares has its own
            one = ndtr(ndtri(0.5 * (1 + level)) / np.sqrt(2))
            most = betaincinv(numbers * errors + 1, np.maximum(numbers * (1 - errors), 1e-9), one)
            low = float(np.fmin(low, 1 - most.sum()))
            high = high if errors.any() else 1.0
        # a high end beyond the cut of the scale may be anything up to 1
        return max(low, 0.0), 1.0 if high >= HIGHEST else max(high, 0.0)

    def by_chance(self, weights: np.ndarray, level: float) -> float:
        """What half the area stays below with probability ``level`` where the densities are the same."""
        own = self._excess(self.smoothed.sum(axis=0))
        area = 0.5 * np.abs(self._excess(np.tensordot(weights, self.smoothed, axes=1)) - own).sum(axis=-1)
        units = int(self.regions.held.sum(axis=0).min())
        return float(np.quantile(area, level)) * np.sqrt(units / (units - 1))  # resamples vary less than samples

    def errors(self) -> np.ndarray:
        """Share of each region's pixels that the other units decide wrongly."""
        decision = np.sign(self._excess(self.smoothed.sum(axis=0) - self.smoothed))
        signs = np.array([1, -1])[:, None]
        wrong = 0.5 * self.counts * (1 - signs * decision[:, None])
        return np.asarray(wrong.sum(axis=(0, 2)) / self.regions.pixels)

    def effective_pixels(self) -> np.ndarray:
        """As how many independent pixels those of each region count: ``n / (1 + (m - 1) c)``, between units and pixels.

        c is the correlation of two pixels of the same unit (of the places of their bins, by analysis of variance), and
        m the pixels of a unit. Errors themselves, if they are rare, tell too little of how they are grouped.
        """
        pixels, units = np.array(self.regions.pixels, float), self.regions.held.sum(axis=0)
        if self.regions.independent:
            return pixels
        size = self.counts.sum(axis=-1)  # (unit, region)
        place = np.arange(self.counts.shape[-1])
        first, second = self.counts @ place, self.counts @ place**2
        with np.errstate(divide="ignore", invalid="ignore"):
            own = np.where(size > 0, first**2 / size, 0.0)
            within = (second - own).sum(axis=0) / (pixels - units)
            between = (own.sum(axis=0) - first.sum(axis=0) ** 2 / pixels) / (units - 1)
            typical = (pixels - (size**2).sum(axis=0) / pixels) / (units - 1)
            correlation = (between - within) / (between + (typical - 1) * within)
            numbers = pixels / (1 + (typical - 1) * correlation)
        return np.asarray(np.clip(np.nan_to_num(numbers, nan=0.0), units, pixels))
