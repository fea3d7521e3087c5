"""The log evidence of every pixel from its draws, with a standard error.

For any point p* of the polariser, ``p(data) = p(data, p*) / p(p* | data)``. The denominator is the mean over the draws
of ``p(p* | retarder, gain, data)``, which is known in closed form but for one integral over D. The numerator is an
integral over the retarder alone, three dimensions by quadrature, with the gain integrated out (Chib, J. Am. Stat.
Assoc. 90, 1313, 1995, with two blocks). The integral runs where the draws lie. Everything is computed in double
precision with NumPy.
"""

from __future__ import annotations

from math import log, pi
from typing import Any, NamedTuple

import numpy as np
from scipy.special import i0e, logsumexp

from ...fitting.fast.overlap import Pauli, coefficients, imaginary, quadratic_forms, turned
from ...fitting.fast.point import dot, polariser_vector, retarder_vector
from ...fitting.fast.priors import COPIES
from .plan import Any1D, Plan, conjugate, normal

__all__ = ["Given", "log_evidence", "unavailable"]

MOST_DRAWS = 4000  # of which the denominator is averaged
NODES = 28  # for the integral over D on either side of 0
GRIDS = ((16, 24), (32, 48))  # numbers of nodes in each direction: compared, and larger where they differ
CLOSE = 1e-3  # nat
WIDER = 0.6  # of the range of the draws, on either side
POLE = 1e-9


class Given(NamedTuple):
    """Of some pixels, in double precision: ``product`` and ``power`` as in :class:`.sweep.Observed`.

    ``point``: the five angles ``y`` of p*, ``(5, pixels)``; ``constant``: ``log p(data | p)`` less the part that
    depends on parameters, ``(pixels)``. ``retarder``: the angles ``y`` ``(3, draws, pixels)`` of the draws, chain by
    chain, ``gain`` complex ``(draws, pixels)`` or None.
    """

    product: Pauli
    power: Pauli
    balanced: bool
    point: np.ndarray
    constant: np.ndarray
    retarder: np.ndarray
    gain: np.ndarray | None
    chains: int


def unavailable(plan: Plan) -> str | None:
    """Why the evidence of a model is not computed this way, None if it is."""
    if plan.noise != "known":
        return "sigma is not known"
    if {2, 3, 4} & set(plan.free) not in ({2, 3, 4}, set()):
        return "a part of the retarder is fixed"
    if 0 in plan.free and (plan.prior[0] is None or normal(plan.prior[0]) is None):
        return "the prior of the diattenuation is neither flat nor normal"
    added = conjugate(plan.prior[1])
    if 1 in plan.free and (added is None or added[2:] != (0.0, 0.0)):
        return "the prior of the diattenuation's angle is neither flat nor von Mises"
    return None


def _pair(y: Any) -> tuple[Any, Any]:
    return np.cos(y), np.sin(y)


def _log_prior(plan: Plan, index: int, y: Any) -> Any:
    """Log prior density of one parameter, normalised."""
    own = plan.prior[index]
    if own is None:
        return 0.0
    found = own.evaluate(_pair(y))
    value = 0.0 if found is None else np.asarray(found[0], float)
    return value if isinstance(own, Any1D) else value + own.constant


def _stokes(plan: Plan, given: Given, q: list[Any]) -> list[Any] | None:
    """z and x components of the light's Stokes vector where it meets the polariser; None: balanced."""
    if given.balanced:
        return None
    if not plan.retarder_first:
        return [given.power.z[0], given.power.x[0]]
    forms = quadratic_forms(given.power)
    return [dot(q, [dot(row, q) for row in form]) for form in forms]


