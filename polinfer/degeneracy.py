"""Eight sets of parameters describe the same matrix: all of them, and one to stand for them."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np

from .checks import broadcast, real_array
from .records import Parameters

__all__ = ["REFERENCE", "canonicalise", "orbit", "reduce_ranges"]

REFERENCE = Parameters(1.0, pi / 4, pi, pi / 4, 0.0)


def _wrap(x: np.ndarray, period: float) -> np.ndarray:
    return x - (period * np.ceil(x / period - 0.5)).astype(x.dtype)


def _arrays(parameters: Parameters, name: str = "parameters") -> Parameters:
    values = [real_array(f"{name}.{field}", getattr(parameters, field)) for field in Parameters._fields]
    shape = broadcast(**{f: v.shape for f, v in zip(Parameters._fields, values, strict=True)})
    return Parameters(*(np.broadcast_to(v, shape) for v in values))


def reduce_ranges(parameters: Parameters) -> Parameters:
    """Angles reduced to their ranges. A retardance of exactly -pi stays: pi would be minus the matrix.

    >>> round(float(reduce_ranges(Parameters(0.0, 3.0, 0.5, 0.1, 0.0)).diattenuation_angle), 4)
    -0.1416
    """
    p = _arrays(parameters)
    retardance = np.where(np.abs(p.retardance) <= np.asarray(pi, p.retardance.dtype), p.retardance,
                          _wrap(p.retardance, 2 * pi))  # fmt: skip
    return Parameters(
        p.diattenuation,
        _wrap(p.diattenuation_angle, pi),
        retardance,
        _wrap(p.retardance_angle, pi),
        _wrap(p.circularity, 2 * pi),
    )


def orbit(parameters: Parameters) -> Parameters:
    """All eight parameter sets of the same elements, hence of the same Jones matrix.

    ``(theta_eta + pi/2, -eta)`` is the same retarder, so is ``(-theta_eta, xi + pi)``, and
    ``(-D, theta_D + pi/2)`` is the same polariser.

    Parameters
    ----------
    parameters: five real arrays that broadcast to shape P, radians.

    Returns
    -------
    Parameters of shape ``(8, *P)``, reduced to their ranges, in the order of Gordon et al. (supplementary
    information, "Degeneracy of solutions"); the first is the argument.

    >>> orbit(Parameters(0.1, 0.2, 0.5, 0.3, 0.0)).diattenuation.tolist()
    [0.1, 0.1, 0.1, 0.1, -0.1, -0.1, -0.1, -0.1]
    """
    p = _arrays(parameters)
    eta, angle, xi = p.retardance, p.retardance_angle, p.circularity
    quarter, half = np.asarray(pi / 2, angle.dtype), np.asarray(pi, xi.dtype)
    retarders = ((eta, angle, xi), (-eta, angle + quarter, xi), (eta, -angle, xi + half),
                 (-eta, quarter - angle, xi + half))  # fmt: skip
    polarisers = ((p.diattenuation, p.diattenuation_angle), (-p.diattenuation, p.diattenuation_angle + quarter))
    copies = [Parameters(*polariser, *retarder) for polariser in polarisers for retarder in retarders]
    return reduce_ranges(Parameters(*(np.stack(values) for values in zip(*copies, strict=True))))


def distance(parameters: Parameters, reference: Parameters) -> Any:
    """Squared distance, the angles of axes doubled and all angle differences wrapped."""
    p, r = parameters, reference
    return (
        _wrap(2 * (p.retardance_angle - r.retardance_angle), 2 * pi) ** 2
        + _wrap(p.retardance - r.retardance, 2 * pi) ** 2
        + _wrap(p.circularity - r.circularity, 2 * pi) ** 2
        + (p.diattenuation - r.diattenuation) ** 2
        + _wrap(2 * (p.diattenuation_angle - r.diattenuation_angle), 2 * pi) ** 2
    )


def nearest(copies: Parameters, reference: Parameters, allowed: Any = True) -> Parameters:
    """Of copies along the first axis, the allowed one nearest to the reference; the first among equals."""
    far = np.where(allowed, distance(copies, reference), np.inf)
    slack = 64 * np.finfo(far.dtype).eps
    first = np.argmax(far <= far.min(axis=0) * (1 + slack) + slack, axis=0)
    return Parameters(*(np.take_along_axis(values, first[None], axis=0)[0] for values in copies))


def canonicalise(parameters: Parameters, reference: Parameters = REFERENCE) -> Parameters:
    """The one of the eight equivalent parameter sets that is nearest to a reference point.

    The distance is ``d(2 theta_eta)^2 + d(eta)^2 + d(xi)^2 + d(D)^2 + d(2 theta_D)^2`` with angle differences wrapped
    to (-pi, pi]; equal distances go to the first in the order of :func:`orbit`.

    Parameters
    ----------
    parameters: five real arrays that broadcast to shape P, radians; NaN where there is no answer.
    reference: the point; by default ``theta_eta = pi/4, eta = pi, xi = 0, D = 1, theta_D = pi/4``.

    Source: Gordon et al., supplementary information, "Degeneracy of solutions".

    >>> p = canonicalise(Parameters(-0.2, -1.0, -0.5, 0.3 + np.pi / 2, 0.1))
    >>> [round(float(x), 3) for x in p]
    [0.2, 0.571, 0.5, 0.3, 0.1]
    """
    known = Parameters(*(np.where(np.isnan(x), 0, x) for x in _arrays(parameters)))
    chosen = nearest(orbit(known), _arrays(reference, "reference"))
    lost = [np.isnan(np.asarray(x, float)) for x in _arrays(parameters)]
    return Parameters(*(np.where(nan, np.asarray(np.nan, x.dtype), x) for nan, x in zip(lost, chosen, strict=True)))
