"""Functions of circular statistics that stay accurate at any concentration."""

from __future__ import annotations

from math import pi
from typing import Any

import jax
import jax.numpy as jnp
from jax.scipy.special import i0e, i1e

__all__ = ["bessel_ratio", "log_scaled_bessel", "wrap"]

# log(i0e) is differentiated twice in fits; the derivatives of i0e cancel at large arguments, those of its asymptotic
# series do not. From 30 on, sixteen terms are exact to double precision.
_SWITCH = 30.0


def _series_coefficients() -> tuple[float, ...]:
    coefficients, term = [], 1.0
    for k in range(1, 17):
        term *= (2 * k - 1) ** 2 / (8.0 * k)
        coefficients.append(term)
    return tuple(coefficients)


_SERIES = _series_coefficients()


def log_scaled_bessel(x: Any) -> jax.Array:
    """``log(I_0(x) e^{-x})`` for ``x >= 0``, any shape; its first two derivatives are accurate too.

    >>> bool(abs(log_scaled_bessel(1e6) + 0.5 * jnp.log(2e6 * jnp.pi)) < 1e-5)
    True
    """
    x = jnp.asarray(x, jnp.result_type(float, x))
    small = x < _SWITCH
    inverse = 1 / jnp.where(small, jnp.full_like(x, _SWITCH), x)
    series = jnp.zeros_like(x)
    for coefficient in reversed(_SERIES):
        series = (series + coefficient) * inverse
    far = 0.5 * jnp.log(inverse / (2 * pi)) + jnp.log1p(series)
    near = jnp.log(i0e(jnp.where(small, x, jnp.zeros_like(x))))
    return jnp.where(small, near, far)


def bessel_ratio(x: Any) -> jax.Array:
    """``I_1(x) / I_0(x)``, the mean resultant length of a von Mises distribution of concentration ``x >= 0``.

    >>> float(bessel_ratio(0.0))
    0.0
    """
    return i1e(x) / i0e(x)


def wrap(x: Any, period: float) -> jax.Array:
    """``x`` reduced to ``(-period/2, period/2]``; the derivative is 1.

    >>> float(wrap(3.0, 2.0))
    1.0
    """
    x = jnp.asarray(x)
    return x - period * jnp.ceil(x / period - 0.5)
