"""What the camera sees of mode amplitudes: fields of all images on a grid as coarse as the modes allow.

In: the geometry (fibrelets, frame, masks). Out: the linear map from amplitudes to fields and its adjoint, and images on
the same coarse grid. Called by the start and by the Gauss-Newton steps of :class:`fibre.Modal`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import scipy.fft
import scipy.sparse

from fibre.fibrelets import mode_matrix
from fibre.records import Fibrelets

__all__ = ["Views", "coarse_images", "coarse_variance", "make_views"]


@dataclass(frozen=True)
class Views:
    """The map from amplitudes c (m,) to fields (image, y, x), all of one size, in units of a camera pixel's field.

    modes: sparse float32 (y x, m), its transpose beside it, masks complex64 (image, y, x), pixel_size: of the coarse
    grid, metres, step: camera pixels in one of its pixels along an axis, which need not be whole.
    """

    modes: scipy.sparse.csr_array
    transposed: scipy.sparse.csr_array
    masks: np.ndarray
    pixel_size: float
    step: float

    @cached_property
    def squares(self) -> scipy.sparse.csr_array:
        """Squared modes, (m, y x)."""
        return self.transposed.power(2)

    def focus(self, amplitudes: np.ndarray) -> np.ndarray:
        """Field in focus, complex64 (y, x)."""
        return apply(self.modes, amplitudes).reshape(self.masks.shape[-2:])

    def spectrum(self, amplitudes: np.ndarray) -> np.ndarray:
        """Spectrum of the field in focus, complex64 (y, x)."""
        return scipy.fft.fft2(self.focus(amplitudes))

    def fields(self, spectrum: np.ndarray) -> np.ndarray:
        """Fields of all images, complex64 (image, y, x), from a spectrum."""
        return scipy.fft.ifft2(spectrum * self.masks, overwrite_x=True)

    def field(self, spectrum: np.ndarray, image: int) -> np.ndarray:
        """Field of one image, complex64 (y, x), from a spectrum."""
        return np.asarray(scipy.fft.ifft2(spectrum * self.masks[image], overwrite_x=True))

    def collect(self, total: np.ndarray, field: np.ndarray, image: int) -> None:
        """Add to ``total`` (y, x) what the adjoint of :meth:`field` makes of a field, which is lost."""
        spectrum: Any = scipy.fft.fft2(field, overwrite_x=True)
        spectrum *= self._conjugate[image]
        total += spectrum

    def amplitudes(self, spectrum: np.ndarray) -> np.ndarray:
        """The adjoint of :meth:`spectrum`: complex128 (m,)."""
        back: Any = scipy.fft.ifft2(spectrum)
        return apply(self.transposed, back.ravel()).astype(complex)

    @cached_property
    def _conjugate(self) -> np.ndarray:
        return self.masks.conj()


def apply(matrix: scipy.sparse.csr_array, values: np.ndarray) -> np.ndarray:
    """A real matrix times a complex vector, complex64: part by part, which is faster than both side by side."""
    found = np.empty(matrix.shape[0], np.complex64)
    found.real = matrix @ values.real.astype(np.float32)
    found.imag = matrix @ values.imag.astype(np.float32)
    return found


def squared(field: np.ndarray) -> np.ndarray:
    """|field|^2, float32."""
    power = field.real**2
    power += field.imag**2
    return np.asarray(power)


def make_views(fibrelets: Fibrelets, masks: np.ndarray, pixel_size: float, coarsening: float | None) -> Views:
    """The map for images through ``masks`` (image, y, x).

    A grid of ``coarsening`` camera pixels; None: of the largest whole number of them that divides the frame and makes
    pixels at most half a mode radius wide. There a Gaussian mode's spectrum has fallen to 0.1 % at the edge, and its
    intensity's to 1 %.
    """
    shape = masks.shape[-2:]
    if coarsening is None:
        wanted = int(0.5 * float(np.median(fibrelets.mode_radius)) / pixel_size)
        coarsening = next(n for n in range(max(wanted, 1), 0, -1) if n == 1 or not any(s % (2 * n) for s in shape))
    few = _few(shape, coarsening)
    uneven = [n % 2 or abs(n * coarsening - s) > 1e-6 * s for n, s in zip(few, shape, strict=True)]
    if coarsening > 1 and any(uneven):
        raise ValueError(f"coarsening is {coarsening}, which does not divide the frame {shape} into even numbers of "
                         "pixels; take None, or the side of the frame over an even number.")  # fmt: skip
    rows, columns = (_low(s, n) for s, n in zip(shape, few, strict=True))
    modes = scipy.sparse.csr_array(mode_matrix(fibrelets, few, pixel_size * coarsening) / coarsening).astype(np.float32)
    # short indices: half of what a product has to read
    modes.indices, modes.indptr = modes.indices.astype(np.int32), modes.indptr.astype(np.int32)
    low = np.ascontiguousarray(masks[:, rows[:, None], columns])
    return Views(modes, modes.T.tocsr(), low, pixel_size * coarsening, coarsening)


def _few(shape: tuple[int, ...], step: float) -> tuple[int, int]:
    """The coarse grid's shape for images (..., y, x)."""
    return round(shape[-2] / step), round(shape[-1] / step)


