"""A film that transmits one direction of vibration better than the other."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..checks import as_generator, real_array, real_number
from ..records import Parameters
from .base import Phantom, frame_shape, phase_map, within_ranges
from .random_fields import smooth_field

__all__ = ["film"]


def film(
    shape: tuple[int, int],
    angles: Any = 0.0,
    rng: int | np.random.Generator | None = None,
    diattenuation: float = 0.5,
    transmission: float = 0.5,
    retardance: float = 0.0,
    variation: float = 0.0,
    smoothness: float = 8.0,
    tilt: Any = None,
) -> Phantom:
    """A diattenuating film at one or several angles: ``D``, ``theta_D = angles``, ``|g|^2 = transmission``.

    A stretched film is birefringent too, with the same axes; then both orderings of the elements are the same matrix.

    Parameters
    ----------
    shape: pixels (y, x). angles: of the axis that transmits more, radians; a sequence makes a series of frames.
    rng: seed, generator or None: a fresh seed, recorded; used if variation > 0.
    diattenuation: D, -1 to 1. transmission: of unpolarised light, > 0 to 1. retardance: radians.
    variation: standard deviation of ``artanh D`` over the film, >= 0, so that D stays in its range (D near 0: of D
        itself). smoothness: its correlation length, pixels, > 0.
    tilt: phase of the second arm, radians, broadcasts to (y, x), or None.

    Returns
    -------
    Phantom of shape (y, x), or (angle, y, x) for a sequence.

    Raises
    ------
    TypeError, ValueError: values out of range.

    >>> sheet = film((2, 2), angles=0.3, diattenuation=0.4, transmission=0.25)
    >>> sheet.parameters.diattenuation[0, 0].item(), abs(sheet.gain[0, 0]).item()
    (0.4, 0.5)
    """
    shape = frame_shape(shape)
    theta = real_array("angles", angles, finite=True)[..., None, None]
    strength = np.full(shape, real_number("diattenuation", diattenuation, low=-1, high=1))
    transmission = real_number("transmission", transmission, above=0, high=1)
    variation = real_number("variation", variation, low=0)
    smoothness = real_number("smoothness", smoothness, above=0)
    generator, seed = as_generator(rng)
    if variation:
        with np.errstate(divide="ignore"):  # a perfect polariser stays one
            strength = np.tanh(np.arctanh(strength) + variation * smooth_field(generator, shape, smoothness))
    eta = real_number("retardance", retardance)
    parameters, gain = within_ranges(Parameters(strength, theta, eta, theta, 0.0), complex(np.sqrt(transmission)))
    return Phantom(parameters, gain, phase_map(tilt, shape), names=("film",), seed=seed)
