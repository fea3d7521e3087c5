"""What the conversions of parameters share: elements described by their axes.

Other packages give a retarder by its retardance in [0, pi] and its fast axis, and a diattenuator by its transmissions
and its transmitting axis, with axes along ``(cos a, sin a)``: an axis at angle t here is at ``a = -t`` there.
"""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np

from ..checks import broadcast, one_of_types, real_array
from ..degeneracy import canonicalise, reduce_ranges
from ..records import Parameters

__all__ = [
    "diattenuator_arguments",
    "diattenuator_parameters",
    "half_turn",
    "linear_retarder_arguments",
    "linear_retarder_parameters",
    "real_arrays",
    "reduced",
    "retarder_arguments",
    "retarder_parameters",
]


def half_turn(angle: np.ndarray) -> np.ndarray:
    """Angles of axes reduced to [0, pi).

    >>> half_turn(np.array([-1e-20, np.pi, 4.0])).round(3).tolist()
    [0.0, 0.0, 0.858]
    """
    reduced = np.mod(angle, angle.dtype.type(pi))
    # a tiny negative angle is rounded to pi
    return np.where(reduced >= angle.dtype.type(pi), angle.dtype.type(0), reduced)


def real_arrays(**values: Any) -> list[np.ndarray]:
    """Real arrays of one common shape, checked by name, float types kept."""
    arrays = {name: real_array(name, value) for name, value in values.items()}
    shape = broadcast(**{name: array.shape for name, array in arrays.items()})
    return [np.broadcast_to(array, shape) for array in arrays.values()]


def reduced(parameters: Parameters) -> Parameters:
    """Parameters checked, broadcast to one shape and reduced to their ranges."""
    one_of_types("parameters", parameters, (Parameters,), "pass Parameters(...), for instance fit.parameters.")
    real_array("parameters.diattenuation", parameters.diattenuation, low=-1, high=1)
    return reduce_ranges(parameters)


