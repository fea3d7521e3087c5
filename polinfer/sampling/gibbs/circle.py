"""Distributions of one angle, held as (cosine, sine), many at a time and without a loop that waits for the slowest.

A variate that needs rejection is attempted a fixed number of times. If all attempts fail the old one stays: that they
fail does not depend on the old one, so each of these steps leaves its distribution unchanged, exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import pi
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...fitting.fast.point import Pair, rotate

__all__ = ["angle", "chord", "diattenuation", "half_circle", "quarter_sine", "slice_step", "two_harmonics", "von_mises"]

ATTEMPTS = 2  # each succeeds with a probability of 0.66 (high concentration) to 1
SHRINKS = 6  # of the interval of a slice
TINY = 1e-30
NONE = 2.0  # a candidate that stands for: not found
ROOT_HALF = 0.5**0.5
SAFE = 0.25  # share of the steps whose candidate has tails as wide as the density
NEWTON = 2  # steps to the mode of the diattenuation


@lru_cache
def _coefficients(function: Callable[[np.ndarray], np.ndarray], terms: int) -> tuple[float, ...]:
    """Of ``function(x) / x`` in powers of ``x^2`` on [0, 1], interpolated at Chebyshev points."""
    y = 0.5 + 0.5 * np.cos(pi * (np.arange(terms) + 0.5) / terms)
    x = np.sqrt(y)
    found = np.polynomial.Chebyshev.fit(y, function(x) / x, terms - 1, domain=[0, 1]).convert(
        kind=np.polynomial.Polynomial
    )
    return tuple(found.coef.tolist())  # numbers of Python take the precision of what they meet


def _odd(function: Callable[[np.ndarray], np.ndarray], terms: int, x: Any) -> Any:
    """An odd function, |x| <= 1, by so many terms."""
    coefficients = _coefficients(function, terms)
    square = x * x
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = total * square + coefficient
    return total * x


def _quarter_sine(x: np.ndarray) -> np.ndarray:
    return np.asarray(np.sin(0.5 * pi * x))


def quarter_sine(x: Any) -> Any:
    """``sin(pi x / 2)`` for ``|x| <= 1``.

    >>> bool(np.allclose(quarter_sine(jnp.linspace(-1, 1, 9)), np.sin(np.pi * np.linspace(-1, 1, 9) / 2), atol=1e-6))
    True
    """
    return _odd(_quarter_sine, 6 if x.dtype == np.float32 else 10, x)


def angle(pair: Pair) -> Any:
    """The angle of a unit vector in [-pi, pi], without the cases that ``arctan2`` must look at.

    >>> y = jnp.linspace(-3.14, 3.14, 99)
    >>> bool(np.allclose(angle((jnp.cos(y), jnp.sin(y))), y, atol=1e-6))
    True
    """
    a, b = jnp.abs(pair[0]), jnp.abs(pair[1])
    y = _odd(np.arctan, 9 if a.dtype == np.float32 else 22, jnp.minimum(a, b) / jnp.maximum(a, b))
    y = jnp.where(b > a, 0.5 * pi - y, y)
    y = jnp.where(pair[0] < 0, pi - y, y)
    return jnp.where(pair[1] < 0, -y, y)


def direction(b: Any, c: Any) -> tuple[Any, Pair]:
    """Length and direction of a vector; any direction where the length is 0."""
    square = b * b + c * c
    inverse = jax.lax.rsqrt(jnp.maximum(square, TINY))
    there = square > TINY
    return square * inverse, (jnp.where(there, b * inverse, 1), jnp.where(there, c * inverse, 0))


def chord(left: Pair, right: Pair) -> Any:
    """``1 - cos`` of the angle between two unit vectors, accurate where it is small."""
    x, y = left[0] - right[0], left[1] - right[1]
    return 0.5 * (x * x + y * y)


def _cauchy(u: Any, p: Any) -> tuple[Any, Any, Any]:
    """``cos^2``, ``p sin^2`` and ``sin cos`` of ``pi u / 2``."""
    q, r = quarter_sine(u), quarter_sine(1 - jnp.abs(u))
    return r * r, p * q * q, q * r


def _attempts(random: Any, concentration: Any, mean: Pair) -> tuple[Pair, Any]:
    """Von Mises variates, and where none of the attempts succeeded.

    Candidates are wrapped Cauchy, ``tan(phi / 2) = s tan(pi u / 2)``; with ``x = sin^2(phi / 2)`` the ratio of the
    densities is ``exp(-2 k x) (p + (1 - p) x)``, ``p = s^2``, and the acceptance is best for ``p^2 + 4 k p = 1`` (Best
    and Fisher, Appl. Statist. 28, 152, 1979, in a form without cancellation).
    """
    k = concentration
    p = 1 / (2 * k + jnp.sqrt(1 + 4 * k * k))
    s, highest = jnp.sqrt(p), 0.5 * (1 - p)
    chosen: Any = NONE
    for _ in range(ATTEMPTS):
        u, v = random.kept(random.signed()), random.uniform()
        a, b, _ = _cauchy(u, p)
        x = b / (a + b)
        ok = (v * 2 * p * jnp.exp(2 * k * x - highest) <= (p + (1 - p) * x) * (1 + p)) & (chosen == NONE)
        chosen = jnp.where(ok, u, chosen)
    chosen = random.kept(chosen)
    found = chosen != NONE
    a, b, both = _cauchy(chosen, p)
    scale = 1 / (a + b)
    cosine, sine = random.kept(((a - b) * scale, 2 * s * both * scale))
    return (mean[0] * cosine - mean[1] * sine, mean[1] * cosine + mean[0] * sine), found


def _choose(where: Any, new: Pair, old: Pair) -> Pair:
    return jnp.where(where, new[0], old[0]), jnp.where(where, new[1], old[1])


def von_mises(random: Any, b: Any, c: Any, old: Pair) -> Pair:
    """A variate of density ``exp(b cos y + c sin y)``."""
    new, found = _attempts(random, *direction(b, c))
    return _choose(found, new, old)


def half_circle(random: Any, b: Any, c: Any, old: Pair) -> Pair:
    """A step that leaves ``exp(b cos y + c sin y)`` on ``cos y >= 0`` unchanged.

    The candidate is a von Mises variate folded into the half circle, corrected by its density. Where the mean is
    outside, the density falls from the nearer bound, and so does that of the candidate: mostly as steeply there, and
    one time in four with the wider tail of the density, so that no place is hard to leave.
    """
    outside = b < 0
    slope = jnp.where(outside, 0, b)
    size = jnp.maximum(jnp.abs(c), 1e-6)
    across = jnp.where(outside & (random.uniform() > SAFE), c * (1 + 0.4 * b * b / size), c)
    new, found = _attempts(random, *direction(slope, across))
    new = (jnp.abs(new[0]), new[1])

    def folded(pair: Pair) -> Any:
        return jnp.log1p(jnp.exp(-2 * slope * pair[0]))

    change = (b - slope) * (new[0] - old[0]) + (c - across) * (new[1] - old[1]) + folded(old) - folded(new)
    return _choose(found & (random.uniform() < jnp.exp(change)), new, old)


def diattenuation(random: Any, b: Any, c: Any, linear: Any, square: Any, old: Pair) -> Pair:
    """A step that leaves the density of half the angle ``delta``, ``D = sin delta``, unchanged.

    The log density of ``y = delta / 2`` in [-pi/4, pi/4] is ``b cos y + c sin y + linear D - square D^2 / 2 + log cos
    delta``, the last from ``dD = cos delta d delta``. The candidate is a von Mises variate about the mode.
    """
    # the search begins at the mean of the von Mises part with the slope of the linear one; near or beyond the edge at
    # the mode of e exp(-fall e - bent e^2 / 2), e the distance from it
    _, (x, y) = direction(b, c + 2 * linear)
    side = jnp.where(y < 0, -1, 1)
    fall, bent = (ROOT_HALF * (side * c + sign * b) for sign in (-1, 1))
    bent = bent + 4 * side * linear
    e = 2 / jnp.maximum(fall + jnp.sqrt(fall * fall + 4 * jnp.maximum(bent, 0)), 4)
    near = rotate((jnp.full_like(x, ROOT_HALF), jnp.full_like(x, ROOT_HALF)), -e)
    x, y = _choose(jnp.abs(y) > 0.6 * x, (near[0], side * near[1]), (x, y))

    def bend(x: Any, y: Any, d: Any, k: Any) -> Any:
        """Curvature without that of ``log k``."""
        return b * x + c * y + 4 * d * (linear - square * d) + 4 * k * k * square

    for _ in range(NEWTON):
        d, k = 2 * x * y, x * x - y * y
        slope = c * x - b * y + 2 * k * (linear - square * d) - 2 * d / k
        own = 4 / (k * k)
        step = slope / jnp.maximum(bend(x, y, d, k) + own, own)
        x, y = rotate((x, y), jnp.clip(step, -0.35 * k, 0.35 * k))
    d, k = 2 * x * y, x * x - y * y
    # an edge and the linear part add to the curvature at the mode, but not far from it, where a narrow candidate would
    # hardly ever go
    bent = jnp.maximum(bend(x, y, d, k), 0)
    wide = bent - jnp.maximum(4 * d * linear, 0)
    curvature = jnp.where(random.uniform() > SAFE, bent + 2 / (k * k), jnp.maximum(wide, 0.2 * bent))
    concentration = jnp.maximum(curvature, 1)
    new, found = _attempts(random, concentration, (x, y))
    (d, k), (e, m) = ((2 * p * q, p * p - q * q) for p, q in (new, old))
    inside = (new[0] > 0) & (k > TINY)
    change = (b - concentration * x) * (new[0] - old[0]) + (c - concentration * y) * (new[1] - old[1])
    change = change + (d - e) * (linear - 0.5 * square * (d + e))
    change = change + jnp.log(jnp.where(inside, k, 1) / jnp.maximum(m, TINY))
    return _choose(found & inside & (random.uniform() < jnp.exp(change)), new, old)


def two_harmonics(random: Any, first: Pair, second: Pair, old: Pair) -> Pair:
    """A step that leaves ``exp(b cos y + c sin y + d cos 2y + e sin 2y)`` unchanged; (b, c) and (d, e) are given.

    The candidate is a von Mises variate about the mode, one time in four with tails as wide as the density's, or, one
    time in four, a wide one about the old angle, which comes out of wherever candidates about the mode seldom go.
    """
    (b, c), (d, e) = first, second
    size, (x, y) = direction(b, c)
    most = size + 4 * (jnp.abs(d) + jnp.abs(e))
    for _ in range(NEWTON + 1):
        x2, y2 = x * x - y * y, 2 * x * y
        slope = c * x - b * y + 2 * (e * x2 - d * y2)
        bend = b * x + c * y + 4 * (d * x2 + e * y2)
        x, y = rotate((x, y), jnp.clip(slope / jnp.maximum(bend, 0.1 * most + TINY), -0.5, 0.5))
    x2, y2 = x * x - y * y, 2 * x * y
    # the density about the mode, by the angle from it: a (cos - 1) + t sin + a2 (cos 2 - 1) + t2 sin 2
    a, t = b * x + c * y, c * x - b * y
    a2, t2 = d * x2 + e * y2, e * x2 - d * y2
    concentration = jnp.maximum(a + 4 * a2, 0)
    kind = random.uniform()
    walk = kind < SAFE
    concentration = jnp.where(kind > 1 - SAFE, jnp.clip(a, 0.2 * concentration, concentration), concentration)
    old_from = (old[0] * x + old[1] * y, old[1] * x - old[0] * y)
    one, zero = jnp.ones_like(x), jnp.zeros_like(x)
    new_from, found = _attempts(random, jnp.where(walk, 0.3, 1) * concentration, _choose(walk, old_from, (one, zero)))
    own = a - jnp.where(walk, 0, concentration)

    def log_ratio(pair: Pair) -> Any:
        c, s = pair
        return -own * chord(pair, (one, zero)) + s * (t - 2 * a2 * s + 2 * t2 * c)

    found = found & (random.uniform() < jnp.exp(log_ratio(new_from) - log_ratio(old_from)))
    new = (new_from[0] * x - new_from[1] * y, new_from[1] * x + new_from[0] * y)
    return _choose(found, new, old)


def slice_step(random: Any, log_density: Callable[[Pair], Any], width: Any, old: Pair) -> Pair:
    """A step that leaves any density of an angle unchanged (Neal, Ann. Statist. 31, 705, 2003).

    ``log_density`` of a pair, relative to any constant; the interval of ``width`` <= 2 pi radians about the old angle
    shrinks at most ``SHRINKS`` times.
    """
    dtype = old[0].dtype.type
    level = log_density(old) + jnp.log(random.uniform())
    low = -width * random.uniform()
    high = low + width
    found, best = jnp.zeros(old[0].shape, bool), old
    for _ in range(SHRINKS):
        turn = low + (high - low) * random.uniform()
        half = turn * dtype(1 / (2 * pi))  # of a half turn, in quarter turns: |turn| <= 2 pi
        q, r = quarter_sine(half), quarter_sine(1 - jnp.abs(half))
        # (r, q) is the unit vector of turn / 4
        c, s = r * r - q * q, 2 * q * r
        c, s = c * c - s * s, 2 * s * c
        new = (old[0] * c - old[1] * s, old[1] * c + old[0] * s)
        ok = log_density(new) > level
        best = _choose(ok & ~found, new, best)
        found = found | ok
        low, high = jnp.where(turn < 0, turn, low), jnp.where(turn < 0, high, turn)
    length = 1.5 - 0.5 * (best[0] * best[0] + best[1] * best[1])
    return best[0] * length, best[1] * length
