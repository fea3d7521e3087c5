"""At the maximum: parameters, covariance, evidence, and what there is to be said about the pixel."""

from __future__ import annotations

from functools import partial
from math import log, pi
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ...degeneracy import REFERENCE
from ...records import PERIODS, Parameters
from ..local_gaussian import uniform_std
from .climb import LEAST_CURVATURE, Place, Posterior, frozen, held, lowest_pivot, precise_enough
from .data import Data
from .known import ZERO
from .linear import Triangle, factorise, inverse, solve
from .point import Pair, Point, sine_of_double
from .priors import COPIES, FACTORS, log_prior
from .scene import Outline, Scene

__all__ = ["CONVERGED", "DOUBTFUL", "FROZEN", "NON_FINITE", "ROUGH", "ROWS", "WIDE", "Maximum", "describe", "maximum",
           "rows"]  # fmt: skip

# bits of the flags
CONVERGED, DOUBTFUL, NON_FINITE, WIDE, ROUGH = 1, 2, 4, 32, 64
FROZEN = {0: 8, 2: 16}  # the maximum lies on a bound of the diattenuation, of the retardance
# The gradient is a sum of products of data and model: rounded like this times eps times the square of the SNR.
ROUNDING = 0.25
MANY = 0.02  # variance of the angles of J (rad^2) beyond which the closed form may start in the wrong valley

# rows of the result, each an array of pixels
ROWS: dict[str, Any] = {"parameters": slice(0, 5), "std": slice(5, 10), "covariance": slice(10, 35)}
ROWS |= {"log_posterior": 35, "log_evidence": 36, "chi_square": 37, "slope_0": 38, "slope_2": 39}
ROWS |= {"gain_real": 40, "gain_imaginary": 41}


def rows(scene: Scene) -> int:
    """Number of rows of the result."""
    return 42 if scene.likelihood.free_phase else 40


def _wrap(x: Any, period: float) -> Any:
    return x - period * jnp.ceil(x / period - 0.5)


def _lexicographic(left: list[Any], right: list[Any], slack: float) -> Any:
    """Whether ``left`` comes before ``right``: larger in the first entry in which they differ."""
    found: Any = False
    for a, b in zip(reversed(left), reversed(right), strict=True):
        found = jnp.where(jnp.abs(a - b) <= slack, found, a > b)
    return found


def _choose(outline: Outline, one: Any, point: Point, values: Parameters) -> tuple[Parameters, dict[int, Any]]:
    """Of the copies with the highest prior the canonical one, and the sign of every angle in it.

    Distance and prior are sums over the two elements, so each chooses for itself.
    """
    out: dict[str, Any] = {}
    signs: dict[int, Any] = {}
    for indices in ((0, 1), (2, 3, 4)):
        moves, candidates = [], []
        for row, copy in zip(outline.copies, COPIES, strict=True):
            move = tuple(copy[i] for i in indices)
            if row and move not in moves:
                moves.append(move)
                candidates.append(_candidate(outline, indices, copy, point, values))
        chosen = _best(candidates, values) / one
        for m, i in enumerate(indices):
            value: Any = candidates[0].values[m]
            sign: Any = moves[0][m][0]
            alike = all(move[m][0] == sign for move in moves)
            for k in range(1, len(moves)):
                value = jnp.where(chosen == k, candidates[k].values[m], value)
                sign = sign if alike else jnp.where(chosen == k, moves[k][m][0], sign)
            out[Parameters._fields[i]], signs[i] = value, sign
    return Parameters(**out), signs


class _Candidate(NamedTuple):
    """Parameters of one element, their log prior and their squared distance from the reference."""

    values: list[Any]
    prior: Any
    distance: Any


def _candidate(
    outline: Outline, indices: tuple[int, ...], copy: tuple[tuple[int, float], ...], point: Point, values: Parameters
) -> _Candidate:
    part = tuple(
        None if term is None or i not in indices else term.transformed(*copy[i]) for i, term in enumerate(outline.prior)
    )
    found, far = [], 0.0
    for i in indices:
        name, (sign, shift) = Parameters._fields[i], copy[i]
        value = sign * values[i]
        if name == "diattenuation":
            far = far + (value - REFERENCE.diattenuation) ** 2
        else:
            period = PERIODS[i]
            if shift:
                value = value + shift / FACTORS[i]
                value = jnp.where(value > 0.5 * period, value - period, value)
            if sign < 0 and name != "retardance":
                value = _wrap(value, period)
            weight = 2.0 if period < 2 * pi else 1.0  # angles of axes count double
            far = far + _wrap(weight * (value - REFERENCE[i]), 2 * pi) ** 2
        found.append(value)
    return _Candidate(found, log_prior(part, point), far)


