"""A gel that becomes birefringent when it is stretched."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np

from ..checks import as_generator, real_array, real_number
from ..records import Parameters
from .base import Phantom, frame_shape, phase_map, within_ranges
from .random_fields import smooth_field

__all__ = ["gel_birefringence", "gel_thickness", "stretched_gel"]


def gel_thickness(stretch: Any, thickness: float = 2e-3, thinning: float = 0.5) -> np.ndarray:
    """Thickness of a stretched gel of constant volume, ``thickness * stretch^-thinning``, metres.

    A piece of length L, width W and thickness t keeps ``L W t``, so t falls as its area ``L W`` rises. With free sides
    width and thickness shrink alike, ``stretch^(-1/2)``: thinning = 1/2. A strip so wide between its clamps that its
    width cannot shrink has thinning = 1.

    Parameters
    ----------
    stretch: length over length at rest, > 0, any shape. thickness: at rest, metres, > 0. thinning: 0 to 1.

    >>> gel_thickness([1.0, 1.44]).tolist() == [2e-3, 2e-3 / 1.2]
    True
    """
    ratio = real_array("stretch", stretch, above=0, finite=True)
    return real_number("thickness", thickness, above=0) * ratio ** -real_number("thinning", thinning, low=0, high=1)


def gel_birefringence(stretch: Any, coefficient: float = 1e-4, thinning: float = 0.5) -> np.ndarray:
    """Birefringence of a rubber-like network seen along its thickness, ``coefficient (stretch^2 - width^2)``.

    The stress-optic law with the stress of a network of Gaussian chains (neo-Hookean): index along the stretch less
    that across it is ``C G (a^2 - b^2)``, with stress-optic coefficient C, shear modulus G, and the stretches a, b of
    length and width, ``b = a^-(1 - thinning)`` at constant volume. For a small strain e it is linear,
    ``coefficient (4 - 2 thinning) e``: 3 C G e with free sides.

    Parameters
    ----------
    stretch: > 0, any shape. coefficient: C G, without unit, of either sign. thinning: see :func:`gel_thickness`.

    Source: L. R. G. Treloar, The Physics of Rubber Elasticity, chapters on stress-optical properties.

    >>> float(gel_birefringence(1.001) / (3 * 1e-4 * 0.001)).__round__(3)
    1.0
    """
    ratio = real_array("stretch", stretch, above=0, finite=True)
    width = ratio ** -(1 - real_number("thinning", thinning, low=0, high=1))
    return real_number("coefficient", coefficient) * (ratio**2 - width**2)


def stretched_gel(
    shape: tuple[int, int],
    stretches: Any = 1.2,
    rng: int | np.random.Generator | None = None,
    angle: float = pi / 4,
    thickness: float = 2e-3,
    wavelength: float = 850e-9,
    coefficient: float = 1e-4,
    thinning: float = 0.5,
    variation: float = 0.0,
    axis_variation: float = 0.0,
    smoothness: float = 8.0,
    tilt: Any = None,
) -> Phantom:
    """A birefringent gel at one or several stretches: ``eta = 2 pi B(stretch) t(stretch) / wavelength``.

    B is :func:`gel_birefringence`, t is :func:`gel_thickness`. To compare retardances with the birefringence law,
    divide them by the thickness: the thinner the gel, the less its birefringence shows.

    Parameters
    ----------
    shape: pixels (y, x). stretches: length over length at rest, > 0; a sequence makes a series of frames.
    rng: seed, generator or None: a fresh seed, recorded; used by the variations.
    angle: of the stretch, radians; the slow axis if the coefficient is positive. thickness, wavelength: metres, > 0.
        coefficient: the default makes a clear picture, it is no measured constant.
    variation: of the strain, relative (standard deviation, >= 0): a deformation that is not the same everywhere.
    axis_variation: standard deviation of the axis, radians, >= 0. Both fields are the same in all frames.
    smoothness: correlation length of both, pixels, > 0.
    tilt: phase of the second arm, radians, broadcasts to (y, x), or None.

    Returns
    -------
    Phantom of shape (y, x), or (stretch, y, x). A retardance beyond pi is wrapped, the sign of J goes into the gain.

    Raises
    ------
    TypeError, ValueError: values out of range, a variation that makes a stretch <= 0.

    Source: Gordon et al., supplementary information, phantoms (polyacrylamide, 2 mm, constant volume).

    >>> gel = stretched_gel((4, 4), [1.0, 1.1, 1.3])
    >>> expected = 2 * np.pi * gel_birefringence(1.3) * gel_thickness(1.3) / 850e-9
    >>> bool(np.allclose(gel.parameters.retardance[2], expected))
    True
    """
    shape = frame_shape(shape)
    ratio = real_array("stretches", stretches, above=0, finite=True)[..., None, None]
    variation = real_number("variation", variation, low=0)
    axis_variation = real_number("axis_variation", axis_variation, low=0)
    smoothness = real_number("smoothness", smoothness, above=0)
    wavelength = real_number("wavelength", wavelength, above=0)
    generator, seed = as_generator(rng)
    strain, axis = (smooth_field(generator, shape, smoothness) for _ in range(2))
    local = 1 + (ratio - 1) * (1 + variation * strain)
    if np.any(local <= 0):
        raise ValueError(
            f"variation {variation:g} makes a stretch of {local.min():.3g} somewhere; choose a smaller one."
        )
    eta = 2 * pi / wavelength * gel_birefringence(local, coefficient, thinning)
    eta = eta * gel_thickness(local, thickness, thinning)
    theta = real_number("angle", angle) + axis_variation * axis
    parameters, gain = within_ranges(Parameters(0.0, 0.0, eta, theta, 0.0), np.ones(eta.shape, complex))
    return Phantom(parameters, gain, phase_map(tilt, shape), names=("gel",), seed=seed)
