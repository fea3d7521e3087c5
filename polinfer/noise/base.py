"""What a description of the noise must offer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

if TYPE_CHECKING:
    from ..gain import Gain
    from ..records import Measurement
    from ..statistics import Statistics

__all__ = ["Noise"]


class Noise(ABC):
    """Complex Gaussian noise, ``E|noise|^2 = sigma^2 / weight`` in each component: what is known about sigma.

    ``integrated``: every pixel has an unknown sigma of its own, which is integrated out.
    """

    @property
    @abstractmethod
    def integrated(self) -> bool: ...

    @abstractmethod
    def sigma(self, measurement: Measurement) -> np.ndarray | None:
        """Standard deviation of every pixel, shape P, None where it is integrated out; ValueError if it is missing."""

    @abstractmethod
    def log_marginal(self, gain: Gain, seen: jax.Array, statistics: Statistics) -> jax.Array:
        """Log density of the data of a pixel, gain and noise integrated out where they are unknown.

        ``seen`` is ``J R``, complex ``(..., 2, 2)``, in the unit of the statistics.
        """

    @abstractmethod
    def precision(self, gain: Gain, seen: jax.Array, statistics: Statistics, fitted: Any) -> jax.Array:
        """Posterior mean of ``1 / sigma^2`` in the unit of the statistics, at parameters that were fitted.

        ``fitted`` is the number of real parameters that the data had to determine.
        """
