"""What the camera sees of mode amplitudes: fields of all images on a grid as coarse as the modes allow.

In: the geometry (fibrelets, frame, masks). Out: the linear map from amplitudes to fields and its adjoint, and images on
the same coarse grid. Called by the start and by the Gauss-Newton steps of :class:`fibre.Modal`.
"""

from __future__ import annotations

from dataclasses import dataclass
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
    grid, metres, step: camera pixels in one of its pixels along an axis.
    """

    modes: scipy.sparse.csr_array
    transposed: scipy.sparse.csr_array
    masks: np.ndarray
    pixel_size: float
    step: int

    def focus(self, amplitudes: np.ndarray) -> np.ndarray:
        """Field in focus, complex64 (y, x)."""
        parts = self.modes @ np.stack([amplitudes.real, amplitudes.imag], axis=1).astype(np.float32)
        return parts.view(np.complex64).reshape(self.masks.shape[-2:])

    def spectrum(self, amplitudes: np.ndarray) -> np.ndarray:
        """Spectrum of the field in focus, complex64 (y, x)."""
        return scipy.fft.fft2(self.focus(amplitudes))

    def fields(self, spectrum: np.ndarray) -> np.ndarray:
        """Fields of all images, complex64 (image, y, x), from a spectrum."""
        return scipy.fft.ifft2(spectrum * self.masks, overwrite_x=True)

    def adjoint(self, fields: np.ndarray) -> np.ndarray:
        """The adjoint of both together: complex128 (m,)."""
        # conj of the sum of conj(F) M: vecdot conjugates as it goes, no second copy of all images
        spectra: Any = scipy.fft.fft2(fields, overwrite_x=True)
        spectrum = np.vecdot(np.moveaxis(spectra, 0, -1), np.moveaxis(self.masks, 0, -1)).conj()
        back = scipy.fft.ifft2(spectrum, overwrite_x=True).reshape(-1, 1)
        parts = self.transposed @ back.view(np.float32)
        return parts[:, 0].astype(float) + 1j * parts[:, 1]


def make_views(fibrelets: Fibrelets, masks: np.ndarray, pixel_size: float, coarsening: int | None) -> Views:
    """The map for images through ``masks`` (image, y, x).

    A grid of ``coarsening`` camera pixels; None: the coarsest that divides the frame and whose pixels are at most half
    a mode radius wide. There a Gaussian mode's spectrum has fallen to 0.1 % at the edge, and its intensity's to 1 %.
    """
    shape = masks.shape[-2:]
    if coarsening is None:
        wanted = int(0.5 * float(np.median(fibrelets.mode_radius)) / pixel_size)
        coarsening = next(n for n in range(max(wanted, 1), 0, -1) if n == 1 or not any(s % (2 * n) for s in shape))
    if coarsening > 1 and any(s % (2 * coarsening) for s in shape):
        raise ValueError(f"coarsening is {coarsening}, but the frame {shape} is no multiple of {2 * coarsening}; "
                         "take None.")  # fmt: skip
    few = tuple(s // coarsening for s in shape)
    rows, columns = (_low(s, n) for s, n in zip(shape, few, strict=True))
    modes = scipy.sparse.csr_array(mode_matrix(fibrelets, few, pixel_size * coarsening) / coarsening).astype(np.float32)
    low = np.ascontiguousarray(masks[:, rows[:, None], columns])
    return Views(modes, modes.T.tocsr(), low, pixel_size * coarsening, coarsening)


def _low(count: int, few: int) -> np.ndarray:
    """Places of the ``few`` lowest frequencies of ``count``."""
    return np.r_[0 : few // 2, count - (few - few // 2) : count]


def coarse_images(images: np.ndarray, step: int) -> np.ndarray:
    """Band-limited samples of images (image, y, x), each the mean over a coarse pixel's place, float32."""
    if step == 1:
        return images
    shape = images.shape[-2:]
    rows, columns = (_low(s, s // step) for s in shape)
    spectrum = scipy.fft.rfft2(images)
    # the middle of a coarse pixel lies between camera pixels
    shift = [np.exp(2j * np.pi * np.fft.fftfreq(s)[low] * (step - 1) / 2).astype(np.complex64)
             for s, low in zip(shape, (rows, columns), strict=True)]  # fmt: skip
    half = columns[: shape[1] // step // 2 + 1].copy()
    half[-1] = shape[1] // step // 2  # the highest frequency, by its positive name
    low = spectrum[:, rows[:, None], half] * shift[0][:, None] * shift[1][: len(half)]
    few = tuple(s // step for s in shape)
    return scipy.fft.irfft2(low, s=few).astype(np.float32) / step**2


def coarse_variance(variance: np.ndarray, step: int) -> np.ndarray:
    """Variance of :func:`coarse_images` from that of the camera's pixels, infinite where one is unusable."""
    if step == 1:
        return variance
    # strided sums: a mean over two axes of a five-dimensional view takes three times as long
    parts = (variance[:, i::step, j::step] for i in range(step) for j in range(step))
    return np.asarray(sum(parts, np.float32(0)) / step**4, np.float32)
