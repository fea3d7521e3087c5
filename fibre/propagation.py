"""Free-space propagation of sampled fields by the angular spectrum.

In: a complex field on a square grid of pixels, a distance. Out: the field there. Called by phase retrieval (whose
planes of defocus are transfer functions of the second modulator) and by anyone who holds a field.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax.numpy as jnp
import numpy as np

from polinfer.checks import complex_array, real_array, real_number

__all__ = ["angular_spectrum", "defocus_masks", "phase_per_metre", "transfer_function"]


def transfer_function(shape: tuple[int, int], distance: Any, wavelength: float, pixel_size: float) -> np.ndarray:
    r"""Transfer function of free space on the frequencies of :func:`numpy.fft.fftfreq`, piston left out.

    .. math:: H(f) = e^{2\pi i z (\sqrt{1/\lambda^2 - |f|^2} - 1/\lambda)}

    for a wave e^{i(kz - wt)}. Evanescent frequencies get 0, and so do those whose local fringe is finer than the
    frequency grid resolves (:math:`|z\,\partial_f \sqrt{1/\lambda^2 - f^2}| > N p / 2`: light that would have left
    the frame and come back at the other side), the band limit of Matsushima and Shimobaba (2009).

    Parameters
    ----------
    shape: (y, x) in pixels. distance: metres, any shape Z. wavelength, pixel_size: metres.

    Returns
    -------
    complex128 (*Z, y, x), of modulus 1 or 0.

    >>> H = transfer_function((8, 8), [0.0, 1e-5], wavelength=850e-9, pixel_size=1e-6)
    >>> bool(np.all(H[0] == 1)), H.shape
    (True, (2, 8, 8))
    """
    wavelength = real_number("wavelength", wavelength, above=0)
    pixel_size = real_number("pixel_size", pixel_size, above=0)
    distance = np.asarray(real_array("distance", distance, finite=True), np.float64)
    values = _transfer(tuple(shape), distance.tobytes(), wavelength, pixel_size)
    return values.reshape(*distance.shape, *shape)


def phase_per_metre(shape: tuple[int, int], wavelength: float, pixel_size: float) -> tuple[np.ndarray, np.ndarray]:
    r"""Phase that every frequency gains in a metre of free space, piston left out, and which frequencies propagate.

    :math:`2\pi (\sqrt{1/\lambda^2 - |f|^2} - 1/\lambda)`, radians a metre, (y, x) as :func:`numpy.fft.fftfreq` orders
    them; that of the grazing wave where none propagates.

    >>> turn, propagates = phase_per_metre((4, 4), 850e-9, 1e-6)
    >>> float(turn[0, 0]), bool(propagates.all())
    (0.0, True)
    """
    fy, fx = (np.fft.fftfreq(n, pixel_size) for n in shape)
    squared = 1 / wavelength**2 - fy[:, None] ** 2 - fx**2
    return 2 * np.pi * (np.sqrt(np.maximum(squared, 0)) - 1 / wavelength), squared > 0


@lru_cache(maxsize=4)
def _transfer(shape: tuple[int, int], distances: bytes, wavelength: float, pixel_size: float) -> np.ndarray:
    """The masks of :func:`transfer_function`, kept: a run asks for the same ones at every capture."""
    masks = _masks(shape, np.frombuffer(distances), wavelength, pixel_size)
    masks.flags.writeable = False
    return masks


def _masks(shape: tuple[int, int], distances: np.ndarray, wavelength: float, pixel_size: float) -> np.ndarray:
    distance = distances[:, None, None]
    fy, fx = (np.fft.fftfreq(n, pixel_size) for n in shape)
    turn, inside = phase_per_metre(shape, wavelength, pixel_size)
    phase, axial = distance * turn, turn / (2 * np.pi) + 1 / wavelength
    for f, n in ((fy[:, None], shape[0]), (fx[None, :], shape[1])):
        inside = inside & (np.abs(distance * f) <= axial * n * pixel_size / 2)
    return np.where(inside, np.exp(1j * phase), 0.0)


@lru_cache(maxsize=2)
def defocus_masks(shape: tuple[int, int], distances: bytes, wavelength: float, pixel_size: float) -> np.ndarray:
    """The masks of :func:`transfer_function` in single precision, complex64 (distance, y, x), kept in that alone;
    ``distances``: the bytes of float64 metres."""
    masks = np.empty((len(distances) // 8, *shape), np.complex64)
    for i, distance in enumerate(np.frombuffer(distances)):
        masks[i] = _masks(shape, np.array([distance]), wavelength, pixel_size)[0]
    masks.flags.writeable = False
    return masks


def angular_spectrum(field: Any, distance: float, wavelength: float, pixel_size: float) -> np.ndarray:
    """The field ``distance`` metres further along the beam (negative: back), on the same grid.

    ``field`` is complex (..., y, x); the frame is periodic, so leave a dark margin of the width by which the light
    spreads. The common phase k z is left out. Source: the Rayleigh-Sommerfeld integral in the Fourier domain.

    Going there and back returns a field that stays inside the frame:

    >>> y, x = np.mgrid[-16:16, -16:16] * 1e-6
    >>> beam = np.exp(-(x**2 + y**2) / (4e-6) ** 2).astype(complex)
    >>> there = angular_spectrum(beam, 2e-5, wavelength=850e-9, pixel_size=1e-6)
    >>> back = angular_spectrum(there, -2e-5, wavelength=850e-9, pixel_size=1e-6)
    >>> bool(np.abs(back - beam).max() < 1e-3)
    True
    """
    field = complex_array("field", field, trailing=(None, None))
    transfer = transfer_function(field.shape[-2:], distance, wavelength, pixel_size)
    return np.asarray(jnp.fft.ifft2(jnp.fft.fft2(field) * transfer.astype(field.dtype)))
