"""The phase between the two polarisations, from images in which they interfere.

In: k images with known phase steps. Out: conj(H) V with its variance. Called by ``retrieve_fields``, which divides
by the retrieved H.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fibre.records import Interference
from polinfer.checks import real_array
from polinfer.precision import double_precision
from polinfer.threads import each

__all__ = ["relative_phase"]


def relative_phase(images: Any, steps: Any, weights: Any = None) -> Interference:
    r"""conj(H) V in every pixel by weighted least squares over k >= 3 phase steps.

    .. math:: I_j = \tfrac12 |H + V e^{i \delta_j}|^2 = a + \mathrm{Re}[H^* V e^{i \delta_j}], \quad
              a = \tfrac12 (|H|^2 + |V|^2)

    linear in (a, Re H*V, Im H*V): three normal equations a pixel. The field ratio V/H is product / |H|^2.

    Parameters
    ----------
    images: real (*B, k, y, x), photo-electrons per second. steps: (k,) radians, any values of which three differ.
    weights: real (*B, k, y, x), inverse variances, >= 0, 0 = unusable; None = all alike, and the variance is then
    estimated from what the fit leaves over (needs k >= 4, else it is NaN).

    Returns
    -------
    :class:`fibre.Interference`. A pixel with fewer than three usable steps has product NaN and infinite variance.

    Source: generalised phase-shifting interferometry, Greivenkamp (1984).

    >>> H, V, steps = 1.0, 0.5 * np.exp(0.3j), np.array([0, 1, 2, 4.0])
    >>> images = 0.5 * abs(H + V * np.exp(1j * steps)) ** 2
    >>> product = relative_phase(images[:, None, None], steps).product[0, 0]
    >>> round(float(abs(product)), 6), round(float(np.angle(product)), 6)
    (0.5, 0.3)
    """
    images = real_array("images", images, trailing=(None, None, None), finite=True)
    count = images.shape[-3]
    steps = real_array("steps", steps, shape=(count,), finite=True)
    design = np.stack([np.ones(count), np.cos(steps), -np.sin(steps)], axis=1)
    if count < 3 or np.linalg.cond(design) > 1e6:
        raise ValueError(f"steps must hold three different phases (modulo 2 pi), got {steps.tolist()}; add a step.")
    if weights is None:
        known = np.ones_like(images)
    else:
        known = real_array("weights", weights, low=0, finite=True)
        if known.shape != images.shape:
            raise ValueError(f"weights must have the shape of images {images.shape}, got {known.shape}.")
    shape = (*images.shape[:-3], *images.shape[-2:])
    product, variance, mean = np.empty(shape, complex), np.empty(shape), np.empty(shape)
    fields = list(np.ndindex(shape[:-2]))

    # every field by itself: one code does for any number of them
    def solve(k: int) -> None:
        own = fields[k]
        product.real[own], product.imag[own], variance[own], mean[own] = _solved(images[own], known[own], design)

    with double_precision(True):
        each(solve, range(len(fields)))
    if weights is None:
        left = images - mean[..., None, :, :]
        left = left - np.einsum("j,...yx->...jyx", np.exp(1j * steps), product).real
        variance = variance * ((left**2).sum(-3).mean() / (count - 3) if count > 3 else np.nan)
    solvable = np.isfinite(mean)
    return Interference(product, np.where(solvable, variance, np.inf), mean)


@jax.jit
def _solved(images: Any, weight: Any, design: Any) -> tuple[Any, Any, Any, Any]:
    """Real and imaginary part of conj(H) V, its variance for these weights and the mean, of (k, y, x).

    The normal matrices are inverted by cofactors. NaN where there is no inverse.
    """
    known = [weight[j].astype(float) for j in range(len(design))]
    seen = [w * images[j] for j, w in enumerate(known)]
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    a, b, c, d, e, f = (sum(row[p] * row[q] * w for row, w in zip(design, known, strict=True)) for p, q in pairs)
    first, second, third = (sum(row[p] * s for row, s in zip(design, seen, strict=True)) for p in range(3))
    ca, cb, cc, cd, ce, cf = d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * ca + b * cb + c * cc
    solvable = determinant > 1e-9 * (jnp.maximum(a + d + f, 1e-300) / 3) ** 3
    over = jnp.where(solvable, 1 / jnp.where(solvable, determinant, 1.0), jnp.nan)
    real, imaginary = cb * first + cd * second + ce * third, cc * first + ce * second + cf * third
    return over * real, over * imaginary, over * (cd + cf), over * (ca * first + cb * second + cc * third)
