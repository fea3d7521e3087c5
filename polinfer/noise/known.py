"""Noise that is known beforehand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..gain import Gain
from ..records import Measurement
from ..statistics import Statistics
from .base import Noise

__all__ = ["KnownNoise"]


@dataclass(frozen=True)
class KnownNoise(Noise):
    """The noise is the ``sigma`` of the measurement: complex Gaussian, ``E|noise|^2 = sigma^2`` per component.

    >>> KnownNoise().sigma(Measurement(np.eye(2), np.eye(2), sigma=0.5)).item()
    0.5
    """

    @property
    def integrated(self) -> bool:
        return False

    def sigma(self, measurement: Measurement) -> np.ndarray:
        """Standard deviation of every pixel, shape P; ValueError if the measurement does not know it."""
        if measurement.sigma is None:
            raise ValueError(
                "measurement has sigma None, but KnownNoise needs it; give Measurement a sigma, or the model "
                "noise=InferredNoise(shape, scale, scope)."
            )
        return np.broadcast_to(measurement.sigma, measurement.shape)

    def log_marginal(self, gain: Gain, seen: jax.Array, statistics: Statistics) -> jax.Array:
        return gain.log_marginal(seen, statistics.response) + statistics.constant

    def precision(self, gain: Gain, seen: jax.Array, statistics: Statistics, fitted: Any) -> jax.Array:  # noqa: ARG002
        return jnp.ones_like(statistics.residual)