def _log_conditional(plan: Plan, given: Given, retarder: np.ndarray, gain: np.ndarray | None) -> np.ndarray:
    """``log p(p* | retarder, gain, data)`` in D and theta_D, for every draw ``(draws, pixels)``."""
    k, weight = given.product, np.ones(())
    if gain is not None:
        k, weight = turned(k, (gain.real, gain.imag)), np.abs(gain) ** 2
    q = retarder_vector(*map(_pair, retarder))
    v = [2 * sum(t * x for t, x in zip(row, q, strict=True)) for row in coefficients(plan.retarder_first, k)]
    stokes = _stokes(plan, given, q)
    y0, y1 = given.point[0], given.point[1]
    added = conjugate(plan.prior[1]) if 1 in plan.free else (0.0, 0.0)
    assert added is not None

    def around(y: Any) -> tuple[Any, Any, Any]:
        """The log density of ``y0`` but for the term of ``y1``, and the two coefficients of that one."""
        c, s = _pair(y)
        d = 2 * s * c
        b, e = s * v[1], s * v[2]
        if stokes is not None:
            b, e = b - weight * d * stokes[0], e + weight * d * stokes[1]
        own = normal(plan.prior[0]) if 0 in plan.free else (0.0, 0.0)
        assert own is not None
        return v[0] * c + own[0] * d - 0.5 * own[1] * d * d, b + added[0], e + added[1]

    def marginal(y: Any) -> Any:
        """The same with ``y1`` integrated out or fixed."""
        value, b, e = around(y)
        if 1 not in plan.free:
            x, z = _pair(y1)
            return value + b * x + e * z
        size = np.hypot(b, e)
        return value + size + np.log(2 * pi * i0e(size))

    result = np.zeros(np.broadcast_shapes(retarder.shape[1:]))
    if 1 in plan.free:
        _, b, e = around(y0)
        size = np.hypot(b, e)
        x, z = _pair(y1)
        # 2: from the angle 2 theta_D to theta_D
        result = result + b * x + e * z - size - np.log(2 * pi * i0e(size)) + log(2)
    if 0 in plan.free:
        result = result + marginal(y0) - _log_integral(v, marginal)
    return result


def _log_integral(v: list[Any], marginal: Any) -> np.ndarray:
    """Log of the integral over D of ``exp(marginal)``, on both sides of 0."""
    x, w = np.polynomial.legendre.leggauss(NODES)
    across = np.hypot(v[1], v[2])
    mode = np.clip(np.arctan2(across, v[0]), 0, 0.25 * pi)
    size = np.hypot(across, v[0])
    # beyond the edge the density falls with this slope from it
    slope = np.maximum(np.sqrt(0.5) * (across - v[0]), 0)
    reach = np.minimum(9 / np.sqrt(4 + size), np.where(mode > 0.249 * pi, 45 / np.maximum(slope, 1e-9), np.inf))
    parts = []
    for sign in (1, -1):
        low, high = np.maximum(mode - reach, 0), np.minimum(mode + reach, 0.25 * pi)
        half = 0.5 * (high - low)
        for node, weight in zip(x, w, strict=True):
            y = low + half * (1 + node)
            # dD = 2 cos(2 y) dy
            parts.append(marginal(sign * y) + np.log(2 * weight * half * np.maximum(np.cos(2 * y), 1e-300)))
    return np.asarray(logsumexp(np.stack(parts), axis=0))


