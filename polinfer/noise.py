"""What is known about the noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .records import Measurement

__all__ = ["KnownNoise"]


@dataclass(frozen=True)
class KnownNoise:
    """The noise is the ``sigma`` of the measurement: complex Gaussian, ``E|noise|^2 = sigma^2`` per component.

    >>> KnownNoise().sigma(Measurement(np.eye(2), np.eye(2), sigma=0.5)).item()
    0.5
    """

    def sigma(self, measurement: Measurement) -> np.ndarray:
        """Standard deviation of every pixel, shape P; ValueError if the measurement does not know it."""
        if measurement.sigma is None:
            raise ValueError("measurement has sigma None, but KnownNoise needs it; give Measurement a sigma.")
        return np.broadcast_to(measurement.sigma, measurement.shape)
