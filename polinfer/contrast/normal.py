"""Contrast-to-noise ratio from sums over units."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np

from .bootstrap import Estimates, jackknife, symmetric_interval
from .units import Regions

__all__ = ["Ratio"]


class Ratio:
    """Signed contrast-to-noise ratio as a function of the weights of units.

    Linear: (mean_2 - mean_1) / sqrt(s_1^2 + s_2^2). Circular: difference of mean directions over circular standard
    deviations ``s = sqrt(-2 log R)``, R the mean resultant length, which is the same number for wrapped normal values.
    Its scale is ``sqrt(2) arsinh(c / sqrt(2))``: for independent normal values the variance of an estimate of c grows
    as 1 + c^2/2, that of the scaled one does not.
    """

    def __init__(self, regions: Regions, period: float | None) -> None:
        self.period, self.middle = period, 0.0
        self.freedom = int(regions.held.sum(axis=0).min()) - 1
        features = []
        for values, units in zip(regions.values, regions.units, strict=True):
            if period is None:
                # moments about a common value lose no digits
                shifted = values - regions.values[0].mean()
                columns = (np.ones(values.size), shifted, shifted**2)
            else:
                angle = 2 * pi * values / period
                columns = (np.ones(values.size), np.cos(angle), np.sin(angle))
            features.append(np.stack([np.bincount(units, c, regions.count) for c in columns], axis=-1))
        self.sums = np.stack(features, axis=1)  # (unit, region, 3)
        if period is not None:
            self.middle = float(self._difference(self.sums.sum(axis=0)))

    def _difference(self, sums: np.ndarray) -> np.ndarray:
        """Of mean directions, radians, within half a turn of that of all pixels."""
        mean = np.arctan2(sums[..., 2], sums[..., 1])
        apart = mean[..., 1] - mean[..., 0] - self.middle
        return self.middle + apart - 2 * pi * np.ceil(apart / (2 * pi) - 0.5)

    def ratio(self, sums: np.ndarray) -> np.ndarray:
        """Of sums (..., region, 3)."""
        count, first, second = np.moveaxis(sums, -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.period is None:
                mean = first / count
                variance = np.maximum(second / count - mean**2, 0.0)
                difference = mean[..., 1] - mean[..., 0]
            else:
                variance = -2 * np.log(np.minimum(np.hypot(first, second) / count, 1.0))
                difference = self._difference(sums)
            return np.asarray(difference / np.sqrt(variance.sum(axis=-1)))

    @property
    def value(self) -> float:
        """Of all units."""
        return float(self.ratio(self.sums.sum(axis=0)))

    def __call__(self, weights: np.ndarray) -> Estimates:
        total = np.tensordot(weights, self.sums, axes=1)
        whole = self.scale(self.ratio(total))
        without = self.scale(self.ratio(total[:, None] - self.sums))
        centre, error = jackknife(whole, without, weights)
        # a target that is not freed of its bias would be as good in theory; this one holds more truths at large ratios
        return Estimates(centre, error, centre)

    @staticmethod
    def scale(ratio: np.ndarray) -> np.ndarray:
        """To the scale of the interval."""
        return np.asarray(sqrt(2) * np.arcsinh(ratio / sqrt(2)))

    def ends(self, weights: np.ndarray, level: float) -> tuple[float, float]:
        """Interval of the modulus, from resampled weights (B, K)."""
        low, high = (
            float(sqrt(2) * np.sinh(x / sqrt(2))) for x in symmetric_interval(self, weights, level, self.freedom)
        )
        if low <= 0 <= high:
            low, high = 0.0, max(-low, high)
        elif high < 0:
            low, high = -high, -low
        if self.period is not None and self.middle:
            # half a turn is the farthest that directions can be apart; what is beyond is on its way back
            farthest = abs(self.value) * pi / abs(self.middle)
            low, high = max(min(low, 2 * farthest - high), 0.0), min(high, max(farthest, low))
        return low, high
