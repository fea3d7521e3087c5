"""One sweep: every unknown of a pixel is drawn from its distribution given all the others.

J is multilinear in the unit vectors of five angles (``fitting.fast.point``), so the log likelihood as a function of one
of them is ``B cos y + C sin y`` for balanced states: exactly a von Mises density. Unbalanced states add second
harmonics, whose step takes a candidate about the mode; priors of other forms add themselves: then a slice step takes
the place of the draw.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ...fitting.fast.climb import moved
from ...fitting.fast.data import times
from ...fitting.fast.known import ZERO, Known
from ...fitting.fast.likelihoods import square
from ...fitting.fast.overlap import Pauli, coefficients, imaginary, quadratic_forms, turned
from ...fitting.fast.point import Pair, Point, dot, matrix, polariser_vector, retarder_vector
from ...fitting.fast.priors import Harmonic
from .circle import chord, diattenuation, direction, half_circle, slice_step, two_harmonics, von_mises
from .plan import Any1D, Plan, conjugate, normal
from .random import Random

__all__ = ["Observed", "State", "sweep"]


class Observed(NamedTuple):
    """Statistics of every pixel, element by element, all ``(pixels)``.

    ``product`` are the Pauli components of ``Y R^H``, ``power`` those of ``R R^H``; R, Y themselves and the residual E
    serve the draw of sigma, ``count`` is the number of complex data. ``one`` is 1, which XLA does not know: it computes
    a product anew for each of its uses, a quotient not.
    """

    one: Any
    product: Pauli
    power: Pauli
    illumination: Any
    response: Any
    residual: Any
    count: Any


class State(NamedTuple):
    """Where the chains are, ``(chains, pixels)``: the five angles, the gain, and ``1 / sigma^2`` (1 where known)."""

    point: Point
    gain: Pair
    precision: Any


def _times(t: list[list[Any]], q: list[Any]) -> list[Any]:
    return [dot(row, q) for row in t]


def _transposed(t: list[list[Any]], u: list[Any]) -> list[Any]:
    return [dot([row[i] for row in t], u) for i in range(4)]


def _value(prior: Any, pair: Pair) -> Any:
    """Log density of a prior up to its constant."""
    found = None if prior is None else prior.evaluate(pair)
    return 0.0 if found is None else found[0]


def sweep(plan: Plan, balanced: bool, data: Observed, state: State, random: Random) -> State:
    """A new state, with the distribution that the old one has if that is the posterior's."""
    point, gain, precision = state
    k = data.product if plan.gain == "unit" else turned(data.product, gain)
    t = coefficients(plan.retarder_first, k)
    if plan.noise != "known":
        t = [[precision * x for x in row] for row in t]
    if plan.gain != "unit" or plan.noise != "known":
        t = random.kept(t)
    weight: Any = 0.0 if balanced else _energy_weight(plan, gain, precision)
    point = random.kept(_polariser(plan, balanced, data, t, weight, point, random))
    if plan.gain != "unit" and set(plan.free) >= {2, 3, 4}:
        point, gain = random.kept(_stabiliser(plan, data, precision, point, gain, random))
        t = coefficients(plan.retarder_first, turned(data.product, gain))
        if plan.noise != "known":
            t = [[precision * x for x in row] for row in t]
        t = random.kept(t)
    point = _retarder(plan, balanced, data, t, weight, point, random)
    for copy, behind in plan.exchanges:
        point = _exchange(plan, copy, behind, point, random)
    if plan.gain != "unit":
        gain = _gain(plan, balanced, data, point, precision, random, gain)
    if plan.noise != "known":
        precision = _precision(plan, data, point, gain, precision, random)
    return State(point, gain, precision)


def _energy_weight(plan: Plan, gain: Pair, precision: Any) -> Any:
    """What multiplies ``-|J R|^2`` in the log likelihood."""
    weight = 1.0 if plan.gain == "unit" else gain[0] * gain[0] + gain[1] * gain[1]
    return weight if plan.noise == "known" else weight * precision


