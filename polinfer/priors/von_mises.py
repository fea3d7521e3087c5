"""The von Mises distribution of an angle."""

from __future__ import annotations

from dataclasses import dataclass
from math import log, pi
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import i0e

from ..checks import real_number
from .base import Prior

__all__ = ["VonMises"]


@dataclass(frozen=True)
class VonMises(Prior):
    """Angle with period 2 pi: ``p(x) = e^{k cos(x - m)} / (2 pi I_0(k))``.

    ``concentration`` k = 0 is uniform; large k is a Gaussian of standard deviation ``1/sqrt(k)``. The density is
    periodic: ``x`` may lie in any period.

    Parameters
    ----------
    mean: m in radians. concentration: k >= 0, without unit. Both one finite number, else ValueError.

    >>> round(float(VonMises(0.0, 0.0).log_density(1.0)), 4)
    -1.8379
    """

    mean: float
    concentration: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "mean", real_number("mean", self.mean))
        object.__setattr__(self, "concentration", real_number("concentration", self.concentration, low=0))

    def log_density(self, x: Any) -> jax.Array:
        # cos - 1 with the scaled Bessel function: no cancellation of large numbers at high concentration
        shifted = -2 * jnp.sin(0.5 * (jnp.asarray(x) - self.mean)) ** 2
        return self.concentration * shifted + self.log_peak

    @property
    def log_peak(self) -> float:
        """Log density at the mean."""
        return -log(2 * pi) - log(i0e(self.concentration))

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        angle = np.asarray(rng.vonmises(0.0, self.concentration, shape)) + self.mean
        return angle - 2 * pi * np.ceil(angle / (2 * pi) - 0.5)

    @property
    def support(self) -> tuple[float, float]:
        return -pi, pi
