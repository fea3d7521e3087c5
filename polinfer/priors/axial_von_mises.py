"""The von Mises distribution of an axis, whose angle has period pi."""

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

__all__ = ["AxialVonMises"]


@dataclass(frozen=True)
class AxialVonMises(Prior):
    """Angle of an axis, period pi: ``p(x) = e^{k cos 2(x - m)} / (pi I_0(k))``.

    The doubled angle is von Mises distributed. ``concentration`` k = 0 is uniform; large k is a Gaussian of standard
    deviation ``1/(2 sqrt(k))``. The density is periodic: ``x`` may lie in any period.

    Parameters
    ----------
    mean: m in radians. concentration: k >= 0, without unit. Both one finite number, else ValueError.

    >>> round(float(AxialVonMises(0.0, 0.0).log_density(1.0)), 4)
    -1.1447
    """

    mean: float
    concentration: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "mean", real_number("mean", self.mean))
        object.__setattr__(self, "concentration", real_number("concentration", self.concentration, low=0))

    def log_density(self, x: Any) -> jax.Array:
        shifted = -2 * jnp.sin(jnp.asarray(x) - self.mean) ** 2
        return self.concentration * shifted + self.log_peak

    @property
    def log_peak(self) -> float:
        """Log density at the mean."""
        return -log(pi) - log(i0e(self.concentration))

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        angle = 0.5 * np.asarray(rng.vonmises(0.0, self.concentration, shape)) + self.mean
        return angle - pi * np.ceil(angle / pi - 0.5)

    @property
    def support(self) -> tuple[float, float]:
        return -0.5 * pi, 0.5 * pi