def _polariser(
    plan: Plan, balanced: bool, data: Observed, t: list[list[Any]], weight: Any, point: Point, random: Random
) -> Point:
    (c, s), (x, y), *_ = point
    q = retarder_vector(*point[2:])
    v = [2 * value for value in _times(t, q)]
    if balanced:
        stokes = None
    elif plan.retarder_first:
        z_form, x_form = quadratic_forms(data.power)
        stokes = [weight * dot(q, [dot(row, q) for row in form]) for form in (z_form, x_form)]
    else:
        stokes = [weight * data.power.z[0], weight * data.power.x[0]]
    if 1 in plan.free:
        b, d = s * v[1], s * v[2]
        if stokes is not None:
            b, d = b - 2 * s * c * stokes[0], d + 2 * s * c * stokes[1]
        x, y = _angle(plan, 1, b, d, None, (x, y), random)
    if 0 in plan.free:
        b, d = v[0], v[1] * x + v[2] * y
        linear: Any = 0.0 if stokes is None else y * stokes[1] - x * stokes[0]
        own = normal(plan.prior[0])
        if own is not None:
            c, s = diattenuation(random, b, d, linear + own[0], own[1], (c, s))
        else:
            c, s = _sliced_diattenuation(plan, b, d, linear, (c, s), random)
    return point._replace(diattenuation=(c, s), diattenuation_angle=(x, y))


def _sliced_diattenuation(plan: Plan, b: Any, c: Any, linear: Any, old: Pair, random: Random) -> Pair:
    size, mean = direction(b, c)
    prior = plan.prior[0]
    assert prior is not None

    def log_density(pair: Pair) -> Any:
        d, k = 2 * pair[0] * pair[1], pair[0] * pair[0] - pair[1] * pair[1]
        inside = (k > 0) & (pair[0] > 0)
        value = linear * d - size * chord(pair, mean) + _value(prior, pair) + jnp.log(jnp.where(inside, k, 1))
        return jnp.where(inside, value, -jnp.inf)

    width = 4 / jnp.sqrt(6.5 + size)
    return slice_step(random, log_density, width * _scale(random, prior), old)


def _angle(plan: Plan, index: int, b: Any, c: Any, second: tuple[Any, Any] | None, old: Pair, random: Random) -> Pair:
    """A draw of one of the angles 1 to 4: ``b cos y + c sin y``, second harmonics and the prior."""
    own = conjugate(plan.prior[index])
    bounded = index == 2 and plan.bounded
    doubled = second is not None or (own is not None and own[2:] != (0.0, 0.0))
    if own is not None and not (bounded and doubled):
        given = (b, c, *(second or (0.0, 0.0)))
        b, c, d, e = (x if extra == 0 else x + extra for x, extra in zip(given, own, strict=True))
        if doubled:
            return two_harmonics(random, (b, c), (d, e), old)
        return half_circle(random, b, c, old) if bounded else von_mises(random, b, c, old)
    prior = plan.prior[index]
    assert prior is not None
    size, mean = direction(b, c)
    more, turn = (jnp.zeros_like(size), mean) if second is None else direction(*second)

    def log_density(pair: Pair) -> Any:
        value = -size * chord(pair, mean)
        if second is not None:
            double = (pair[0] * pair[0] - pair[1] * pair[1], 2 * pair[0] * pair[1])
            value = value - more * chord(double, turn)
        value = value + _value(prior, pair)
        return jnp.where(pair[0] >= 0, value, -jnp.inf) if bounded else value

    strength = prior.strength * prior.order**2 if isinstance(prior, Harmonic) else 0.0
    width = jnp.minimum(5 / jnp.sqrt(0.6 + strength + size + 4 * more), 6.28)
    return slice_step(random, log_density, width * _scale(random, prior), old)


def _scale(random: Random, prior: Any) -> Any:
    """How narrow a prior of any form is, is not known: an interval of a random size, down to a hundredth."""
    return jnp.exp(-4.6 * random.uniform()) if isinstance(prior, Any1D) else 1.0


