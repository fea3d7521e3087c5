"""What every phase retrieval method is, and the verb that runs one.

In: a :class:`fibre.Diversity` (images of one field, or a batch, through known masks) and a method. Out: a
:class:`fibre.Retrieved`. Called by ``retrieve_fields`` and by users with a defocus stack.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from fibre.records import Diversity, Fibrelets, Images, RetrievalStatus, Retrieved
from polinfer.checks import one_of_types
from polinfer.threads import each, piece

__all__ = [
    "Amplitudes",
    "ModeMethod",
    "RetrievalMethod",
    "Solution",
    "Stack",
    "judged",
    "measured_amplitudes",
    "misfit",
    "retrieve",
]


class RetrievalMethod(ABC):
    """A method of phase retrieval: a frozen object of settings with one function."""

    @abstractmethod
    def solve(self, stack: Stack) -> Solution:
        """Fields of a small batch."""


class Amplitudes(NamedTuple):
    """Of some captures: values complex (b, 2, m), their variance, status (b,), :class:`fibre.RetrievalStatus`, and the
    most that a variance can be, (b, 2, m): the power that the prior of the amplitude allows; infinite without one."""

    values: np.ndarray
    variance: np.ndarray
    status: np.ndarray
    most: np.ndarray


class ModeMethod(RetrievalMethod):
    """A method that finds the amplitudes of fibrelet modes, so that no field on the camera's pixels is needed."""

    fibrelets: Fibrelets

    @abstractmethod
    def amplitudes(self, images: Images, captures: range) -> Amplitudes:
        """Amplitudes in both polarisations from the defocused and the phase-stepped images of some captures."""


@dataclass(frozen=True)
class Stack:
    """What a method is given: the images of a small batch of b fields, checked, in single precision.

    intensities: float32 (b, m, y, x), as measured, so that noise may be negative. variance: float32, the same shape,
    infinite = unusable, or None = unknown. masks: complex64 (m, y, x). distances: (m,) metres, or None where the masks
    are others than defocus. wavelength, pixel_size: metres.
    """

    intensities: np.ndarray
    variance: np.ndarray | None
    masks: np.ndarray
    distances: np.ndarray | None
    wavelength: float
    pixel_size: float

    @cached_property
    def measured(self) -> Measured:
        """Amplitudes and their weights; made when a method asks first."""
        return measured_amplitudes(self.intensities, self.variance)

    @property
    def amplitudes(self) -> np.ndarray:
        """Square roots of the images, 0 for negative ones, float32 (b, m, y, x)."""
        return self.measured.amplitudes

    @property
    def weights(self) -> np.ndarray:
        """Inverse variances of the amplitudes over the best pixel's, float32 (b, m, y, x): 0 to 1, 0 = unusable."""
        return self.measured.weights

    @property
    def noise(self) -> np.ndarray:
        """Noise of the amplitudes over the amplitudes (weighted), (b,); 0 where it is not known."""
        return self.measured.noise


@dataclass(frozen=True)
class Solution:
    """field: complex64 (b, y, x). converged: bool (b). iterations: int (b). variance: float32 (b, y, x) of the complex
    field, where the method knows better than the floor that :func:`retrieve` states. misfitted: bool (b), where the
    method has compared its field with the images; otherwise :func:`retrieve` does."""

    field: np.ndarray
    converged: np.ndarray
    iterations: np.ndarray
    variance: np.ndarray | None = None
    misfitted: np.ndarray | None = None


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
        stack = Stack(
            measured, uncertain, np.asarray(masks), diversity.distances, diversity.wavelength, diversity.pixel_size
        )
        found = method.solve(stack)
        field[part], iterations[part] = found.field, found.iterations
        if found.misfitted is None or uncertain is None:
            floor, misfitted = judged(found.field, stack.measured, masks)
        else:
            floor, misfitted = _floors(measured, uncertain), found.misfitted
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


class Measured(NamedTuple):
    """amplitudes, weights (b, m, y, x); expected: the misfit that noise alone leaves, (b,), None where the noise is
    unknown; noise: of the amplitudes over the amplitudes, (b,)."""

    amplitudes: np.ndarray
    weights: np.ndarray
    expected: np.ndarray | None
    noise: np.ndarray


