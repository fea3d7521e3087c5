"""Noise whose size is unknown."""

from __future__ import annotations

from dataclasses import dataclass
from math import log
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..checks import real_number
from ..gain import Gain
from ..power_means import log_gamma_ratio
from ..records import Measurement
from ..statistics import Statistics
from .base import Noise

__all__ = ["InferredNoise"]

SCOPES = ("pixel", "frame")


@dataclass(frozen=True)
class InferredNoise(Noise):
    """sigma is unknown, with an inverse gamma prior on sigma^2; the measurement must have ``sigma=None``.

    ``p(sigma^2) = scale^shape / Gamma(shape) (sigma^2)^(-shape - 1) exp(-scale / sigma^2)``: the prior expects
    ``1 / sigma^2`` to be ``shape / scale``, and weighs as much as 2 ``shape`` real data. Weights of the states apply.

    With scope ``"pixel"`` every pixel has a sigma of its own, which is integrated out: with the squared residual
    ``Q(g) = |g J U - V|^2`` of N complex data the likelihood is the mean over the gain of
    ``Gamma(shape + N) / (Gamma(shape) pi^N) scale^shape / (scale + Q(g))^(shape + N)``.

    With scope ``"frame"`` all pixels have the same sigma. It is no number of a pixel, so ``fit`` finds the most
    probable one and describes every pixel given this one; ``Model.log_likelihood`` and ``log_posterior`` are those of
    a given sigma and need ``measurement.sigma``, for instance the ``sigma`` of a :class:`polinfer.Fit`.

    Parameters
    ----------
    shape: > 0, without unit. scale: > 0, square of the unit of the response. scope: "pixel" or "frame".

    Raises
    ------
    ValueError: values out of range, another scope.

    >>> InferredNoise(2.0, 0.01, "pixel").scale
    0.01
    """

    shape: float
    scale: float
    scope: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "shape", real_number("shape", self.shape, above=0))
        object.__setattr__(self, "scale", real_number("scale", self.scale, above=0))
        if self.scope not in SCOPES:
            raise ValueError(f'scope must be "pixel" or "frame", got {self.scope!r}.')

    @property
    def integrated(self) -> bool:
        return self.scope == "pixel"

    def sigma(self, measurement: Measurement) -> np.ndarray | None:
        """None for scope "pixel", the given sigma for scope "frame"; ValueError if one is given or missing."""
        if self.integrated:
            self.refuse(measurement)
            return None
        if measurement.sigma is None:
            raise ValueError(
                "measurement has sigma None, but with InferredNoise of scope 'frame' the density of one pixel is that "
                "at a given sigma; give Measurement the sigma of a fit, or use scope 'pixel'."
            )
        return np.broadcast_to(measurement.sigma, measurement.shape)

    def refuse(self, measurement: Measurement) -> None:
        """ValueError if the measurement has the sigma that is to be inferred."""
        if measurement.sigma is not None:
            raise ValueError(
                "measurement has a sigma, but InferredNoise infers it; pass sigma=None (dataclasses.replace does it), "
                "or use KnownNoise()."
            )

    def log_marginal(self, gain: Gain, seen: jax.Array, statistics: Statistics) -> jax.Array:
        if not self.integrated:
            return gain.log_marginal(seen, statistics.response) + statistics.constant
        # a pixel without data has no gain to integrate over either
        dark = statistics.count == 0
        power = jnp.where(dark, jnp.ones_like(statistics.count), statistics.count) + self.shape
        mean = self._log_power_mean(gain, seen, statistics, power)
        prior = log_gamma_ratio(self.shape, statistics.count) - statistics.count * log(self.scale)
        return jnp.where(dark, jnp.zeros_like(mean), mean + prior) + statistics.constant

    def precision(self, gain: Gain, seen: jax.Array, statistics: Statistics, fitted: Any) -> jax.Array:
        if not self.integrated:
            return jnp.ones_like(statistics.residual)
        power = self.shape + jnp.maximum(statistics.count - 0.5 * fitted, 0)
        more, same = (self._log_power_mean(gain, seen, statistics, p) for p in (power + 1, power))
        return power / self.scale * jnp.exp(more - same)

    def _log_power_mean(self, gain: Gain, seen: jax.Array, statistics: Statistics, power: jax.Array) -> jax.Array:
        unit = self.scale**0.5
        return gain.log_power_mean(seen / unit, statistics.response / unit, statistics.residual / self.scale, power)
