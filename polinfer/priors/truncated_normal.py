"""The normal distribution between two bounds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import log, pi
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import log_ndtr

from ..checks import real_number
from .base import Prior

__all__ = ["TruncatedNormal"]


@dataclass(frozen=True)
class TruncatedNormal(Prior):
    """Normal density restricted to ``[low, high]`` and normalised there.

    ``p(x) = exp(-(x - mean)^2 / (2 scale^2)) / (scale sqrt(2 pi) (Phi(b) - Phi(a)))`` with ``a, b`` the bounds in
    units of ``scale`` from ``mean``; outside the bounds the density is 0.

    Parameters
    ----------
    mean: any finite number. scale: > 0. low, high: finite, ``low < high``. Else ValueError.

    >>> round(float(TruncatedNormal(0.0, 0.5, -1.0, 1.0).log_density(0.0)), 4)
    -0.1792
    >>> float(TruncatedNormal(0.0, 0.5, -1.0, 1.0).log_density(1.5))
    -inf
    """

    mean: float
    scale: float
    low: float
    high: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "mean", real_number("mean", self.mean))
        object.__setattr__(self, "scale", real_number("scale", self.scale, above=0))
        object.__setattr__(self, "low", real_number("low", self.low))
        object.__setattr__(self, "high", real_number("high", self.high))
        if not self.low < self.high:
            raise ValueError(f"low must be < high, got low {self.low:g} and high {self.high:g}; swap them.")

    @cached_property
    def log_peak(self) -> float:
        """Log density at the mean; where that lies outside the bounds, what it would be there."""
        a, b = (self.low - self.mean) / self.scale, (self.high - self.mean) / self.scale
        if a > 0:  # the lower tail keeps its digits far from the mean
            a, b = -b, -a
        log_mass = log_ndtr(b) + np.log1p(-np.exp(log_ndtr(a) - log_ndtr(b)))
        return -float(log_mass) - log(self.scale) - 0.5 * log(2 * pi)

    def log_density(self, x: Any) -> jax.Array:
        x = jnp.asarray(x, jnp.result_type(float, x))
        inside = (x >= self.low) & (x <= self.high)
        return jnp.where(inside, -0.5 * ((x - self.mean) / self.scale) ** 2 + self.log_peak, -jnp.inf)

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        from scipy.stats import truncnorm  # slow to import

        a, b = (self.low - self.mean) / self.scale, (self.high - self.mean) / self.scale
        return np.asarray(truncnorm.rvs(a, b, self.mean, self.scale, size=shape, random_state=rng))

    @property
    def support(self) -> tuple[float, float]:
        return self.low, self.high
