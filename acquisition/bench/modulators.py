"""What imperfect modulators do to light: holograms that make wrong spots, lenses that are not quite lenses.

In: what should be shown. Out: what the light becomes. Called by the simulated bench where its scene declares them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
import scipy.ndimage

from fibre.holograms import Modulator, quantise, spot_amplitudes
from fibre.propagation import phase_per_metre
from polinfer.checks import integer, real_number

__all__ = ["ModulatorModel", "defocused", "shown_spots"]


@dataclass(frozen=True)
class ModulatorModel:
    r"""How a phase modulator errs; every effect is absent unless declared.

    levels: of grey over a full turn of phase, 0: continuous, else 2 to 65536. crosstalk: pixels, standard deviation of
    the Gaussian by which fringing fields smear the phase. settling: seconds, time constant of a pixel: what is shown a
    time t after the update is the new phase plus :math:`e^{-t/\tau}` times what it came from. pixels: along a side.

    ValueError for numbers out of range.

    >>> ModulatorModel(levels=4).shown(np.array([[0.1, 3.0]])).round(3).tolist()
    [[0.0, 3.142]]
    """

    levels: int = 0
    crosstalk: float = 0.0
    settling: float = 0.0
    pixels: int = 256

    def __post_init__(self) -> None:
        if self.levels != 0:
            integer("levels", self.levels, low=2, high=1 << 16)
        real_number("crosstalk", self.crosstalk, low=0)
        real_number("settling", self.settling, low=0)
        integer("pixels", self.pixels, low=8)

    def left(self, wait: float) -> float:
        """Share of the last phase that is still shown ``wait`` seconds after the update."""
        return float(np.exp(-wait / self.settling)) if self.settling > 0 else 0.0

    def addressed(self, phase: np.ndarray) -> np.ndarray:
        """The grey levels of a pattern (y, x), as phases in [0, 2 pi)."""
        return np.mod(phase, 2 * np.pi) if self.levels == 0 else quantise(phase, self.levels)

    def shown(self, phase: np.ndarray, last: np.ndarray | float = 0.0, wait: float = np.inf) -> np.ndarray:
        """Phase (y, x) that the light meets where ``phase`` is wanted and ``last`` was shown before."""
        grey = self.addressed(phase)
        if self.crosstalk > 0:
            grey = scipy.ndimage.gaussian_filter(grey, self.crosstalk, mode="nearest")
        return np.asarray(grey + self.left(wait) * (last - grey))


def shown_spots(
    model: ModulatorModel, points: np.ndarray, light: np.ndarray, pitch: float, wavelength: float, wait: float
) -> np.ndarray:
    """Complex amplitudes (2, p) of the spots at all ``points`` that a hologram of spots makes, in both polarisations.

    ``light`` complex (2, p): what is wanted, most of it 0. The hologram is the phase of the sum of the wanted plane
    waves, one for each polarisation; a spot that a perfect modulator makes of it has the wanted amplitude by
    definition, so that what is returned differs from ``light`` by the modulator's errors alone: spots of wrong
    amplitude and phase, and light where none is wanted. Two neighbouring points are 2.5 resolved spots apart. Every
    hologram follows on a flat one.
    """
    # a focal length for which the pitch is 2.5 diffraction-limited spots
    size = 10e-6
    focal_length = pitch * model.pixels * size / (2.5 * wavelength)
    modulator = Modulator((model.pixels, model.pixels), size, wavelength, focal_length)
    lit = np.flatnonzero(np.any(light != 0, axis=0))
    rows, columns = modulator.waves(points[lit])
    found = np.array(light, complex)
    for p in range(2):
        wanted = light[p, lit]
        if not np.any(wanted):
            continue
        pattern = np.angle((wanted[:, None] * rows).T @ columns)
        ideal, real = (spot_amplitudes(modulator, np.exp(1j * phase), points) for phase in
                       (pattern, model.shown(pattern, 0.0, wait)))  # fmt: skip
        scale = np.abs(wanted).mean() / np.abs(ideal[lit]).mean()
        found[p] = scale * (real - ideal)
        found[p, lit] = wanted * real[lit] / ideal[lit]
    return found


def defocused(
    model: ModulatorModel, focus: np.ndarray, distances: np.ndarray, wavelength: float, step: float, wait: float
) -> np.ndarray:
    """Fields (z, 2, y, x) behind the lenses that a modulator in the Fourier plane shows, one after the other.

    ``focus`` complex (2, y, x), ``step`` metres between its samples. A sample of the spectrum is a pixel of the
    modulator. Evanescent frequencies are dark, as in free space.
    """
    turn, propagates = (np.fft.fftshift(part) for part in phase_per_metre(focus.shape[-2:], wavelength, step))
    spectrum: Any = scipy.fft.fftshift(scipy.fft.fft2(focus, workers=-1), axes=(-2, -1)) * propagates
    found = np.empty((len(distances), *focus.shape), np.complex64)
    last = np.zeros(turn.shape)
    for z, distance in enumerate(distances):
        last = model.shown(distance * turn, last, wait)
        mask = np.exp(1j * last).astype(np.complex64)
        found[z] = scipy.fft.ifft2(scipy.fft.ifftshift(spectrum * mask, axes=(-2, -1)), workers=-1)
    return found