def _joined(work: Callable[[slice], Sequence[jax.Array]], count: int) -> list[np.ndarray]:
    """What ``work`` finds of some of ``count`` fields: on a processor one by one on all cores, so that one code does
    for batches of all sizes; on an accelerator all at once."""
    size = piece(1, count)
    found: list[Sequence[np.ndarray]] = [()] * -(-count // size)

    def part(k: int) -> None:
        found[k] = [np.asarray(values) for values in work(slice(k * size, (k + 1) * size))]

    each(part, range(len(found)))
    return [np.concatenate(values) for values in zip(*found, strict=True)]


def _spread(intensities: jax.Array, variance: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Variance of the amplitudes, and which are usable."""
    usable = jnp.isfinite(variance)
    variance = jnp.where(usable, variance, 1)
    # near zero intensity the square root is no longer linear: its error is at most sqrt(deviation)
    return variance / (4 * jnp.maximum(intensities, jnp.sqrt(variance))), usable


def measured_amplitudes(intensities: np.ndarray, variance: np.ndarray | None) -> Measured:
    """Amplitudes and weights of images (b, m, y, x)."""
    if variance is None:
        amplitudes = np.sqrt(np.maximum(intensities, 0))
        return Measured(amplitudes, np.ones_like(amplitudes), None, np.zeros(len(amplitudes), np.float32))
    return Measured(*_joined(lambda some: _measured(intensities[some], variance[some]), len(intensities)))


@jax.jit
def _measured(intensities: jax.Array, variance: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """What :class:`Measured` holds."""
    amplitudes = jnp.sqrt(jnp.maximum(intensities, 0))
    spread, usable = _spread(intensities, variance)
    best = jnp.where(usable, spread, jnp.inf).min((1, 2, 3))
    weights = jnp.where(usable, best[:, None, None, None] / spread, 0)
    power = (weights * amplitudes**2).sum((1, 2, 3))
    noise = jnp.sqrt(best * usable.sum((1, 2, 3)) / jnp.maximum(power, 1e-30))
    # sum of w = sum of best / spread: pixels of equal weight would each have this variance
    expected = best * usable.sum((1, 2, 3)) / weights.sum((1, 2, 3))
    return amplitudes, weights, expected, noise


def _floors(intensities: np.ndarray, variance: np.ndarray) -> np.ndarray:
    return _joined(lambda some: [_floor(intensities[some], variance[some])], len(intensities))[0]


@jax.jit
def _floor(intensities: jax.Array, variance: jax.Array) -> jax.Array:
    """Variance of the complex field that the image noise alone leaves, (b,)."""
    spread, usable = _spread(intensities, variance)
    return 2 * usable.sum((1, 2, 3)) / jnp.where(usable, 1 / spread, 0).sum((1, 2, 3)) / intensities.shape[1]


@jax.jit
def _misfit(field: jax.Array, amplitudes: jax.Array, weights: jax.Array, masks: jax.Array) -> jax.Array:
    views = jnp.abs(jnp.fft.ifft2(jnp.fft.fft2(field)[:, None] * masks))
    return (weights * (views - amplitudes) ** 2).sum((1, 2, 3)) / weights.sum((1, 2, 3))


def misfit(field: np.ndarray, amplitudes: np.ndarray, weights: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """Weighted mean squared difference between the field's amplitudes and the measured ones, (b)."""
    return np.asarray(_misfit(field, amplitudes, weights, masks))


def judged(field: np.ndarray, measured: Measured, masks: Any) -> tuple[np.ndarray, np.ndarray]:
    """Variance (b,) of the complex field from the image noise, and whether the images are misfitted beyond it, (b,)."""
    amplitudes, weights, expected, _ = measured
    images = amplitudes.shape[1]

    def judge(some: slice) -> Sequence[jax.Array]:
        return _left(field[some], amplitudes[some], weights[some], masks)

    left, power = _joined(judge, len(field))
    if expected is None:
        # nothing known of the noise: what the best fit leaves over is all there is to go by
        return 2 * left / images, np.zeros(len(field), bool)
    return 2 * expected / images, left > 2 * expected + 0.01 * power


@jax.jit
def _left(field: jax.Array, amplitudes: jax.Array, weights: jax.Array, masks: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The misfit and the measured power, weighted means over the pixels."""
    power = (weights * amplitudes**2).sum((1, 2, 3)) / weights.sum((1, 2, 3))
    return _misfit(field, amplitudes, weights, masks), power