def _log_joint(plan: Plan, given: Given, nodes: int) -> np.ndarray:
    """``log p(data, p*)``: likelihood times priors, the retarder and the gain integrated out, (pixels)."""
    u = polariser_vector(*map(_pair, given.point[:2]))
    forms = [coefficients(plan.retarder_first, k) for k in (given.product, imaginary(given.product))]
    w = [[sum(t[i][j] * u[i] for i in range(3)) for j in range(4)] for t in forms]
    prior = sum(np.asarray(_log_prior(plan, i, given.point[i])) for i in (0, 1))
    if not {2, 3, 4} & set(plan.free):
        q = retarder_vector(*map(_pair, given.point[2:]))
        return given.constant + prior + _log_likelihood(plan, given, w, q, given.point)
    pixels = given.point.shape[1]
    parts = np.array_split(np.arange(pixels), max(pixels * nodes**3 // 400_000, 1))  # to stay in the cache
    found = [_retarder_integral(plan, _take(given, p), [[x[p] for x in row] for row in w], nodes) for p in parts]
    return given.constant + prior + np.concatenate(found)


def _take(given: Given, part: np.ndarray) -> Given:
    cut = lambda k: Pauli(*((re[part], im[part]) for re, im in k))  # noqa: E731
    return given._replace(
        product=cut(given.product),
        power=cut(given.power),
        point=given.point[:, part],
        constant=given.constant[part],
        retarder=given.retarder[..., part],
    )


def _log_likelihood(plan: Plan, given: Given, w: list[list[Any]], q: list[Any], point: np.ndarray) -> Any:
    """Log likelihood of p* and retarders q up to the constant, the gain integrated out."""
    re, im = (sum(a * x for a, x in zip(row, q, strict=True)) for row in w)
    energy = given.power.one[0]
    shape = np.ndim(re) - np.ndim(energy)
    spread = lambda x: np.reshape(x, np.shape(x) + (1,) * shape)  # noqa: E731
    energy = spread(energy)
    if not given.balanced:
        wide = given._replace(power=Pauli(*((spread(a), spread(b)) for a, b in given.power)))
        stokes = _stokes(plan, wide, q)
        assert stokes is not None
        (c, s), (x, y) = _pair(point[0]), _pair(point[1])
        energy = energy + spread(2 * s * c * x) * stokes[0] - spread(2 * s * c * y) * stokes[1]
    if plan.gain == "unit":
        return 2 * re - energy
    if plan.gain == "phase":
        size = 2 * np.hypot(re, im)
        return size + np.log(i0e(size)) - energy
    return (re * re + im * im) / (energy + plan.gain_precision) - np.log1p(energy / plan.gain_precision)


def _retarder_integral(plan: Plan, given: Given, w: list[list[Any]], nodes: int) -> np.ndarray:
    """Log of the integral over the retarder of likelihood times prior.

    Over one of the four equivalent parts of its range, ``y2`` in [0, pi/2], ``y3`` in [0, pi]; the priors of the four
    are added. ``d eta d theta d xi = dy2 dy3 dy4``.
    """
    x, weight = np.polynomial.legendre.leggauss(nodes)
    points, weights = [], []
    for axis, (low, high) in enumerate(_box(given.retarder)):
        half = 0.5 * (high - low)
        shape: list[Any] = [slice(None), None, None, None]
        shape[axis + 1] = slice(None)
        points.append((low[:, None] + half[:, None] * (1 + x))[tuple(shape)])
        weights.append((np.log(half)[:, None] + np.log(weight))[tuple(shape)])
    expand = [[a[:, None, None, None] for a in row] for row in w]
    value = _log_likelihood(plan, given, expand, retarder_vector(*map(_pair, points)), given.point)
    priors = []
    for copy in COPIES[:4]:
        moved = [sign * y + shift for y, (sign, shift) in zip(points, copy[2:], strict=True)]
        priors.append(sum(np.asarray(_log_prior(plan, i, y)) for i, y in zip((2, 3, 4), moved, strict=True)))
    total = value + np.logaddexp.reduce(np.broadcast_arrays(*priors)) + sum(weights)
    return np.asarray(logsumexp(total, axis=(1, 2, 3)))


def _box(draws: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Where draws of the retarder lie, with a margin, in the part of the range that is integrated over."""
    y2, y3, y4 = draws
    y2 = np.remainder(y2 + pi, 2 * pi) - pi
    # the other sign of the quaternion, then y2 >= 0, then y3 >= 0
    back = np.abs(y2) > 0.5 * pi
    y2 = np.where(back, y2 - np.sign(y2) * pi, y2)
    y3 = np.where(y2 < 0, y3 + pi, y3)
    y2 = np.abs(y2)
    y3 = np.remainder(y3 + pi, 2 * pi) - pi
    y4 = np.where(y3 < 0, y4 + pi, y4)
    y3 = np.abs(y3)
    found = []
    for y, top in ((y2, 0.5 * pi), (y3, pi)):
        low, high = y.min(axis=0), y.max(axis=0)
        margin = WIDER * (high - low) + POLE
        found.append((np.maximum(low - margin, 0), np.minimum(high + margin, top)))
    centre = np.angle(np.mean(np.exp(1j * y4), axis=0))
    off = np.remainder(y4 - centre + pi, 2 * pi) - pi
    reach = np.minimum((1 + 2 * WIDER) * np.abs(off).max(axis=0) + POLE, pi)
    found.append((centre - reach, centre + reach))
    return found


def log_evidence(plan: Plan, given: Given) -> tuple[np.ndarray, np.ndarray]:
    """Log evidence (nats) and its standard error, both (pixels)."""
    error = np.zeros(given.point.shape[1])
    density = np.zeros_like(error)
    if {0, 1} & set(plan.free):
        values = _log_conditional(plan, given, given.retarder, given.gain)
        top = values.max(axis=0)
        weight = np.exp(values - top)
        mean = weight.mean(axis=0)
        density = top + np.log(mean)
        # batches of every chain, which draws along it correlate
        batches = weight.reshape(given.chains * 10, -1, weight.shape[-1]).mean(axis=1)
        error = batches.std(axis=0, ddof=1) / (len(batches) ** 0.5 * mean)
    joint = np.full_like(density, np.nan)
    apart = np.zeros_like(density)
    todo = np.arange(len(joint))
    for coarse, fine in GRIDS:
        some = _take(given, todo)
        found = _log_joint(plan, some, fine)
        apart[todo] = np.abs(found - _log_joint(plan, some, coarse))
        joint[todo] = found
        todo = todo[apart[todo] > CLOSE]
        if len(todo) == 0:
            break
    return joint - density, np.hypot(error, apart)