def _best(candidates: list[_Candidate], values: Parameters) -> Any:
    """Number of the candidate that :func:`polinfer.canonicalise` would take of those with the highest prior."""
    eps = float(jnp.finfo(values.diattenuation.dtype).eps)
    slack, room = 64 * eps, 1e-6 if eps < 1e-10 else 1e-3
    best, number = candidates[0], jnp.zeros_like(values.diattenuation)
    for k, new in enumerate(candidates[1:], start=1):
        tied = jnp.abs(new.distance - best.distance) <= slack * (1 + best.distance)
        nearer = jnp.where(tied, _lexicographic(new.values, best.values, 4 * eps), new.distance < best.distance)
        better = jnp.where(jnp.abs(new.prior - best.prior) <= room, nearer, new.prior > best.prior)
        best = jax.tree.map(partial(jnp.where, better), new, best)
        number = jnp.where(better, k, number)
    return number


def _values(outline: Outline, one: Any, point: Point) -> Parameters:
    found = []
    for i, (pair, value) in enumerate(zip(point, outline.values, strict=True)):
        if value is not None:
            found.append(jnp.full_like(one, value))
        else:
            found.append(jnp.arctan2(pair[1], pair[0]) / FACTORS[i] if i else sine_of_double(pair))
    return Parameters(*found)


class Maximum(NamedTuple):
    """What a climb has reached: the point, the mean gain (None: there is none) and the log posterior there, the squared
    residual of all data, ``|Y|`` and the derivatives of the log posterior."""

    point: Point
    gain: Pair | None
    value: Any
    square: Any
    strength: Any
    whole: Posterior


def maximum(scene: Scene, data: Data, place: Place, whole: Posterior) -> Maximum:
    """A place and the derivatives there in the terms that all models share."""
    point, at, value = place
    return Maximum(point, scene.likelihood.mean_gain(at), value, at.square + data.residual, data.strength, whole)


