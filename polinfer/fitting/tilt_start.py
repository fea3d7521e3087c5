"""Which planes the data suggest, all of them at once: the spectrum of a frame of phasors.

What a pixel says about the phase phi has the period pi, and nearly the form ``Re(Z e^{-2 i phi})``: for a retarder the
phase of ``conj(J_01) J_10`` is ``2 (xi - phi)``. The sum over a plane is a value of the frame's Fourier transform.
"""

from __future__ import annotations

from math import log, pi
from typing import NamedTuple

import numpy as np
import scipy.fft
from scipy.special import i0e

from ..misalignment import TiltPlane

__all__ = ["Spectrum", "fold", "refine", "spectrum_of", "wrap_piston"]

ITERATIONS = 12
LONGEST_STEP = 0.6  # radians of phase at any pixel
WINDOWS = (0.25, 0.5, 0.75)  # sides of central parts of the frame, over which a curved phase is nearly a plane


class Spectrum(NamedTuple):
    """``|sum Z e^{-2 i (a v + b u)}|`` on a grid of slopes, twice as fine as it need be.

    ``rows`` and ``columns`` are the slopes, radians from edge to edge; ``size`` (rows, columns). ``cell`` is the area
    of a cell of the grid in which a slope that has no meaning (one row) does not count.
    """

    rows: np.ndarray
    columns: np.ndarray
    size: np.ndarray
    cell: float

    def log_mass(self, scale: float) -> np.ndarray:
        """Log of what every cell holds of ``integral p(tilt) e^{sum F}``, the piston integrated out."""
        prior = np.zeros(self.size.shape)
        for slopes, axis in ((self.rows, 0), (self.columns, 1)):
            if len(slopes) > 1:
                density = -0.5 * (slopes / scale) ** 2 - log(scale) - 0.5 * log(2 * pi)
                prior = prior + np.expand_dims(density, 1 - axis)
        return np.log(i0e(self.size.astype(float))) + self.size + prior + log(self.cell)

    def log_prior_peak(self, scale: float) -> float:
        """The highest log density of slopes before the data."""
        return -sum(log(scale) + 0.5 * log(2 * pi) for grid in (self.rows, self.columns) if len(grid) > 1)

    def highest_far(self, slopes: np.ndarray) -> float:
        """The largest value outside the main peak around slopes."""
        return float(np.max(self.size, where=~self.near(slopes, 2 * pi), initial=-np.inf))

    def slopes(self, place: int) -> np.ndarray:
        """Slopes of a cell, by its flat index."""
        row, column = np.unravel_index(place, self.size.shape)
        return np.array([self.rows[row], self.columns[column]])

    def near(self, slopes: np.ndarray, within: float) -> np.ndarray:
        """Cells whose slopes both differ by less, aliases included."""
        found = []
        for grid, slope in ((self.rows, slopes[0]), (self.columns, slopes[1])):
            period = len(grid) * (grid[1] - grid[0]) if len(grid) > 1 else 1.0  # the first two are neighbours
            apart = grid - slope
            found.append(np.abs(apart - period * np.round(apart / period)) < within)
        return found[0][:, None] & found[1]


def spectrum_of(phasors: np.ndarray) -> Spectrum:
    """The spectrum of Z ``(rows, columns)``; 0 where a pixel says nothing."""
    padded = [1 if n == 1 else scipy.fft.next_fast_len(2 * n) for n in phasors.shape]
    # a maximum is looked for, and refined in double precision
    size = np.abs(scipy.fft.fft2(phasors.astype(np.complex64), s=padded, workers=2))
    grids, cell = [], 1.0
    for n, length in zip(phasors.shape, padded, strict=True):
        grid = np.fft.fftfreq(length) * n * pi
        grids.append(grid)
        cell *= pi * n / length if length > 1 else 1.0
    return Spectrum(grids[0], grids[1], size, cell)


def refine(plane: TiltPlane, phasors: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """The nearest maximum of ``|sum Z e^{-2 i phi}|``, and the piston at which the sum is real."""
    left, right = plane.factors(phasors.shape)
    found = np.array(coefficients, float)
    parts = (*WINDOWS, 1.0) if plane.order > 1 else (1.0,)
    for part in parts:
        inside = tuple(_centre(n, part) for n in phasors.shape)
        own, a, b = phasors[inside], left[:, inside[0]], right[:, inside[1]]
        for _ in range(ITERATIONS):
            step = _step(own, a, b, found)
            found[1:] += step
            if np.max(np.abs(step), initial=0.0) < 1e-3:
                break
    total = np.sum(phasors * np.exp(-2j * ((found[:, None] * left)[1:].T @ right[1:])))
    found[0] = 0.5 * np.angle(total)
    return found


def _centre(size: int, part: float) -> slice:
    half = max(int(np.ceil(0.5 * part * size)), 1)
    return slice(max(size // 2 - half, 0), min(size // 2 + half, size))


def _step(phasors: np.ndarray, left: np.ndarray, right: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """A Newton step on ``log |S|``, ``S = sum Z e^{-2 i phi}``, of all coefficients but the piston."""
    waves = phasors * np.exp(-2j * ((coefficients[:, None] * left)[1:].T @ right[1:]))
    terms = len(coefficients)
    first = np.einsum("kr,rk->k", left, waves @ right.T)
    if first[0] == 0:
        return np.zeros(terms - 1)
    pairs = [(k, j) for k in range(1, terms) for j in range(k, terms)]
    second = np.zeros((terms, terms), complex)
    for k, j in pairs:
        second[k, j] = second[j, k] = (left[k] * left[j]) @ (waves @ (right[k] * right[j]))
    ratio = first / first[0]
    gradient = 2 * ratio.imag[1:]
    curvature = 4 * (second / first[0] - ratio[:, None] * ratio).real[1:, 1:]
    values, axes = np.linalg.eigh(curvature)
    # terms that are 0 at every pixel have no curvature
    least = 1e-6 * max(values.max(initial=0.0), 1e-9)
    step = axes @ ((axes.T @ gradient) / np.maximum(np.abs(values), least))
    reach = np.sum(np.abs(step) * np.max(np.abs(left[1:]), axis=1) * np.max(np.abs(right[1:]), axis=1))
    return step * min(1.0, LONGEST_STEP / max(reach, 1e-12))


def wrap_piston(coefficients: np.ndarray) -> np.ndarray:
    """The piston brought to (-pi/2, pi/2]."""
    found = np.array(coefficients, float)
    found[..., 0] -= pi * np.ceil(found[..., 0] / pi - 0.5)
    return found


def fold(coefficients: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The same data with slopes of at most pi/2 a pixel, and the piston in its range.

    A slope of pi a pixel changes phi by multiples of pi: ``(-1)^row`` goes to the signs of the axes.
    """
    found = np.array(coefficients, float)
    for k, n in ((1, shape[0]), (2, shape[1])):
        if n == 1:  # no slope along a single line; rounding aside its prior's mean is left
            found[k] = 0
            continue
        turns = np.ceil(found[k] / (pi * n) - 0.5)
        found[k] -= pi * n * turns
        # v runs through (r + 1/2)/n - 1/2: half a step is left over
        found[0] += pi * turns * (0.5 - 0.5 * n)
    return wrap_piston(found)
