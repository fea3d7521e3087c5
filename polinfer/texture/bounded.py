"""The truncated Gaussian distribution of the values in a window."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import e, log, pi

import numpy as np

from ..checks import real_number
from .base import Distribution, Found, Wanted

__all__ = ["Bounded", "truncated_entropy"]

DEGREE = 32


@dataclass(frozen=True)
class Bounded(Distribution):
    r"""A Gaussian between two bounds, fitted to the mean m and variance v of the pixels.

    For this family that is the most probable fit: ``p(x) ~ e^{b x - c x^2}`` on ``[low, high]``, c >= 0, with the same
    mean and variance. Where the pixels vary more than the widest member with their mean, an exponential density
    (c = 0), it is that one. The expectation is m. The entropy is ``log(2 pi e v) / 2`` less what the bounds take away.
    On average it is too small by ``1 / n``, and ``1 / (n - 1)`` is added, as for :class:`Angle`.

    Parameters
    ----------
    low, high: finite, ``low < high``, else ValueError. -1 and 1, the range of D.

    Notes
    -----
    The mean square of the pixels' noise is subtracted from v.
    """

    low: float = -1.0
    high: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "low", real_number("low", self.low))
        object.__setattr__(self, "high", real_number("high", self.high))
        if not self.low < self.high:
            raise ValueError(f"low must be < high, got low {self.low:g} and high {self.high:g}; swap them.")

    def outside(self, values: np.ndarray) -> np.ndarray | None:
        return np.asarray((values < self.low) | (values > self.high))

    @property
    def allowed(self) -> str:
        return (
            f"from {self.low:g} to {self.high:g}; pass Bounded(low, high) with the bounds of the values, or mask them"
        )

    @property
    def _unit(self) -> float:
        return 0.5 * (self.high - self.low)

    def features(self, noisy: bool) -> int:
        return 4 if noisy else 3

    def load(self, values: np.ndarray, noise: np.ndarray | None, used: np.ndarray, out: np.ndarray) -> None:
        scaled = (values - 0.5 * (self.low + self.high)) / self._unit
        np.multiply(scaled, used, out=out[0])
        np.multiply(scaled, out[0], out=out[1])
        if noise is not None:
            np.multiply((noise / self._unit) ** 2, used, out=out[2])
        np.copyto(out[-1], used)

    def finish(self, sums: np.ndarray, spare: np.ndarray, noisy: bool, wanted: Wanted) -> Found:  # noqa: ARG002
        count = sums[-1]
        mean = sums[0] / count
        blurred = sums[2] / count if noisy else 0.0
        entropy = noise = None
        if wanted.entropy:
            seen = np.maximum(sums[1] / count - mean**2, 0)
            variance = np.maximum(seen - blurred, 0)
            entropy = truncated_entropy(mean, variance) + log(self._unit)
            ratio = seen / variance if noisy else 1.0
            entropy += np.minimum(0.5 * (ratio + ratio**2), 4.0) / (count - 1)
        if noisy:
            noise = 0.5 * np.log(2 * pi * e * blurred) + log(self._unit)
        expectation = mean * self._unit + 0.5 * (self.low + self.high) if wanted.expectation else None
        return Found(expectation, entropy, count, noise)


def truncated_entropy(mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Entropy in nats of the Gaussian truncated to [-1, 1] that has this mean and variance, element by element.

    Absolute error below 1e-4, mostly 4e-6. A variance above that of the exponential density with the same mean counts
    as that one; minus infinity where the variance is 0.
    """
    from numpy.polynomial.chebyshev import chebvander

    mean, variance = np.broadcast_arrays(np.asarray(mean, float), np.asarray(variance, float))
    widest = _exponential_variance(mean)
    share = np.minimum(variance / widest, 1.0)
    lost = np.zeros(mean.shape)
    # far from the bounds they take nothing away
    near = share > 0.01
    first = chebvander(2 * np.abs(mean[near]) - 1, DEGREE // 2)
    second = chebvander(2 * share[near] - 1, DEGREE)
    lost[near] = np.sum((first @ _loss()) * second, axis=-1)
    return 0.5 * np.log(2 * pi * e * share * widest) + lost


def _exponential_variance(mean: np.ndarray) -> np.ndarray:
    """Variance of the density ``~ e^{b x}`` on [-1, 1] with this mean.

    It is ``1/b^2 - 1/sinh(b)^2`` at ``coth b - 1/b = mean``.
    """
    m = np.abs(mean)
    b = m * (3 - m**2) / (1 - m**2)
    for _ in range(8):
        b = np.maximum(b, 1e-3)
        value = 1 / np.tanh(b) - 1 / b
        b = b - (value - m) / (1 / b**2 - 1 / np.sinh(np.minimum(b, 300)) ** 2)
    small = m < 0.003
    return np.where(small, 1 / 3 - 0.6 * m**2, 1 / b**2 - 1 / np.sinh(np.clip(b, 1e-3, 300)) ** 2)


@lru_cache
def _loss() -> np.ndarray:
    """Chebyshev coefficients of the entropy less that of the Gaussian with the same variance.

    Over the size of the mean, 0 to 1, and the share of the variance in that of the exponential density, 0 to 1.
    """
    from numpy.polynomial.chebyshev import chebpts1, chebvander

    means, shares = 0.5 * (1 + chebpts1(DEGREE // 2 + 1)), 0.5 * (1 + chebpts1(DEGREE + 1))
    mean, share = (x.ravel() for x in np.meshgrid(means, shares, indexing="ij"))
    width = np.sqrt(share * _exponential_variance(mean))
    # in units of the standard deviation, so that no place on the curve is special
    low, high = np.maximum(-(1 + mean) / width, -40), np.minimum((1 - mean) / width, 40)
    nodes, weights = np.polynomial.legendre.leggauss(240)
    y = 0.5 * (low + high)[:, None] + 0.5 * (high - low)[:, None] * nodes
    dy = 0.5 * (high - low)[:, None] * weights
    statistics = np.stack([y, y * y])
    target = np.stack([np.zeros_like(mean), np.ones_like(mean)])
    slopes = np.stack([np.zeros_like(mean), np.full_like(mean, -0.5)])

    def moments(slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        power = np.einsum("kp,kpn->pn", slopes, statistics)
        top = power.max(axis=1, keepdims=True)
        density = np.exp(power - top) * dy
        total = density.sum(axis=1)
        return np.log(total) + top[:, 0], density / total[:, None]

    # a convex function of the slopes: log of the normaliser less slopes times target
    for _ in range(60):
        level, density = moments(slopes)
        found = np.einsum("pn,kpn->kp", density, statistics)
        covariance = np.einsum("pn,kpn,lpn->pkl", density, statistics, statistics)
        covariance -= np.einsum("kp,lp->pkl", found, found)
        step = np.linalg.solve(covariance, (target - found).T[..., None])[..., 0].T
        size = np.ones_like(mean)
        height = level - np.sum(slopes * target, axis=0)
        for _ in range(20):
            trial = slopes + size * step
            worse = moments(trial)[0] - np.sum(trial * target, axis=0) > height + 1e-13
            if not worse.any():
                break
            size[worse] *= 0.5
        slopes = slopes + size * step
        if np.abs(size * step).max() < 1e-10:
            break
    entropy = moments(slopes)[0] - np.sum(slopes * target, axis=0)
    loss = (entropy - 0.5 * log(2 * pi * e)).reshape(len(means), len(shares))
    first, second = chebvander(2 * means - 1, DEGREE // 2), chebvander(2 * shares - 1, DEGREE)
    return np.linalg.solve(first, np.linalg.solve(second, loss.T).T)
