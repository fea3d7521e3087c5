"""Eight sets of parameters describe the same matrix: all of them, and one to stand for them."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np

from .checks import broadcast, real_array
from .records import Parameters

__all__ = ["REFERENCE", "canonicalise", "orbit", "reduce_ranges"]

REFERENCE = Parameters(1.0, pi / 4, pi, pi / 4, 0.0)
TIE, EQUAL = 64, 4  # what rounding does to distances and to values, in units of the precision


def _wrap(x: np.ndarray, period: float) -> np.ndarray:
    return x - (period * np.ceil(x / period - 0.5)).astype(x.dtype)


def _angle(x: np.ndarray, period: float) -> np.ndarray:
    """``x`` in (-period/2, period/2]; within rounding of the end that is left out it is at the other one."""
    end = np.asarray(0.5 * period, x.dtype)
    wrapped = np.minimum(_wrap(x, period), end)  # the sum may be rounded to beyond the end
    return np.where(wrapped <= EQUAL * float(np.finfo(x.dtype).eps) - end, end, wrapped)


def _arrays(parameters: Parameters, name: str = "parameters") -> Parameters:
    values = [real_array(f"{name}.{field}", getattr(parameters, field)) for field in Parameters._fields]
    shape = broadcast(**{f: v.shape for f, v in zip(Parameters._fields, values, strict=True)})
    return Parameters(*(np.broadcast_to(v, shape) for v in values))


def reduce_ranges(parameters: Parameters) -> Parameters:
    """Angles reduced to their ranges. A retardance of exactly -pi stays: pi would be minus the matrix.

    The other angles, if within 4 eps of the end that their range leaves out (-pi/2, -pi), are put to the other end.

    >>> round(float(reduce_ranges(Parameters(0.0, 3.0, 0.5, 0.1, 0.0)).diattenuation_angle), 4)
    -0.1416
    """
    p = _arrays(parameters)
    end = np.asarray(pi, p.retardance.dtype)
    retardance = np.where(np.abs(p.retardance) <= end, p.retardance, np.minimum(_wrap(p.retardance, 2 * pi), end))
    return Parameters(
        p.diattenuation,
        _angle(p.diattenuation_angle, pi),
        retardance,
        _angle(p.retardance_angle, pi),
        _angle(p.circularity, 2 * pi),
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


def _distances(parameters: Parameters, reference: Parameters) -> tuple[Any, Any]:
    """Squared distances of the polarisers and of the retarders."""
    p, r = parameters, reference
    return (
        (p.diattenuation - r.diattenuation) ** 2
        + _wrap(2 * (p.diattenuation_angle - r.diattenuation_angle), 2 * pi) ** 2,
        _wrap(2 * (p.retardance_angle - r.retardance_angle), 2 * pi) ** 2
        + _wrap(p.retardance - r.retardance, 2 * pi) ** 2
        + _wrap(p.circularity - r.circularity, 2 * pi) ** 2,
    )


def distance(parameters: Parameters, reference: Parameters) -> Any:
    """Squared distance, the angles of axes doubled and all angle differences wrapped."""
    polariser, retarder = _distances(parameters, reference)
    return polariser + retarder


def _tied(distances: np.ndarray, eps: float) -> np.ndarray:
    """Which copies along the first axis are nearest, as far as rounding can tell."""
    least = distances.min(axis=0)
    return distances <= least + TIE * eps * (1 + least)


def nearest(copies: Parameters, reference: Parameters, allowed: Any = True) -> Parameters:
    """Of copies along the first axis, ``(copies, *P)``, the allowed one that :func:`canonicalise` would choose.

    Where a copy is allowed whose polariser and whose retarder are both nearest, the elements choose one by one;
    else, nearest and tied are meant for the sum of the two distances.
    """
    dtype = np.result_type(*copies)
    eps = max(float(np.finfo(x.dtype).eps) for x in copies)
    apart = _distances(copies, Parameters(*(np.asarray(x, dtype) for x in reference)))
    polarisers, retarders = (np.where(allowed, x, np.inf) for x in apart)
    tied = _tied(polarisers, eps) & _tied(retarders, eps)
    coupled = ~tied.any(axis=0)
    if coupled.any():
        tied = np.where(coupled, _tied(polarisers + retarders, eps), tied)
    values = [np.broadcast_to(x, tied.shape) for x in copies]
    several = np.count_nonzero(tied, axis=0) > 1
    if several.any():
        left = tied[:, several]
        for x in (value[:, several] for value in values):
            left &= x >= np.max(x, axis=0, where=left, initial=-np.inf) - EQUAL * eps
        tied[:, several] = left
    first = np.argmax(tied, axis=0)[None]
    # + 0 makes 0 of -0, which would be another number in files and on screens
    return Parameters(*(np.take_along_axis(x, first, axis=0)[0] + 0 for x in values))


def canonicalise(parameters: Parameters, reference: Parameters = REFERENCE) -> Parameters:
    """The one of the eight equivalent parameter sets that is nearest to a reference point.

    The distance is ``d(2 theta_eta)^2 + d(eta)^2 + d(xi)^2 + d(D)^2 + d(2 theta_D)^2`` with angle differences wrapped
    to (-pi, pi], a sum of one part for each element. So each chooses for itself: the polariser between its two copies,
    the retarder among its four. Squared distances that agree within ``64 eps (1 + distance)`` are a tie, with eps that
    of the precision; of tied copies the one with the larger D, then the larger theta_D, is taken, and of retarders the
    one with the larger eta, then theta_eta, then xi, where values within 4 eps are equal. Angles within 4 eps of the
    end that their range leaves out (-pi/2, -pi) are first put to the other end.

    The choice does not depend on which of the copies came, so all of them have one canonical member, up to rounding,
    and that one its own. The choice must jump somewhere: it jumps 64 eps beside a tie, where no special value lies.

    With the default reference the result has theta_eta in [0, pi/2], xi in [-pi/2, pi/2] and eta of either sign, and
    ``D >= 0`` if the transmitting axis is in ``[-|D|/pi, pi/2 + |D|/pi]``, else ``D < 0``; all this as far as ties are
    narrow (an axis some 10 eps beyond pi/2 is written as one beyond -pi/2). A retardance of -pi is not pi (J changes
    sign) and stays -pi, unless the copy with pi is the one to choose.

    Parameters
    ----------
    parameters: five real arrays that broadcast to shape P, radians; NaN where there is no answer.
    reference: the point; by default ``theta_eta = pi/4, eta = pi, xi = 0, D = 1, theta_D = pi/4``. Arrays broadcast to
        shape P.

    Returns
    -------
    Parameters of shape P, in the precision that came.

    Raises
    ------
    TypeError, ValueError: arrays that are not real or do not broadcast.

    Source: Gordon et al., supplementary information, "Degeneracy of solutions". Of equally near sets the first in the
    source's list is meant there, which begins with the set one happens to have; here the result is the same for all.

    >>> p = canonicalise(Parameters(-0.2, -1.0, -0.5, 0.3 + np.pi / 2, 0.1))
    >>> [round(float(x), 3) for x in p]
    [0.2, 0.571, 0.5, 0.3, 0.1]
    >>> tie = canonicalise(orbit(Parameters(0.0, 0.0, -0.5, 0.3, np.pi / 2)))
    >>> [set(x.round(3).tolist()) for x in tie]
    [{0.0}, {1.571}, {0.5}, {1.271}, {-1.571}]
    """
    given = _arrays(parameters)
    point = _arrays(reference, "reference")
    shape = given.diattenuation.shape
    if broadcast(parameters=shape, reference=point.diattenuation.shape) != shape:
        raise ValueError(
            f"reference has shape {point.diattenuation.shape}, more than the parameters' {shape}; make them agree."
        )
    known = Parameters(*(np.where(np.isnan(x), np.zeros_like(x), x) for x in given))
    chosen = nearest(orbit(known), point)
    return Parameters(*(np.where(np.isnan(x), np.full_like(x, np.nan), y) for x, y in zip(given, chosen, strict=True)))
