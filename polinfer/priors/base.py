"""What a prior must offer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import jax
import numpy as np

__all__ = ["Prior"]


class Prior(ABC):
    """Density of one parameter. A new prior is one frozen dataclass of plain numbers that fills in these three.

    Plain numbers make it hashable, so that a compiled fit is used again, and storable.

    >>> import dataclasses, jax.numpy as jnp
    >>> @dataclasses.dataclass(frozen=True)
    ... class Triangle(Prior):
    ...     high: float
    ...     def log_density(self, x):
    ...         return jnp.where((x >= 0) & (x <= self.high), jnp.log(2 * x / self.high**2), -jnp.inf)
    ...     def sample(self, rng, shape):
    ...         return self.high * np.sqrt(rng.uniform(size=shape))
    ...     @property
    ...     def support(self):
    ...         return 0.0, self.high
    >>> round(float(Triangle(2.0).log_density(1.0)), 4)
    -0.6931
    """

    @abstractmethod
    def log_density(self, x: Any) -> jax.Array:
        """Normalised log density at ``x`` (any shape, radians for angles), written with ``jax.numpy``."""

    @abstractmethod
    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Independent draws of the given shape."""

    @property
    @abstractmethod
    def support(self) -> tuple[float, float]:
        """Lowest and highest value. One full period of an angle means that there is no edge."""
