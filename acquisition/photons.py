"""What a camera's counts are worth: gain, read noise, dark current and offset, by photon transfer.

In: pairs of flat frames and of dark frames. Out: a :class:`PhotonTransfer`. Called by users before a run, for the merge
rule of their camera.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from acquisition.exposure import InverseVariance
from polinfer.checks import integer, real_array

__all__ = ["PhotonTransfer", "photon_transfer"]

BRIGHTEST = 0.9  # of full scale, mean of a flat frame up to which it is used


class PhotonTransfer(NamedTuple):
    """gain: photo-electrons per count. read_noise: photo-electrons. dark: photo-electrons per second. offset: counts at
    no exposure. Then the standard deviations of the first three."""

    gain: float
    read_noise: float
    dark: float
    offset: float
    gain_std: float
    read_noise_std: float
    dark_std: float

    def rule(self) -> InverseVariance:
        """The merge rule of this camera."""
        return InverseVariance(self.gain, self.read_noise, max(self.dark, 0.0), max(self.offset, 0.0))


def photon_transfer(flats: Any, exposures: Any, darks: Any, dark_exposures: Any, full_scale: int) -> PhotonTransfer:
    r"""Gain, read noise and dark current of a camera.

    The variance of counts between two frames of the same light is that of its photo-electrons and of the reading,

    .. math:: \mathrm{var} = \frac{\bar c - o}{g} + \frac{r^2}{g^2} + \frac{1}{12}

    for mean counts :math:`\bar c`, offset o, g photo-electrons a count, read noise r and the rounding of counts. Half
    the variance of the difference of two frames is free of what differs from pixel to pixel. Offset and dark current
    are the line of the mean dark counts against exposure, r comes from the dark pairs, 1/g is the slope of the flats'
    variance, by least squares with the weights of variances that are chi-square distributed.

    Parameters
    ----------
    flats: integer counts (n, 2, y, x), n >= 2 brightnesses, two frames of each. exposures: (n,) seconds. darks: integer
    counts (m, 2, y, x) with the lens covered, m >= 2. dark_exposures: (m,) seconds, not all the same. full_scale: the
    count at saturation; flats with a saturated pixel or a mean above nine tenths of it are left out.

    Raises TypeError for counts that are no integers; ValueError for other shapes and where fewer than two usable flats
    are left.

    Source: J. R. Janesick, Photon Transfer, SPIE (2007); EMVA 1288.

    >>> rng = np.random.default_rng(0)
    >>> def frames(rate, times):  # 5 electrons a count, read noise 10, offset 20
    ...     e = rng.poisson((rate + 100) * np.array(times)[:, None, None, None], (len(times), 2, 60, 60))
    ...     return np.rint((e + 10 * rng.standard_normal(e.shape)) / 5 + 20).astype(np.uint16)
    >>> t = [0.01, 0.1, 0.3, 0.6]
    >>> found = photon_transfer(frames(2e4, t), t, frames(0, t), t, 4095)
    >>> bool(abs(found.gain - 5) < 4 * found.gain_std), bool(abs(found.read_noise - 10) < 4 * found.read_noise_std)
    (True, True)
    """
    flats, _ = _pairs("flats", flats, "exposures", exposures)
    darks, dark_times = _pairs("darks", darks, "dark_exposures", dark_exposures)
    full_scale = integer("full_scale", full_scale, low=1)
    if np.ptp(dark_times) == 0:
        raise ValueError("dark_exposures must differ: the dark current is seen in their difference.")
    pixels = flats[0, 0].size
    # dark counts rise with exposure; each mean errs by the root of its variance over two frames
    mean, variance = darks.mean((1, 2, 3)), _variance(darks)
    error = np.sqrt(np.maximum(variance, 1 / 12) / (2 * pixels))
    (slope, offset), covariance = np.polyfit(dark_times, mean, 1, w=1 / error, cov="unscaled")
    signal, spread = flats.mean((1, 2, 3)) - offset, _variance(flats)
    usable = (flats.max((1, 2, 3)) < full_scale) & (flats.mean((1, 2, 3)) < BRIGHTEST * full_scale) & (spread > 0)
    if np.count_nonzero(usable) < 2:
        raise ValueError(f"flats must hold two or more that are not saturated, got {np.count_nonzero(usable)}.")
    signal, spread = signal[usable], spread[usable]
    gain = max(float(np.median(signal / spread)), 1e-9)
    for _ in range(8):
        # what is left without light: reading and rounding, from the darks less the noise of their dark current
        floor = max(float(np.mean(variance - np.maximum(slope, 0) * dark_times / gain)), 1 / 12)
        weight = 1 / ((np.maximum(signal, 0) / gain + floor) * np.sqrt(2 / pixels))
        known = 1 / (np.mean(variance) * np.sqrt(2 / (pixels * len(darks))))
        rows = np.concatenate([np.stack([signal, np.ones(len(signal))], 1) * weight[:, None], [[0.0, known]]])
        inverse = np.linalg.inv(rows.T @ rows)
        found = inverse @ rows.T @ np.concatenate([spread * weight, [floor * known]])
        if not found[0] > 0:
            raise ValueError("flats do not grow noisier with light; are they of one camera, with enough light?")
        gain, gain_std = 1 / float(found[0]), float(np.sqrt(inverse[0, 0]) / found[0] ** 2)
    dark = slope * gain
    # electrons: what is left of the dark variance without dark current and rounding
    reading = variance - np.maximum(slope, 0) * dark_times / gain - 1 / 12
    weights = 1 / variance**2
    read2 = float((reading * weights).sum() / weights.sum()) * gain**2
    read2_std = float(np.sqrt(2 / pixels / (weights.sum()))) * gain**2
    read = float(np.sqrt(max(read2, 0)))
    read_std = float(np.hypot(read2_std / (2 * max(read, np.sqrt(read2_std))), read * gain_std / gain))
    dark_std = float(np.hypot(np.sqrt(covariance[0, 0]) * gain, slope * gain_std))
    return PhotonTransfer(float(gain), read, float(dark), float(offset), gain_std, read_std, dark_std)


def _variance(pairs: np.ndarray) -> np.ndarray:
    """Of one frame, (n,), from the difference of two."""
    difference = pairs[:, 0] - pairs[:, 1]
    return np.asarray(difference.var((1, 2), ddof=1) / 2)


def _pairs(name: str, frames: Any, times_name: str, times: Any) -> tuple[np.ndarray, np.ndarray]:
    frames = np.asarray(frames)
    if frames.dtype.kind not in "ui":
        raise TypeError(f"{name} must be raw integer counts, got {frames.dtype}.")
    if frames.ndim != 4 or frames.shape[1] != 2 or len(frames) < 2:
        raise ValueError(f"{name} must have shape (n, 2, y, x) with n >= 2, got {frames.shape}.")
    return frames.astype(float), real_array(times_name, times, shape=(len(frames),), above=0, finite=True)
