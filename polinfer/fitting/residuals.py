"""What is left of the data at the most probable parameters, and whether noise explains it."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import betainc, gammaincc

from ..elements import multiply
from ..model import Model
from ..neighbours import Windowed
from ..noise import InferredNoise
from ..records import Parameters
from ..statistics import Statistics

__all__ = ["BAD_FIT_PROBABILITY", "Judged", "judge", "tail_probability"]

BAD_FIT_PROBABILITY = 1e-3


class Judged(NamedTuple):
    """Of every pixel: log posterior, chi-square of the window; gain, residual and precision of the pixel itself."""

    log_posterior: Any
    chi_square: Any
    gain: Any
    residual: Any
    precision: Any


@partial(jax.jit, static_argnums=0)
def judge(
    model: Model, parameters: Parameters, statistics: Statistics | Windowed, own: Statistics, fitted: jax.Array
) -> Judged:
    """Residuals at the most probable gain and noise; ``fitted`` parameters are shared out over the data."""
    gain = model.known_gain

    def square(values: Parameters, plain: Statistics, share: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        seen = multiply(model.jones(values), plain.illumination)
        precision = model.noise.precision(gain, seen, plain, share)
        root = jnp.sqrt(precision)[..., None, None]
        seen, response = root * seen, root * plain.response
        rest = gain.best(seen, response)[..., None, None] * seen - response
        total = jnp.sum(jnp.abs(rest) ** 2, axis=(-1, -2)) + precision * plain.residual
        return total, gain.mean(seen, response), precision

    if isinstance(statistics, Statistics):
        data = statistics.count
        chi_square = 2 * square(parameters, statistics, fitted)[0]
    else:
        members = statistics.statistics
        data = jnp.sum(members.count, axis=-1)
        shares = (fitted / jnp.where(data > 0, data, 1))[..., None] * members.count
        each = square(Parameters(*(jnp.asarray(x)[..., None] for x in parameters)), members, shares)[0]
        chi_square = 2 * jnp.sum(each, axis=-1)
    residual, mean, precision = square(parameters, own, fitted * own.count / jnp.where(data > 0, data, 1))
    return Judged(model.log_density(parameters, statistics), chi_square, mean, residual / precision, precision)


def tail_probability(
    model: Model, chi_square: np.ndarray, degrees: np.ndarray, residual: np.ndarray, own_degrees: np.ndarray
) -> np.ndarray:
    """Probability of a residual at least this large, 1 where there are no degrees of freedom; NaN stays NaN.

    With a sigma of the pixel's own, chi-square says nothing. The squared ``residual`` Q of the pixel itself, with d
    real degrees of freedom, is compared with what the prior of sigma^2 expects: ``(2 Q / d) / (scale / shape)`` follows
    an F distribution with d and 2 ``shape`` degrees of freedom. A prior that says little objects to nothing.
    """
    noise = model.noise
    with np.errstate(invalid="ignore"):
        if isinstance(noise, InferredNoise) and noise.integrated:
            place = 1 / (1 + residual.astype(float) / noise.scale)
            found = betainc(noise.shape, 0.5 * np.maximum(own_degrees, 1e-9), place)
            return np.where(own_degrees > 0, found, np.where(np.isnan(residual), np.nan, 1.0))
        found = gammaincc(0.5 * np.maximum(degrees, 1), 0.5 * chi_square)
        return np.where(degrees > 0, found, np.where(np.isnan(chi_square), np.nan, 1.0))