def _low(count: int, few: int) -> np.ndarray:
    """Places of the ``few`` lowest frequencies of ``count``."""
    return np.r_[0 : few // 2, count - (few - few // 2) : count]


def coarse_images(images: np.ndarray, step: float) -> np.ndarray:
    """Band-limited samples of images (image, y, x), each the mean over a coarse pixel's place, float32."""
    if step == 1:
        return images
    shape, few = images.shape[-2:], _few(images.shape, step)
    rows, columns = (_low(s, n) for s, n in zip(shape, few, strict=True))
    # the middle of a coarse pixel lies between camera pixels
    shift = [np.exp(2j * np.pi * np.fft.fftfreq(s)[low] * (step - 1) / 2).astype(np.complex64)
             for s, low in zip(shape, (rows, columns), strict=True)]  # fmt: skip
    count = few[1] // 2 + 1
    turn = shift[0][:, None] * shift[1][:count] / np.float32(step**2)
    coarse = np.empty((len(images), *few), np.float32)
    for image, out in zip(images, coarse, strict=True):  # one after the other: it stays in the processor's cache
        # frequencies that are left out are not computed along the second axis
        half: Any = scipy.fft.rfft(image, axis=1)[:, :count]
        out[...] = scipy.fft.irfft2(scipy.fft.fft(half, axis=0)[rows] * turn, s=few, overwrite_x=True)
    return coarse


def coarse_variance(variance: np.ndarray, step: float) -> np.ndarray:
    """Variance of :func:`coarse_images` from that of the camera's pixels, infinite where one is unusable.

    Of ``step``^2 pixels one is left, and so much less noise: the mean variance over a coarse pixel's place, to which a
    camera pixel counts with the share that lies there, over ``step``^2.
    """
    if step == 1:
        return variance
    few = _few(variance.shape, step)
    down, across = (_shares(s, n) / np.float32(step) for s, n in zip(variance.shape[1:], few, strict=True))
    coarse = np.empty((len(variance), *few), np.float32)
    for image, out in zip(variance, coarse, strict=True):
        # a sparse product has no share of nothing, which an infinite variance would make NaN
        out[...] = (across @ np.ascontiguousarray((down @ image).T)).T
    return coarse


@lru_cache(maxsize=8)
def _shares(count: int, few: int) -> scipy.sparse.csr_array:
    """The mean over each of ``few`` equal parts of an axis of ``count`` pixels, sparse float32 (few, count)."""
    # all edges, in units of 1 / (few count) of the axis, so that they are whole
    edges = np.union1d(np.arange(few) * count, np.arange(count) * few)
    widths = np.diff(np.r_[edges, few * count]) / count
    return scipy.sparse.csr_array((widths.astype(np.float32), (edges // count, edges // few)), shape=(few, count))
