"""Both polarisations of a capture in mode amplitudes, on the coarse grid alone: no field on camera pixels is made.

In: the images of one capture, what is found of H. Out: amplitudes of V with their variance. Called by
:class:`fibre.Modal` for ``retrieve_fields``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fibre.fibrelets import LocalPower
from fibre.interference import relative_phase
from fibre.retrieval.modal.views import Views, apply, coarse_images, coarse_variance, squared

__all__ = ["second_polarisation"]

TOLERANCE, MOST = 1e-5, 40  # of the conjugate gradients: neighbours overlap by a few per cent, a dozen steps are exact


def second_polarisation(
    views: Views,
    local: LocalPower,
    h: np.ndarray,
    h_variance: float,
    fringes: np.ndarray,
    noise: np.ndarray,
    steps: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    r"""Amplitudes v of V, complex (m,), their variance and that of their prior, from images in which H and V interfere.

    .. math:: \min_v \sum_x \frac{|p(x) - H^*(x) (G v)(x)|^2}{\mathrm{var}\,p(x)} + \sum_k |v_k|^2 / P_k

    with p the measured conj(H) V (:func:`fibre.relative_phase`), H = G h that of the modes found, and P the power of V
    around each mode: the mean over the phase steps holds |V|^2, so that a V whose H is dark is known to be as weak as
    it looks. Where the images say nothing at all, P is all power of H, or of its noise.

    ``local``: of the views' modes. ``h`` (m,) and its variance; ``fringes`` and ``noise``, their variances, infinite
    where unusable: (k, y, x) on the camera's pixels; ``steps`` (k,) radians.
    """
    images, spread = coarse_images(fringes, views.step), coarse_variance(noise, views.step)
    with np.errstate(divide="ignore"):
        found = relative_phase(images, steps, 1 / spread)
    field = views.focus(h)
    usable = np.isfinite(found.product) & np.isfinite(found.variance)
    weight = np.where(usable, 1 / np.where(usable, found.variance, 1), 0).astype(np.float32)
    strength = (weight * squared(field)).ravel()
    right = (weight * field * np.where(usable, found.product, 0)).astype(np.complex64).ravel()
    # of a dark H at least what its noise would be
    most = max(float((np.abs(h) ** 2).sum()), len(h) * h_variance)
    light = 2 * found.mean - squared(field)  # |V|^2
    prior = local(light, weight, most)
    ridge = (1 / prior).astype(np.float32)
    diagonal = views.squares @ strength + ridge
    scale = 1 / np.sqrt(diagonal)

    def normal(vector: np.ndarray) -> np.ndarray:
        scaled = scale * vector
        back = apply(views.transposed, strength * apply(views.modes, scaled))
        return np.asarray(scale * (back + ridge * scaled))

    value = scale * _conjugate_gradients(normal, scale * apply(views.transposed, right))
    variance = 1 / diagonal.astype(float)
    # dividing by a weak H carries its error over, and that error is the whole mode's, not a pixel's
    ratio = np.abs(value) ** 2 / (np.abs(h) ** 2 + h_variance)
    return value.astype(complex), variance + ratio * h_variance, prior


def _conjugate_gradients(normal: Callable[[np.ndarray], np.ndarray], target: np.ndarray) -> np.ndarray:
    """x of normal(x) = target, complex64 (m,), for a real symmetric matrix."""
    found, left = np.zeros_like(target), target.copy()
    direction, size = left.copy(), float(np.vdot(left, left).real)
    first = size
    for _ in range(MOST):
        if not size > TOLERANCE**2 * first:
            break
        image = normal(direction)
        length = np.float32(size / float(np.vdot(direction, image).real))
        found += length * direction
        left -= length * image
        new = float(np.vdot(left, left).real)
        direction = left + np.float32(new / size) * direction
        size = new
    return found