def _retarder(
    plan: Plan, balanced: bool, data: Observed, t: list[list[Any]], weight: Any, point: Point, random: Random
) -> Point:
    u = polariser_vector(*point[:2])
    w = [2 * value for value in _transposed(t, u)]
    form = None
    if not balanced and plan.retarder_first:
        (c, s), (x, y), *_ = point
        z_form, x_form = quadratic_forms(data.power)
        scale = -2 * c * s * weight
        form = [[scale * (x * p - y * q) for p, q in zip(*rows, strict=True)]
                for rows in zip(z_form, x_form, strict=True)]  # fmt: skip
    pairs = list(point)
    for index in (4, 3, 2):
        if index not in plan.free:
            continue
        (c2, s2), (c3, s3), (c4, s4) = pairs[2:]
        # q = rest + cos y a + sin y b
        if index == 4:
            rest, a, b = [c2, s2 * c3, ZERO, ZERO], [ZERO, ZERO, s2 * s3, ZERO], [ZERO, ZERO, ZERO, s2 * s3]
        elif index == 3:
            rest, a, b = [c2, ZERO, ZERO, ZERO], [ZERO, s2, ZERO, ZERO], [ZERO, ZERO, s2 * c4, s2 * s4]
        else:
            rest, a, b = [ZERO] * 4, [Known(1.0), ZERO, ZERO, ZERO], [ZERO, c3, s3 * c4, s3 * s4]
        first, other = dot(w, a), dot(w, b)
        second = None
        if form is not None:
            fa, fb = ([dot(row, vector) for row in form] for vector in (a, b))
            if index != 2:
                first, other = first + 2 * dot(rest, fa), other + 2 * dot(rest, fb)
            second = (0.5 * (dot(a, fa) - dot(b, fb)), dot(a, fb))
        first, other, second = random.kept((first, other, second))
        pairs[index] = random.kept(_angle(plan, index, first, other, second, pairs[index], random))
    return Point(*pairs)


def _exchange(plan: Plan, copy: Any, behind: Any, point: Point, random: Random) -> Point:
    """To an equivalent set of the same matrix, by the ratio of the priors."""
    change: Any = 0.0
    for own, other, pair in zip(plan.prior, behind, point, strict=True):
        if own is not None and other != own:
            change = change + _value(other, pair) - _value(own, pair)
    accept = random.uniform() < jnp.exp(change)
    return jax.tree.map(lambda new, old: jnp.where(accept, new, old), moved(copy, point), point)


def _overlaps(plan: Plan, data: Observed, point: Point) -> Pair:
    """``tr(J^H K)``."""
    u, q = polariser_vector(*point[:2]), retarder_vector(*point[2:])
    found = (dot(u, _times(coefficients(plan.retarder_first, k), q)) for k in (data.product, imaginary(data.product)))
    re, im = found
    return re, im


def _energy(plan: Plan, balanced: bool, data: Observed, point: Point) -> Any:
    """``|J R|^2``."""
    total = data.power.one[0]
    if balanced:
        return total
    (c, s), (x, y), *_ = point
    if plan.retarder_first:
        q = retarder_vector(*point[2:])
        stokes = [dot(q, [dot(row, q) for row in form]) for form in quadratic_forms(data.power)]
    else:
        stokes = [data.power.z[0], data.power.x[0]]
    return total + 2 * s * c * (x * stokes[0] - y * stokes[1])


def _gain(plan: Plan, balanced: bool, data: Observed, point: Point, precision: Any, random: Random, old: Pair) -> Pair:
    a = _overlaps(plan, data, point)
    if plan.gain == "phase":
        return von_mises(random, 2 * precision * a[0], 2 * precision * a[1], old)
    spread = 1 / (precision * _energy(plan, balanced, data, point) + plan.gain_precision)
    noise = random.normals()
    root = jnp.sqrt(0.5 * spread)
    re, im = (precision * spread * mean + root * x for mean, x in zip(a, noise, strict=True))
    return re, im


def _precision(plan: Plan, data: Observed, point: Point, gain: Pair, old: Any, random: Random) -> Any:
    seen = matrix(plan.retarder_first, polariser_vector(*point[:2]), retarder_vector(*point[2:]))
    fields = times(seen, data.illumination)
    misfit = data.residual + square(fields, data.response, None if plan.gain == "unit" else gain)
    count = jnp.broadcast_to(data.count, misfit.shape)
    if plan.noise == "frame":
        misfit, count = (jnp.sum(x, axis=-1, keepdims=True) for x in (misfit, count))
        random_old = old[:, :1] * (plan.scale + misfit)
        # all pixels of a chain take the number of the first
        drawn = random.gamma(jnp.broadcast_to(plan.shape + count, old.shape), jnp.broadcast_to(random_old, old.shape))
        return jnp.broadcast_to(drawn[:, :1] / (plan.scale + misfit), old.shape)
    return random.gamma(plan.shape + count, old * (plan.scale + misfit)) / (plan.scale + misfit)


