"""The uniform distribution of an angle."""

from __future__ import annotations

from dataclasses import dataclass
from math import log, pi
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..checks import real_number
from .base import Prior

__all__ = ["UniformAngle"]


@dataclass(frozen=True)
class UniformAngle(Prior):
    """Every angle is equally likely: ``p(x) = 1/period``, on ``(-period/2, period/2]`` and periodic.

    Parameters
    ----------
    period: radians, > 0 (pi for an axis, 2 pi for a direction or a phase), else ValueError.

    >>> round(float(UniformAngle(2.0).log_density(0.3)), 4)
    -0.6931
    """

    period: float = 2 * pi

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", real_number("period", self.period, above=0))

    def log_density(self, x: Any) -> jax.Array:
        x = jnp.asarray(x)
        return jnp.full(x.shape, -log(self.period), jnp.result_type(float, x))

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        return self.period * (0.5 - rng.uniform(size=shape))

    @property
    def support(self) -> tuple[float, float]:
        return -0.5 * self.period, 0.5 * self.period
