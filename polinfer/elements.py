"""Jones calculus of one element: the partial polariser and the elliptical retarder, multiplied out.

Both are element-wise, so parameters of any shape give matrices of that shape with two more axes, and both are
written for JAX, so they can be differentiated and compiled.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

__all__ = ["multiply", "polariser", "retarder"]

# called by themselves they are one piece of code for a shape, not one for each of twenty operations; called in code
# that is compiled they leave no trace
COMPILED = partial(jax.jit, inline=True)


def _root(x: jax.Array) -> jax.Array:
    # the derivative at 0 is infinite; 0 in its place keeps the edge |D| = 1 free of NaN, and x < 0 still gives NaN
    zero = x == 0
    return jnp.where(zero, jnp.zeros_like(x), jnp.sqrt(jnp.where(zero, jnp.ones_like(x), x)))


def _matrix(a: jax.Array, b: jax.Array, c: jax.Array, d: jax.Array) -> jax.Array:
    return jnp.stack([jnp.stack([a, b], axis=-1), jnp.stack([c, d], axis=-1)], axis=-2)


@COMPILED
def multiply(left: jax.Array, right: jax.Array) -> jax.Array:
    """Product of 2 x 2 matrices in the last two axes, ``(..., 2, 2)``.

    >>> multiply(jnp.eye(2), jnp.full((3, 2, 2), 2.0)).shape
    (3, 2, 2)
    """
    # sums of element-wise products fuse with their surroundings; a batched matrix product of this size does not
    return (left[..., :, :, None] * right[..., None, :, :]).sum(axis=-2)


@COMPILED
def polariser(diattenuation: Any, diattenuation_angle: Any) -> jax.Array:
    """Jones matrix ``(..., 2, 2)`` of a partial polariser, real and symmetric.

    ``A_pol = R(theta_D) diag(sqrt(1 + D), sqrt(1 - D)) R(-theta_D)`` with ``R(t) = [[cos t, sin t], [-sin t, cos t]]``:
    the transmitting axis points along ``(cos theta_D, -sin theta_D)``, and the mean intensity transmission is 1.

    Parameters
    ----------
    diattenuation: D in [-1, 1], without unit, any shape. Outside, the result is NaN.
    diattenuation_angle: theta_D in radians, period pi; broadcasts with D.

    Source: Gordon et al., supplementary information, the diattenuator of the polarimetric model.

    >>> import numpy as np
    >>> bool(np.allclose(polariser(1.0, np.pi / 2), [[0, 0], [0, 2**0.5]], atol=1e-6))
    True
    """
    value, angle = jnp.broadcast_arrays(jnp.asarray(diattenuation), jnp.asarray(diattenuation_angle))
    value = value + jnp.zeros((), jnp.result_type(float)) if not jnp.issubdtype(value.dtype, jnp.floating) else value
    mean = 0.5 * (_root(1 + value) + _root(1 - value))
    half = 0.5 * value / mean  # (sqrt(1 + D) - sqrt(1 - D)) / 2 without its cancellation at small D
    cosine, sine = half * jnp.cos(2 * angle), half * jnp.sin(2 * angle)
    return _matrix(mean + cosine, -sine, -sine, mean - cosine)


@COMPILED
def retarder(retardance: Any, retardance_angle: Any, circularity: Any) -> jax.Array:
    """Jones matrix ``(..., 2, 2)`` of an elliptical retarder, unitary with determinant 1.

    ``A_ret = diag(1, e^{i xi}) R(theta_eta) diag(e^{i eta/2}, e^{-i eta/2}) R(-theta_eta) diag(1, e^{-i xi})``. With
    ``c = cos(eta/2)``, ``s = sin(eta/2)`` its elements are ``c + i s cos 2 theta_eta`` and its complex conjugate on
    the diagonal and ``-i s sin 2 theta_eta e^{-i xi}``, ``-i s sin 2 theta_eta e^{i xi}`` off it.

    Parameters
    ----------
    retardance: eta in radians, period 4 pi (``eta + 2 pi`` gives minus the matrix).
    retardance_angle: theta_eta in radians, period pi.
    circularity: xi in radians, period 2 pi.

    Source: Gordon et al., supplementary information, the retarder of the polarimetric model.

    >>> import numpy as np
    >>> bool(np.allclose(retarder(np.pi, 0.0, 0.3), [[1j, 0], [0, -1j]], atol=1e-6))
    True
    """
    half = 0.5 * jnp.asarray(retardance)
    cosine, sine = jnp.cos(half), jnp.sin(half)
    straight = sine * jnp.cos(2 * jnp.asarray(retardance_angle))
    cross = sine * jnp.sin(2 * jnp.asarray(retardance_angle))
    real, imaginary = cross * jnp.cos(circularity), cross * jnp.sin(circularity)
    cosine, straight, real, imaginary = jnp.broadcast_arrays(cosine, straight, real, imaginary)
    return _matrix(
        jax.lax.complex(cosine, straight),
        jax.lax.complex(-imaginary, -real),
        jax.lax.complex(imaginary, -real),
        jax.lax.complex(cosine, -straight),
    )