def retarder_arguments(parameters: Parameters, flip_vertical: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Retardance in [0, pi], azimuth in [0, pi) and ellipticity in [-pi/4, pi/4] of the fast eigenstate, radians.

    For ``eta > 0`` the slow eigenstate of ``A_ret`` has the Stokes vector ``(cos 2 theta_eta,
    -sin 2 theta_eta cos xi, sin 2 theta_eta sin xi)`` with S3 = +1 for ``(1, -i) / sqrt 2``; the fast one is opposite.

    >>> [round(float(x), 3) for x in retarder_arguments(Parameters(0.0, 0.0, 1.0, 0.3, 0.0), False)]
    [1.0, 1.271, 0.0]
    """
    p = reduced(parameters)
    one = p.retardance_angle.dtype.type(1)
    sign = np.where(p.retardance < 0, one, -one)
    along, across = sign * np.cos(2 * p.retardance_angle), sign * np.sin(2 * p.retardance_angle)
    if flip_vertical:
        across = -across
    diagonal, circular = -across * np.cos(p.circularity), across * np.sin(p.circularity)
    azimuth = half_turn(np.asarray(np.arctan2(diagonal, along) / 2))
    return np.abs(p.retardance), azimuth, np.asarray(np.arctan2(circular, np.hypot(along, diagonal)) / 2 + 0)


def retarder_parameters(retardance: Any, azimuth: Any, ellipticity: Any, flip_vertical: bool) -> Parameters:
    """Canonical parameters (D = 0) of the retarder with this fast eigenstate, the reverse of retarder_arguments.

    >>> [round(float(x), 3) for x in retarder_parameters(1.0, np.pi / 2 - 0.3, 0.0, False)]
    [0.0, 1.571, 1.0, 0.3, 0.0]
    """
    retardance, azimuth, ellipticity = np.asarray(retardance), np.asarray(azimuth), np.asarray(ellipticity)
    along, diagonal = np.cos(2 * ellipticity) * np.cos(2 * azimuth), np.cos(2 * ellipticity) * np.sin(2 * azimuth)
    circular = np.sin(2 * ellipticity)
    if flip_vertical:
        diagonal, circular = -diagonal, -circular
    angle = np.arctan2(np.hypot(diagonal, circular), -along) / 2
    zero = np.zeros_like(retardance)
    return canonicalise(Parameters(zero, zero, retardance, angle, np.arctan2(-circular, diagonal)))


def linear_retarder_arguments(
    package: str, parameters: Parameters, flip_vertical: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Angle of the fast axis in [0, pi) and retardance in [0, pi], radians, for a package that knows no ellipse.

    Raises ValueError unless every retarder is linear.

    >>> parameters = Parameters(0.0, 0.0, 1.0, 0.3, 0.0)
    >>> [round(float(x), 3) for x in linear_retarder_arguments("pypolar", parameters, False)]
    [1.271, 1.0]
    """
    retardance, azimuth, ellipticity = retarder_arguments(parameters, flip_vertical)
    # what counts is how far the matrix is from that of a linear retarder: a plate without retardance has no axis
    circular = np.abs(np.sin(2 * ellipticity) * np.sin(retardance / 2))
    bad = circular > np.sqrt(np.finfo(circular.dtype).eps)
    if np.any(bad):
        largest = float(np.max(np.abs(ellipticity)[bad]))
        raise ValueError(
            f"parameters must describe linear retarders, the only ones that {package} builds, got "
            f"{np.count_nonzero(bad)} of {bad.size} elliptical, ellipticity up to {largest:.2g} rad; convert the "
            f"matrices with to_{package}, or fit with circularity fixed to 0."
        )
    return azimuth, retardance


def linear_retarder_parameters(flip_vertical: bool, **arguments: Any) -> Parameters:
    """The reverse of linear_retarder_arguments: fast axis and retardance in this order, by the package's own names.

    >>> [round(float(x), 3) for x in linear_retarder_parameters(False, theta=np.pi / 2 - 0.3, delta=1.0)[2:]]
    [1.0, 0.3, 0.0]
    """
    azimuth, retardance = real_arrays(**arguments)
    return retarder_parameters(retardance, azimuth, np.zeros_like(azimuth), flip_vertical)


def diattenuator_arguments(parameters: Parameters, flip_vertical: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``1 + |D|``, ``1 - |D|`` and the angle of the transmitting axis in [0, pi), radians.

    >>> [round(float(x), 3) for x in diattenuator_arguments(Parameters(-0.25, 0.3, 0.0, 0.0, 0.0), False)]
    [1.25, 0.75, 1.271]
    """
    p = reduced(parameters)
    angle = p.diattenuation_angle if flip_vertical else -p.diattenuation_angle
    angle = np.where(p.diattenuation < 0, angle + angle.dtype.type(pi / 2), angle)
    return 1 + np.abs(p.diattenuation), 1 - np.abs(p.diattenuation), half_turn(angle)


def diattenuator_parameters(axis: str, flip_vertical: bool, **arguments: Any) -> Parameters:
    """Canonical parameters (no retardance) of a diattenuator; NaN where it transmits nothing.

    The arguments are ``Tmax``, ``Tmin`` and the angle of the transmitting axis, which the package calls ``axis``.

    >>> [round(float(x), 3) for x in diattenuator_parameters("a", False, Tmax=0.5, Tmin=0.3, a=-0.3)]
    [0.25, 0.3, 0.0, 1.571, 0.0]
    """
    for name, value in arguments.items():
        if name != axis:
            real_array(name, value, low=0)
    values = dict(zip(arguments, real_arrays(**arguments), strict=True))
    largest, least, azimuth = values["Tmax"], values["Tmin"], values[axis]
    with np.errstate(invalid="ignore"):
        diattenuation = np.asarray((largest - least) / (largest + least))
    angle = azimuth if flip_vertical else -azimuth
    zero = np.zeros_like(diattenuation)
    return canonicalise(Parameters(diattenuation, angle, zero, zero, zero))
