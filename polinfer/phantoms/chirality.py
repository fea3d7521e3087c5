"""A solution of chiral molecules, which turns the plane of polarisation."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np

from ..checks import as_generator, real_array, real_number
from ..degeneracy import canonicalise
from ..records import Parameters
from .base import Phantom, frame_shape, phase_map, within_ranges
from .random_fields import smooth_field
from .rotation_vectors import retarder_of

__all__ = ["chiral"]


def chiral(
    shape: tuple[int, int],
    rotations: Any = 0.1,
    rng: int | np.random.Generator | None = None,
    retardance: float = 0.0,
    retardance_angle: float = 0.0,
    variation: float = 0.0,
    smoothness: float = 8.0,
    tilt: Any = None,
) -> Phantom:
    """Optical rotation by alpha, and optionally linear birefringence along the same path.

    Rotation alone is a circular retarder: ``A_ret = R(alpha)``, which turns an axis at t into one at t + alpha
    (anticlockwise on a screen whose rows run down), is exactly ``theta_eta = pi/4, xi = -pi/2, eta = 2 alpha``; the
    opposite rotation has eta < 0, or xi = pi/2. With a linear retardance eta_0 at angle theta_0 the medium is
    ``exp(i/2 (eta_0 cos 2 theta_0 Z - eta_0 sin 2 theta_0 X + 2 alpha Y))``: an elliptical retarder, whose retardance
    is ``sqrt(eta_0^2 + 4 alpha^2)``. A chiral pixel seen through a linear retarder is another thing, a product.

    Glucose turns by 9.2e-3 rad m^2/kg at 589 nm (52.7 degrees for 1 g/ml and 10 cm): 500 kg/m^3 over 1 cm make
    0.046 rad, clockwise as seen against the light, which is negative here if your image is seen so.

    Parameters
    ----------
    shape: pixels (y, x). rotations: alpha, radians; a sequence makes a series of frames.
    rng: seed, generator or None: a fresh seed, recorded; used if variation > 0.
    retardance: eta_0, radians, >= 0. retardance_angle: theta_0, radians.
    variation: of the concentration, relative (standard deviation), >= 0. smoothness: its correlation length, pixels,
        > 0.
    tilt: phase of the second arm, radians, broadcasts to (y, x), or None.

    Returns
    -------
    Phantom of shape (y, x), or (rotation, y, x); parameters are the canonical ones.

    Raises
    ------
    TypeError, ValueError: values out of range.

    >>> from polinfer import RetarderFirst
    >>> turned = np.asarray(RetarderFirst().jones(chiral((1, 1), 0.3).parameters))[0, 0]
    >>> bool(np.allclose(turned, [[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]], atol=1e-6))
    True
    """
    shape = frame_shape(shape)
    alpha = real_array("rotations", rotations, finite=True)[..., None, None]
    linear, axis = real_number("retardance", retardance, low=0), real_number("retardance_angle", retardance_angle)
    variation = real_number("variation", variation, low=0)
    smoothness = real_number("smoothness", smoothness, above=0)
    generator, seed = as_generator(rng)
    local = np.ones(shape)
    if variation:
        local = local + variation * smooth_field(generator, shape, smoothness)
    retarder = retarder_of(linear * np.cos(2 * axis), linear * np.sin(2 * axis), -2 * alpha * local)
    parameters, gain = within_ranges(Parameters(0.0, pi / 4, *retarder), np.ones(retarder[0].shape, complex))
    return Phantom(canonicalise(parameters), gain, phase_map(tilt, shape), names=("solution",), seed=seed)