def describe(outline: Outline, one: Any, top: Maximum) -> tuple[Any, Any]:
    """The rows of the result and the flags of every pixel; ``one`` is that of :class:`Data`.

    The covariance is that of the parameters. Where the maximum lies on a bound (``FROZEN``) the rows of that parameter
    hold instead how the others follow the bounded angle y, and the inverse curvature along y; then the evidence leaves
    that angle out. ``ROUGH`` marks a maximum that rounding may have missed by more than the precision promises.
    """
    point, gain, value, square, strength, whole = top
    if 2 in outline.free and not outline.bounded:  # the other sign of J, which a free phase takes up
        c, s = point.retardance
        down = c < 0
        point = point._replace(retardance=(jnp.where(down, -c, c), jnp.where(down, -s, s)))
        gain = None if gain is None else (jnp.where(down, -gain[0], gain[0]), jnp.where(down, -gain[1], gain[1]))
    stuck = frozen(outline, point, whole.gradient)
    local = held(whole, stuck)
    free, n = outline.free, len(outline.free)
    at_index = {i: m for m, i in enumerate(free)}
    a = {(m, k): -local.hessian[i, j] for m, i in enumerate(free) for k, j in enumerate(free) if m <= k}
    factor = factorise(a, n, LEAST_CURVATURE)
    lower, smallest = factor.lower, factor.smallest
    _, decrement = solve(lower, [local.gradient[i] for i in free])
    c = {key: x / one for key, x in inverse(lower, n).items()}
    c |= {(k, m): x for (m, k), x in c.items()}
    flags = jnp.where((decrement < precise_enough(strength)) & (smallest > lowest_pivot(strength)), CONVERGED, 0)
    finite = jnp.isfinite(value)
    # angles of J itself do not depend on how well axes are defined
    sine = [jnp.ones_like(value), point.diattenuation[1], jnp.ones_like(value), point.retardance[1],
            point.retardance[1] * point.retardance_angle[1]]  # fmt: skip
    loosest = jnp.zeros_like(value)
    wide = ~(smallest > 0)
    for i in free:
        loose = c[at_index[i], at_index[i]] * sine[i] ** 2
        wide = wide | (loose > MANY)
        loosest = jnp.maximum(loosest, jnp.where(stuck[i], 0, loose) if i in stuck else loose)
    # what is lost where a gradient that is rounding alone still moves a loose angle: twice the nats
    eps = float(jnp.finfo(value.dtype).eps)
    rough = (ROUNDING * eps * strength**2) ** 2 * loosest > (5e-4 if eps < 1e-10 else 5e-3)

    # evidence: this point's own prior, then those of the copies
    cosine = point.diattenuation[0] ** 2 - point.diattenuation[1] ** 2  # cos delta
    log_volume = _log_volume(free, lower, stuck, cosine)
    total, doubtful = jnp.full_like(value, log(outline.groups[0][1])), jnp.zeros(value.shape, bool)
    own = log_prior(outline.prior, point)
    for prior, count in outline.groups[1:]:
        b = dict(a)
        change: list[Any] = [ZERO] * n
        differ = [i for i in free if prior[i] != outline.prior[i]]
        for i in differ:
            slope, bend = _difference(prior[i], outline.prior[i], point[i])
            m = at_index[i]
            change[m], b[m, m] = slope, b[m, m] - bend
            if i in stuck:
                change[m], b[m, m] = jnp.where(stuck[i], 0, slope), jnp.where(stuck[i], 1, b[m, m])
        its = factorise(b, n, begun=factor, first=at_index[differ[0]])
        low, least = its.lower, its.smallest
        lift = 0.5 * solve(low, change)[1]
        gap = log_prior(prior, point) - own
        # one that could climb above this one is to be tried
        doubtful = doubtful | (least <= 0) | (gap + 2 * lift + 1e-3 > 0)
        volume = _log_volume(free, low, stuck, cosine)
        term = gap + jnp.where(least > 0, jnp.clip(lift, 0, -gap), 0) + volume - log_volume + log(count)
        total = jnp.logaddexp(total, jnp.where(jnp.isfinite(term), term, -jnp.inf))
    evidence = value + log_volume + total

    flags = flags | jnp.where(doubtful, DOUBTFUL, 0) | jnp.where(wide, WIDE, 0) | jnp.where(rough, ROUGH, 0)
    flags = flags | jnp.where(finite, 0, NON_FINITE)
    for i, where in stuck.items():
        flags = flags | jnp.where(where, FROZEN[i], 0)

    # the bounded angles that are held: how the others follow them
    for i, where in stuck.items():
        m = at_index[i]
        others = [k for k in range(n) if k != m]
        slope = {k: held(whole, {j: w for j, w in stuck.items() if j != i}).hessian[_key(i, free[k])] for k in others}
        follow = {k: sum(c[k, o] * slope[o] for o in others) for k in others}
        curvature = -whole.hessian[i, i] - sum(slope[k] * follow[k] for k in others)
        for k in others:
            c[m, k] = c[k, m] = jnp.where(where, follow[k], c[k, m])
        c[m, m] = jnp.where(where, 1 / curvature, c[m, m])

    values = _values(outline, jnp.ones_like(value), point)
    if 0 in stuck:  # on the bound, not an ulp off it: the density falls by a square root from there
        values = values._replace(
            diattenuation=jnp.where(stuck[0], jnp.sign(values.diattenuation), values.diattenuation)
        )
    parameters, signs = _choose(outline, one, point, values)
    widths = [2 * cosine, 0.5, 2.0, 0.5, 1.0]
    if 0 in stuck:
        widths[0] = jnp.where(stuck[0], 1.0, widths[0])
    if 2 in stuck:
        widths[2] = jnp.where(stuck[2], 1.0, widths[2])
    zero = jnp.zeros_like(value)
    scale = jnp.stack([jnp.broadcast_to(signs[i] * widths[i], zero.shape) if i in free else zero for i in range(5)])
    each = [c[at_index[i], at_index[j]] if i in free and j in free else zero for i in range(5) for j in range(5)]
    covariance = scale[:, None] * scale * jnp.stack(each).reshape(5, 5, -1)
    std = jnp.abs(scale) * jnp.sqrt(jnp.stack(each[::6]))
    slopes = [jnp.where(stuck[i], jnp.abs(whole.gradient[i]), 0) if i in stuck else zero for i in (0, 2)]
    rest = [value, evidence, 2 * square, *slopes, *(() if gain is None else gain)]
    return jnp.concatenate([jnp.stack(parameters), std, covariance.reshape(25, -1), jnp.stack(rest)]), flags


def _difference(left: Any, right: Any, pair: Any) -> tuple[Any, Any]:
    """How the first and the second derivatives of two terms of the prior differ."""
    (_, *one), (_, *two) = left.evaluate(pair), right.evaluate(pair)
    return one[0] - two[0], one[1] - two[1]


def _key(i: int, j: int) -> tuple[int, int]:
    return (i, j) if i <= j else (j, i)


def _log_volume(free: tuple[int, ...], lower: Triangle, stuck: dict[int, Any], cosine: Any) -> Any:
    """Log of the Gaussian's volume in the parameters; no direction holds more than its range."""
    jacobian = [2 * cosine, 0.5, 2.0, 0.5, 1.0]
    total: Any = 1.0
    for m, i in enumerate(free):
        scale = (2 * pi) ** 0.5 * jacobian[i]
        most = 12**0.5 * uniform_std(Parameters._fields[i])
        part = jnp.minimum(scale / lower[m, m], most)
        total = total * (jnp.where(stuck[i], 1, part) if i in stuck else part)
    return jnp.log(total)
