"""The phase between the two polarisations, from images in which they interfere.

In: k images with known phase steps. Out: conj(H) V with its variance. Called by ``retrieve_fields``, which divides
by the retrieved H.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fibre.records import Interference
from polinfer.checks import real_array

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
    stacked, weight = np.moveaxis(images, -3, -1), np.moveaxis(known, -3, -1)
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    normal = weight @ np.stack([design[:, i] * design[:, j] for i, j in pairs], axis=1)
    right = (weight * stacked) @ design
    inverse, solvable = _inverse(normal)
    solution = np.einsum("...ij,...j->...i", inverse, right)
    scale: Any = 1.0
    if weights is None:
        left = ((stacked - solution @ design.T) ** 2).sum(-1)
        scale = left.mean() / (count - 3) if count > 3 else np.nan
    variance = scale * (inverse[..., 1, 1] + inverse[..., 2, 2])
    product = np.where(solvable, solution[..., 1] + 1j * solution[..., 2], np.nan)
    return Interference(product, np.where(solvable, variance, np.inf), np.where(solvable, solution[..., 0], np.nan))


def _inverse(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverses (..., 3, 3) of symmetric matrices given by their upper triangle (..., 6), and which exist.

    By cofactors on whole images: a library call on a million 3 x 3 matrices takes ten times as long.
    """
    a, b, c, d, e, f = np.moveaxis(normal, -1, 0)
    cofactors = [d * f - e**2, c * e - b * f, b * e - c * d, a * f - c**2, b * c - a * e, a * d - b**2]
    determinant = a * cofactors[0] + b * cofactors[1] + c * cofactors[2]
    solvable = determinant > 1e-9 * (np.maximum(a + d + f, 1e-300) / 3) ** 3
    safe = np.where(solvable, determinant, 1.0)
    whole = [cofactors[i] / safe for i in (0, 1, 2, 1, 3, 4, 2, 4, 5)]
    return np.stack(whole, axis=-1).reshape(*normal.shape[:-1], 3, 3), solvable
