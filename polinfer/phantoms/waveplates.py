"""A half-wave plate that is turned step by step: the usual check of an instrument."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np

from ..checks import as_generator, real_array, real_number
from ..records import Parameters
from .base import Phantom, frame_shape, phase_map, within_ranges
from .random_fields import smooth_field

__all__ = ["half_wave_plate"]


def half_wave_plate(
    shape: tuple[int, int],
    angles: Any = 0.0,
    rng: int | np.random.Generator | None = None,
    retardance: float = pi,
    variation: float = 0.0,
    smoothness: float = 8.0,
    wedge: float = 0.0,
    tilt: Any = None,
) -> Phantom:
    """A half-wave plate at one or several angles: ``eta = pi`` everywhere, ``theta_eta = angles``, D = 0, xi = 0.

    With parallel arms the maps are flat. With a tilt between them the retardance stays flat and the circularity becomes
    the ramp ``xi = -tilt``, except where the axis is along a component (theta_eta = 0 or pi/2).

    Parameters
    ----------
    shape: pixels (y, x) of a frame. angles: of the slow axis, radians; a sequence makes a series of frames.
    rng: seed, generator or None: a fresh seed, recorded; used if variation > 0.
    retardance: of the plate, radians; pi is that at its own wavelength.
    variation: standard deviation of the retardance over the plate, radians, >= 0; the same part of the plate is seen at
        all angles. smoothness: its correlation length, pixels, > 0.
    wedge: phase ramp of a plate that is no perfect slab, radians a pixel; it turns with the plate.
    tilt: phase of the second arm, radians, broadcasts to (y, x), or None; the instrument's, so it does not turn.

    Returns
    -------
    Phantom of shape (y, x), or (angle, y, x) for a sequence.

    Raises
    ------
    TypeError, ValueError: values out of range.

    Source: Gordon et al., supplementary information, the rotating half-wave plate.

    >>> series = half_wave_plate((6, 8), np.radians([0, 15, 30, 45]))
    >>> series.parameters.retardance_angle[2, 0, 0].round(3).item()
    0.524
    """
    shape = frame_shape(shape)
    turns = real_array("angles", angles, finite=True)
    variation = real_number("variation", variation, low=0)
    smoothness = real_number("smoothness", smoothness, above=0)
    generator, seed = as_generator(rng)
    eta = np.full(shape, real_number("retardance", retardance))
    if variation:
        eta = eta + variation * smooth_field(generator, shape, smoothness)
    y, x = (axis - (n - 1) / 2 for axis, n in zip(np.mgrid[: shape[0], : shape[1]], shape, strict=True))
    theta = turns[..., None, None]
    # an axis at angle t points along (cos t, -sin t) in (x, y)
    ramp = real_number("wedge", wedge) * (x * np.cos(theta) - y * np.sin(theta))
    parameters, gain = within_ranges(Parameters(0.0, 0.0, eta, theta, 0.0), np.exp(1j * ramp))
    return Phantom(parameters, gain, phase_map(tilt, shape), names=("plate",), seed=seed)