def _stabiliser(
    plan: Plan, data: Observed, precision: Any, point: Point, gain: Pair, random: Random
) -> tuple[Point, Pair]:
    """The retarder and the phase of the gain along the direction in which a strong polariser hardly changes J.

    ``A_ret -> exp(i alpha n.s) A_ret`` (on the other side for the polariser first) and ``g -> g exp(-i alpha)`` with
    ``n.s = cos 2 theta_D Z - sin 2 theta_D X`` (its negative where D < 0), which commutes with the polariser: of the
    two projectors along n.s only that of the weaker transmission turns, by ``-2 alpha``, and the likelihood is von
    Mises in ``2 alpha``. The priors of the angles are uniform along it only up to their density against the uniform one
    of rotations, ``1 / (sin^2(eta/2) |sin 2 theta|)``, by whose ratio the move is accepted.
    """
    (c, s), (x, y), *_ = point
    q = retarder_vector(*point[2:])
    x, y = jnp.where(s < 0, -x, x), jnp.where(s < 0, -y, y)
    low = 0.5 * (c - jnp.abs(s))
    u = [low, -low * x, -low * y]
    k = turned(data.product, gain)
    t, across = (coefficients(plan.retarder_first, part) for part in (k, imaginary(k)))
    b, d = 2 * precision * dot(u, _times(t, q)), -2 * precision * dot(u, _times(across, q))
    one = jnp.ones_like(c)
    twice = von_mises(random, b, d, (one, 0 * one))
    cosine, sine = _half(twice)
    axis = [sine * x, sine * y]
    sign = 1 if plan.retarder_first else -1
    q0, q1, q2, q3 = q
    new = [
        cosine * q0 - axis[0] * q1 - axis[1] * q2,
        cosine * q1 + q0 * axis[0] - sign * (axis[1] * q3),
        cosine * q2 + q0 * axis[1] + sign * (axis[0] * q3),
        cosine * q3 - sign * (axis[0] * q2 - axis[1] * q1),
    ]
    angles, density = _angles_of(new)
    # which of the equivalent angles: at random
    flips = [jnp.where(random.signed() < 0, -1, 1).astype(c.dtype) for _ in range(2)]
    (c2, s2), (c3, s3), (c4, s4) = angles
    angles = ((c2, flips[0] * s2), (flips[0] * c3, flips[0] * flips[1] * s3), (flips[1] * c4, flips[1] * s4))
    trial = point._replace(retardance=angles[0], retardance_angle=angles[1], circularity=angles[2])
    (_, os2), (_, os3), _ = point[2:]
    change = jnp.log(jnp.maximum(os2 * os2 * jnp.abs(os3), 1e-30)) + density
    for index in (2, 3, 4):
        change = change + _value(plan.prior[index], trial[index]) - _value(plan.prior[index], point[index])
    accept = random.uniform() < jnp.exp(change)
    turned_gain = (gain[0] * cosine + gain[1] * sine, gain[1] * cosine - gain[0] * sine)
    return jax.tree.map(lambda new, old: jnp.where(accept, new, old), (trial, turned_gain), (point, gain))


def _half(pair: Pair) -> Pair:
    """The unit vector at half the angle, in [-pi/2, pi/2]."""
    c, s = pair
    large = jnp.sqrt(0.5 * (1 + jnp.abs(c)))
    small = 0.5 * jnp.abs(s) / large
    sign = jnp.where(s < 0, -1, 1)
    return jnp.where(c < 0, small, large), sign * jnp.where(c < 0, large, small)


def _angles_of(q: list[Any]) -> tuple[tuple[Pair, Pair, Pair], Any]:
    """The angles of a unit quaternion, with ``sin y2 >= 0`` and ``sin y3 >= 0``, and ``-log(sin^2 y2 sin y3)``."""
    across = jnp.sqrt(q[2] * q[2] + q[3] * q[3])
    size = jnp.sqrt(q[1] * q[1] + across * across)
    length = jax.lax.rsqrt(q[0] * q[0] + size * size)
    c4, s4 = direction(q[2], q[3])[1]
    c3, s3 = direction(q[1], across)[1]
    density = -jnp.log(jnp.maximum(size * across, 1e-30))
    return ((q[0] * length, size * length), (c3, s3), (c4, s4)), density
