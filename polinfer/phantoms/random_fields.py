"""Correlated random maps. None of them has a preferred wrap: angles are made of complex fields or wrapped sums."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d

__all__ = ["complex_field", "smooth_field"]


def smooth_field(generator: np.random.Generator, shape: tuple[int, int], scale: float) -> np.ndarray:
    """Gaussian field of mean 0 and variance 1 with correlation ``exp(-r^2 / (4 scale^2))`` at distance r, pixels.

    It is drawn larger than needed, so that opposite edges are independent.

    >>> field = smooth_field(np.random.default_rng(0), (400, 400), scale=2.0)
    >>> float((field[:, 4:] * field[:, :-4]).mean().round(1)), round(float(np.exp(-1.0)), 1)
    (0.4, 0.4)
    """
    margin = int(np.ceil(3 * scale))
    white = generator.normal(size=(shape[0] + 2 * margin, shape[1] + 2 * margin))
    impulse = np.zeros(2 * int(4 * scale + 1) + 1)
    impulse[impulse.size // 2] = 1.0
    power = float(np.sum(gaussian_filter1d(impulse, scale) ** 2))  # of each axis
    field = gaussian_filter(white, scale, mode="wrap") / power
    return np.asarray(field[margin : margin + shape[0], margin : margin + shape[1]])


def complex_field(generator: np.random.Generator, shape: tuple[int, int], scale: float) -> np.ndarray:
    """Circular complex Gaussian field, mean square 1: speckle, with the correlation of :func:`smooth_field`.

    >>> field = complex_field(np.random.default_rng(0), (300, 300), scale=1.0)
    >>> bool(abs((np.abs(field) ** 2).mean() - 1) < 0.05)
    True
    """
    real, imaginary = smooth_field(generator, shape, scale), smooth_field(generator, shape, scale)
    return (real + 1j * imaginary) / np.sqrt(2)
