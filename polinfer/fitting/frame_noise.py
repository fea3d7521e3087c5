"""One unknown sigma for all pixels of a frame: how it follows from fits at a given sigma.

The density of log sigma^2 is the product of the evidences of all pixels and of the inverse gamma prior. With
``s = sigma^2``, the residuals Q_i, the numbers N_i of complex data and the effective numbers gamma_i of real parameters
that the data determine, the Gaussian approximation of the evidences puts its maximum at
``s = (scale + sum Q_i) / (shape + sum (N_i - gamma_i / 2))``. A window makes every datum count several times; the sums
are divided by that number, so that the prior keeps its weight.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from ..model import Model
from ..neighbours import Windowed
from ..noise import InferredNoise
from ..records import PERIODS, Parameters
from ..statistics import Statistics

__all__ = ["Search", "effective_parameters", "misfit", "prior_curvature"]

TOLERANCE = 1e-4  # of sigma^2, relative


@partial(jax.jit, static_argnums=0)
def misfit(model: Model, parameters: Parameters, statistics: Statistics | Windowed) -> jax.Array:
    """``d log p(data) / d log sigma^2 + N`` at a known sigma: Q / sigma^2, and what an unknown gain adds to it."""

    def rescaled(growth: jax.Array) -> jax.Array:
        plain = statistics if isinstance(statistics, Statistics) else statistics.statistics
        root = jnp.exp(-0.5 * growth)
        residual = plain.residual * root**2
        scaled = Statistics(
            plain.illumination * root,
            plain.response * root,
            residual,
            plain.constant + plain.residual - residual,
            plain.count,
        )
        return model.log_data(
            parameters, scaled if isinstance(statistics, Statistics) else Windowed(scaled, statistics.dark)
        )

    start = jnp.zeros((), statistics.residual.dtype)
    return jax.jvp(rescaled, (start,), (jnp.ones_like(start),))[1]


@partial(jax.jit, static_argnums=0)
def _prior_curvature(model: Model, points: jax.Array) -> jax.Array:
    """Negative second derivative of the log prior of the free parameters ``(pixels, free)``."""
    columns = []
    for i, name in enumerate(model.free):
        value = points[:, i]
        period = getattr(PERIODS, name)
        if name not in model.bounds:
            value = value - period * jnp.ceil(value / period - 0.5)
        columns.append(-jax.vmap(jax.grad(jax.grad(model.priors[name].log_density)))(value))
    return jnp.stack(columns, axis=-1)


def prior_curvature(model: Model, parameters: Parameters) -> np.ndarray:
    """Negative second derivatives of the log prior in the free parameters, ``(pixels, free)``; 0 on a bound."""
    points = np.stack([np.asarray(getattr(parameters, name)) for name in model.free], axis=-1)
    return np.nan_to_num(np.asarray(_prior_curvature(model, points), float), posinf=0.0, neginf=0.0)


def effective_parameters(model: Model, parameters: Parameters, covariance: np.ndarray, most: np.ndarray) -> np.ndarray:
    """How many of the free parameters the data determine, rather than the prior, ``(pixels,)``.

    ``covariance`` is that of the free parameters ``(pixels, free, free)``, ``most`` how many real numbers the data can
    determine. With the covariance C and the curvature of the prior H the number is ``sum (1 - C_ii H_ii)``. An angle
    without a prior counts fully even if it is unknown: near the pole of polar coordinates, the fit follows the noise
    in all directions.
    """
    variance = np.einsum("...ii->...i", covariance).astype(float)
    share = np.clip(1 - np.nan_to_num(variance) * prior_curvature(model, parameters), 0, 1)
    return np.minimum(np.sum(share, axis=-1), most)


class Search:
    """Fixed-point iteration for sigma^2, sped up by a secant in its logarithm and kept from running away."""

    def __init__(self, noise: InferredNoise, start: float) -> None:
        self.noise, self.variance = noise, start
        self.earlier: tuple[float, float] | None = None
        self.converged = False

    def update(self, misfits: np.ndarray, data: np.ndarray, fitted: np.ndarray, copies: float) -> None:
        """Take in fits at ``variance``: misfits, numbers of complex data, effective parameters, all of every pixel.

        ``copies`` is how many windows a datum is part of on average.
        """
        residual = self.noise.scale + self.variance * float(np.sum(misfits)) / copies
        freedom = self.noise.shape + float(np.sum(np.maximum(data - 0.5 * fitted, 0))) / copies
        here, step = np.log(self.variance), np.log(residual / freedom / self.variance)
        rate = 0.0
        if self.earlier is not None and here != self.earlier[0]:
            rate = float(np.clip((step - self.earlier[1]) / (here - self.earlier[0]) + 1, -0.5, 0.9))
        self.earlier = (here, step)
        self.converged = abs(step) < TOLERANCE * (1 - rate)
        self.variance = float(np.exp(here + np.clip(step / (1 - rate), -10, 10)))


def first_guess(noise: InferredNoise, own: Statistics, matrices: np.ndarray | None) -> float:
    """A variance that is rather too small: what too large a one explains by noise is hard to win back.

    ``own`` are the statistics of the pixels in the unit of the response; ``matrices`` those of the closed form, if
    there is one. The residual is that of the best gain, whether or not the model has one.
    """
    response = own.response.astype(complex)
    power = float(np.sum(np.abs(response) ** 2))
    rest = 1e-3 * power
    if matrices is not None:
        seen = matrices @ own.illumination
        size = np.sum(np.abs(seen) ** 2, axis=(-1, -2))
        gain = np.sum(seen.conj() * response, axis=(-1, -2)) / np.where(size > 0, size, 1)
        rest = float(np.sum(np.abs(gain[:, None, None] * seen - response) ** 2))
    # where the data have no noise, rounding is left
    least = (1e-5 if own.residual.dtype == np.float32 else 1e-10) ** 2 * power
    total = max(rest + float(np.sum(own.residual, dtype=float)), least)
    return (noise.scale + total) / (noise.shape + float(np.sum(own.count, dtype=float)))
