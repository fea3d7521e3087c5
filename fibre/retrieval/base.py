"""What every phase retrieval method is, and the verb that runs one.

In: a :class:`fibre.Diversity` (images of one field, or a batch, through known masks) and a method. Out: a
:class:`fibre.Retrieved`. Called by ``retrieve_fields`` and by users with a defocus stack.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from fibre.records import Diversity, RetrievalStatus, Retrieved
from polinfer.checks import one_of_types

__all__ = ["RetrievalMethod", "Solution", "Stack", "misfit", "retrieve"]


class RetrievalMethod(ABC):
    """A method of phase retrieval: a frozen object of settings with one function."""

    @abstractmethod
    def solve(self, stack: Stack) -> Solution:
        """Fields of a small batch."""


@dataclass(frozen=True)
class Stack:
    """What a method is given: the images of a small batch of b fields, checked, in single precision.

    intensities: float32 (b, m, y, x), as measured, so that noise may be negative. variance: float32, the same shape,
    infinite = unusable, or None = unknown. amplitudes: their square roots, 0 for negative ones. weights: inverse
    variances of the amplitudes relative to the best pixel's, 0 to 1, 0 = unusable. noise: (b,), the noise of the
    amplitudes over the amplitudes (weighted), 0 where it is not known. masks: complex64 (m, y, x). distances: (m,)
    metres, or None where the masks are others than defocus. wavelength, pixel_size: metres.
    """

    intensities: np.ndarray
    variance: np.ndarray | None
    amplitudes: np.ndarray
    weights: np.ndarray
    noise: np.ndarray
    masks: np.ndarray
    distances: np.ndarray | None
    wavelength: float
    pixel_size: float


@dataclass(frozen=True)
class Solution:
    """field: complex64 (b, y, x). converged: bool (b). iterations: int (b). variance: float32 (b, y, x) of the complex
    field, where the method knows better than the floor that :func:`retrieve` states."""

    field: np.ndarray
    converged: np.ndarray
    iterations: np.ndarray
    variance: np.ndarray | None = None


def retrieve(diversity: Diversity, method: RetrievalMethod, batch: int = 8, progress: bool = False) -> Retrieved:
    r"""The complex field behind images taken through known masks.

    Finds E with :math:`|F^{-1}[M_i F[E]]|^2 \approx I_i` for all images i, up to a common phase. ``batch`` fields are
    worked on at a time; ``progress`` shows a bar.

    The variance of the field is the statistical floor: an amplitude :math:`\sqrt{I}` carries
    :math:`\mathrm{var}(I)/4I`, the m planes are averaged with these as weights, and the phase quadrature is taken to
    be as good as the measured one. It does not know of stagnation or of wrong distances;
    :func:`fibre.retrieve_fields` compares it with the closure of the illumination states. MISFIT is raised where the
    mean squared amplitude misfit exceeds twice what the image noise explains plus 1 % of the mean intensity.

    Distances of the wrong sign give the complex conjugate of the field, which fits its images as well: no status can
    tell.

    Raises
    ------
    TypeError: ``diversity`` or ``method`` is something else.

    >>> from fibre import Defocus, GerchbergSaxton, angular_spectrum, retrieve
    >>> y, x = np.mgrid[-32:32, -32:32] * 1e-6
    >>> beam = np.exp(-((x - 4e-6)**2 + y**2) / (6e-6)**2) - np.exp(-((x + 5e-6)**2 + y**2) / (5e-6)**2)
    >>> z = np.array([-8e-5, -4e-5, 0, 4e-5, 8e-5])
    >>> images = np.stack([abs(angular_spectrum(beam, d, 850e-9, 1e-6))**2 for d in z])
    >>> found = retrieve(Defocus(images, z, wavelength=850e-9, pixel_size=1e-6), GerchbergSaxton(iterations=100))
    >>> overlap = abs(np.vdot(beam, found.field)) / np.linalg.norm(beam) / np.linalg.norm(found.field)
    >>> bool(overlap > 0.999)
    True
    """
    one_of_types("diversity", diversity, (Diversity,), "build one with Diversity or Defocus.")
    one_of_types("method", method, (RetrievalMethod,), "pass an object such as GerchbergSaxton().")
    *lead, images, height, width = diversity.intensities.shape
    intensities = diversity.intensities.reshape(-1, images, height, width)
    variance = None if diversity.variance is None else diversity.variance.reshape(intensities.shape)
    masks = diversity.single_masks
    count = len(intensities)
    field = np.empty((count, height, width), np.complex64)
    spread = np.empty((count, height, width), np.float32)
    status = np.zeros(count, np.uint8)
    iterations = np.zeros(count, np.int32)
    for start in tqdm(range(0, count, batch), desc="phase retrieval", unit="batch", disable=not progress):
        part = slice(start, min(start + batch, count))
        measured = intensities[part].astype(np.float32)
        uncertain = None if variance is None else variance[part].astype(np.float32)
        amplitudes, weights, best = _weights(measured, uncertain)
        noise = _relative_noise(amplitudes, weights, best)
        stack = Stack(
            measured, uncertain, np.asarray(amplitudes), np.asarray(weights), np.asarray(noise), masks,
            diversity.distances, diversity.wavelength, diversity.pixel_size,
        )  # fmt: skip
        found = method.solve(stack)
        field[part], iterations[part] = found.field, found.iterations
        floor, misfitted = _noise(found.field, amplitudes, weights, best, masks)
        spread[part] = floor[:, None, None] if found.variance is None else found.variance
        status[part] = np.where(found.converged, 0, RetrievalStatus.NOT_CONVERGED)
        status[part] |= np.where(misfitted, RetrievalStatus.MISFIT, 0).astype(np.uint8)
    shape = tuple(lead)
    return Retrieved(
        field.reshape(*shape, height, width),
        spread.reshape(*shape, height, width),
        status.reshape(shape),
        iterations.reshape(shape),
    )


@jax.jit
def _weights(intensities: jax.Array, variance: jax.Array | None) -> tuple[jax.Array, jax.Array, jax.Array | None]:
    """Amplitudes, their relative inverse variances, both (b, m, y, x), and the variance of weight 1, (b)."""
    amplitudes = jnp.sqrt(jnp.maximum(intensities, 0))
    if variance is None:
        return amplitudes, jnp.ones_like(amplitudes), None
    usable = jnp.isfinite(variance)
    deviation = jnp.sqrt(jnp.where(usable, variance, 1))
    # near zero intensity the square root is no longer linear: its error is at most sqrt(deviation)
    spread = deviation**2 / (4 * jnp.maximum(amplitudes**2, deviation))
    best = jnp.where(usable, spread, jnp.inf).min((1, 2, 3))
    return amplitudes, jnp.where(usable, best[:, None, None, None] / spread, 0), best


@jax.jit
def _relative_noise(amplitudes: jax.Array, weights: jax.Array, best: jax.Array | None) -> jax.Array:
    if best is None:
        return jnp.zeros(len(amplitudes), jnp.float32)
    power = (weights * amplitudes**2).sum((1, 2, 3))
    return jnp.sqrt(best * (weights > 0).sum((1, 2, 3)) / jnp.maximum(power, 1e-30))


@jax.jit
def _misfit(field: jax.Array, amplitudes: jax.Array, weights: jax.Array, masks: jax.Array) -> jax.Array:
    views = jnp.abs(jnp.fft.ifft2(jnp.fft.fft2(field)[:, None] * masks))
    return (weights * (views - amplitudes) ** 2).sum((1, 2, 3)) / weights.sum((1, 2, 3))


def misfit(field: np.ndarray, amplitudes: np.ndarray, weights: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """Weighted mean squared difference between the field's amplitudes and the measured ones, (b)."""
    return np.asarray(_misfit(field, amplitudes, weights, masks))


@jax.jit
def _noise(
    field: jax.Array, amplitudes: jax.Array, weights: jax.Array, best: jax.Array | None, masks: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Variance of the complex field from the image noise, and whether the images are misfitted beyond it."""
    images = amplitudes.shape[1]
    left = _misfit(field, amplitudes, weights, masks)
    if best is None:
        # nothing known of the noise: what the best fit leaves over is all there is to go by
        return 2 * left / images, jnp.zeros(len(field), bool)
    # sum of w = sum of best / spread: pixels of equal weight would each have this variance
    expected = best * (weights > 0).sum((1, 2, 3)) / weights.sum((1, 2, 3))
    slack = 0.01 * (weights * amplitudes**2).sum((1, 2, 3)) / weights.sum((1, 2, 3))
    return 2 * expected / images, left > 2 * expected + slack
