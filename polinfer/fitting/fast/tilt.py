"""How the log posterior of a pixel changes with the phase of the second arm, its own parameters following.

With the data brought to the frame of the tilt phi, a further small phase eps acts on the polariser and on the prior of
the circularity alone, if ``xi' = xi - phi`` is kept: ``T^-1 A_ret(xi) T = A_ret(xi - phi)``, and

``A_pol(eps) = u0 + u1 Z - u2 (X cos eps - Y sin eps)``.

So what a pure retarder says about the tilt comes from the prior alone, and no large derivatives cancel. The pixel's
own angles y are eliminated: with b and c the second derivatives by eps and y, and by eps twice, and H that by y,

``F' = f_eps + b . s,  F'' = c + b . (-H)^-1 b,  s = (-H)^-1 f_y`` (what is left to climb), ``dy/dphi = (-H)^-1 b``.

All equivalent sets count: ``F = log sum exp F_c``, each with its own prior.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ...statistics import Statistics
from ...threads import each
from . import kernel
from .climb import LEAST_CURVATURE, Posterior, climb, derivatives, frozen, held, with_prior
from .data import Data, prepare
from .engine import BLOCKS
from .known import ZERO, Known
from .linear import Triangle, factorise, solve
from .overlap import Pauli, coefficients, energy, imaginary, overlap_slopes, turned
from .point import Point, Vector, dot, polariser_vectors, retarder_vectors, unit
from .priors import FACTORS, Term, log_prior
from .scene import Scene
from .start import closed_form

__all__ = ["Response", "phase_responses"]


class Response(NamedTuple):
    """Of every pixel: log density with the equivalent sets summed, its first and second derivative by phi, the
    derivatives of the five parameters by phi ``(5, pixels)``, and where the climb ended, ``(10, pixels)``."""

    value: np.ndarray
    slope: np.ndarray
    bend: np.ndarray
    parameters: np.ndarray
    points: np.ndarray


class _Phase(NamedTuple):
    """Of a function of y and eps: derivative by eps, twice by eps, and by eps and each of the five angles."""

    first: Any
    second: Any
    mixed: list[Any]


def _overlap(retarder_first: bool, k: Pauli, point: Point) -> _Phase:
    """Those of the overlap ``a``: one more row of T, that of Y."""
    sign = 1 if retarder_first else -1
    (_, io), (z, _), (x, _), (y, _) = k
    row, own = [y, -sign * x, -sign * z, -io], coefficients(retarder_first, k)[2]
    u, du = polariser_vectors(point)
    q, dq = retarder_vectors(point)
    across = dot(row, q)
    mixed = [du[0,][2] * across, du[1,][2] * across, *(u[2] * dot(row, dq[j,]) for j in (2, 3, 4))]
    return _Phase(u[2] * across, -u[2] * dot(own, q), mixed)


def _energy(retarder_first: bool, s: Pauli, point: Point) -> _Phase:
    """Those of the energy ``m = tr S + D (cos 2 theta_D s_z' - sin 2 theta_D (s_x' cos eps - s_y' sin eps))``."""
    (c, e), (p, r) = point.diattenuation, point.diattenuation_angle
    sine, cosine = 2 * e * c, c * c - e * e
    if not retarder_first:
        x, y, slopes = s.x[0], s.y[0], [ZERO, ZERO, ZERO]
    else:
        q, dq = retarder_vectors(point)
        z_, x_, y_ = s.z[0], s.x[0], s.y[0]
        y_matrix = [[y_, -x_, -z_, ZERO], [-x_, -y_, ZERO, -z_], [-z_, ZERO, -y_, x_], [ZERO, -z_, x_, y_]]
        x_matrix = [[x_, y_, ZERO, z_], [y_, -x_, -z_, ZERO], [ZERO, -z_, x_, y_], [z_, ZERO, y_, -x_]]
        image = [dot(line, q) for line in y_matrix]
        y, x = dot(q, image), dot(q, [dot(line, q) for line in x_matrix])
        slopes = [2 * dot(image, dq[j,]) for j in (2, 3, 4)]
    mixed = [2 * cosine * r * y, sine * p * y, *(sine * r * part for part in slopes)]
    return _Phase(sine * r * y, sine * r * x, mixed)


def _likelihood(scene: Scene, balanced: bool, data: Data, point: Point, at: Any) -> _Phase:
    """Those of the log likelihood at a point whose residual is ``at``."""
    slopes = scene.likelihood.slopes(at)
    k = data.product
    if scene.likelihood.free_phase:
        k = turned(k, unit(*at.gain))
    first = _overlap(scene.retarder_first, k, point)
    f, second, mixed = slopes.r * first.first, slopes.r * first.second, [slopes.r * x for x in first.mixed]
    pairs: list[tuple[Any, tuple[Any, list[Any]], tuple[Any, list[Any]]]] = []
    if slopes.rr is not None:
        own = (first.first, overlap_slopes(coefficients(scene.retarder_first, k), point)[1])
        pairs.append((slopes.rr, own, own))
    if slopes.across is not None:
        other = imaginary(k)
        slant = (
            _overlap(scene.retarder_first, other, point).first,
            overlap_slopes(coefficients(scene.retarder_first, other), point)[1],
        )
        pairs.append((slopes.across, slant, slant))
    if not balanced:
        power = _energy(scene.retarder_first, data.power, point)
        f, second = f + slopes.m * power.first, second + slopes.m * power.second
        mixed = [m + slopes.m * x for m, x in zip(mixed, power.mixed, strict=True)]
        also = (power.first, energy(scene.retarder_first, data.power, point).gradient)
        if slopes.mm is not None:
            pairs.append((slopes.mm, also, also))
        if slopes.rm is not None:
            pairs += [(slopes.rm, own, also), (slopes.rm, also, own)]
    for weight, (left, _), (right, gradient) in pairs:
        second = second + weight * left * right
        mixed = [m + weight * left * g for m, g in zip(mixed, gradient, strict=True)]
    return _Phase(f, second, mixed)


class _Eliminated(NamedTuple):
    value: Any
    slope: Any
    bend: Any
    follow: Vector


def _eliminate(scene: Scene, local: Posterior, phase: _Phase, stuck: dict[int, Any]) -> _Eliminated:
    """The pixel's own angles eliminated, as far as there is a maximum; ``value`` is what is left to climb."""
    free, n = scene.free, len(scene.free)
    a: Triangle = {(m, k): -local.hessian[i, j] for m, i in enumerate(free) for k, j in enumerate(free) if m <= k}
    factor = factorise(a, n, LEAST_CURVATURE)
    mixed = [jnp.where(stuck[i], 0, phase.mixed[i]) if i in stuck else phase.mixed[i] for i in free]
    follow, drop = solve(factor.lower, mixed)
    step, left = solve(factor.lower, [local.gradient[i] for i in free])
    there = factor.smallest > 0
    slope = phase.first + jnp.where(there, sum(b * s for b, s in zip(mixed, step, strict=True)), 0)
    return _Eliminated(
        jnp.where(there, 0.5 * left, 0),
        slope,
        jnp.where(there, phase.second + drop, 0),
        [jnp.where(there, x, 0) for x in follow],
    )


def _with_prior(prior: tuple[Term | None, ...], point: Point, phase: _Phase) -> _Phase:
    found = None if prior[4] is None else prior[4].evaluate(point.circularity)
    if found is None:
        return phase
    mixed = [*phase.mixed[:4], phase.mixed[4] + found[2]]
    return _Phase(phase.first + found[1], phase.second + found[2], mixed)


@partial(jax.jit, static_argnums=1)
def _respond(
    scene: Scene, balanced: bool, statistics: Statistics, phase: Any, start: Any, shift: Any, given: Any,
    iterations: Any, one: Any,
) -> Any:  # fmt: skip
    """Rows value, slope, bend, five derivatives of y, ten of the point."""
    c, s = jnp.cos(phase), jnp.sin(phase)

    def matrix(values: Any) -> Any:
        parts = [[(jnp.real(values[..., i, j]), jnp.imag(values[..., i, j])) for j in (0, 1)] for i in (0, 1)]
        parts[1] = [(re * c - im * s, re * s + im * c) for re, im in parts[1]]
        return parts

    data = prepare(
        balanced, matrix(statistics.illumination), matrix(statistics.response), statistics.residual,
        statistics.constant, one,
    )  # fmt: skip
    closed = closed_form(scene, data)
    a, b = start[8], start[9]
    turned_pair = (a * jnp.cos(shift) - b * jnp.sin(shift), a * jnp.sin(shift) + b * jnp.cos(shift))
    told = [(start[2 * i], start[2 * i + 1]) for i in range(4)] + [turned_pair]
    begun = jnp.stack([x for i in scene.free for x in told[i]])
    begun = jnp.where(given != kernel.CLOSED_FORM, begun, jnp.stack(jax.tree.leaves(closed)))
    (point, at, value), _ = climb(scene, balanced, data, begun, iterations, given != kernel.STAY)

    def arrays(tree: Any) -> Any:
        # behind a division by 1, as in the climb, and nothing merely known
        return jax.tree.map(lambda x: x / one + jnp.zeros_like(value), tree, is_leaf=lambda x: isinstance(x, Known))

    likelihood = arrays(derivatives(scene, balanced, data, point, at))
    change = arrays(_likelihood(scene, balanced, data, point, at))
    whole = with_prior(scene.prior, point, likelihood)
    stuck = frozen(scene, point, whole.gradient)
    own = _eliminate(scene, held(whole, stuck), _with_prior(scene.prior, point, change), stuck)
    before = log_prior(scene.prior, point)
    heights = [own.value + np.log(scene.groups[0][1])]
    parts = [own]
    for prior, count in scene.groups[1:]:
        other = held(with_prior(prior, point, likelihood), stuck)
        part = _eliminate(scene, other, _with_prior(prior, point, change), stuck)
        gap = log_prior(prior, point) - before
        # a parabola that rises above the maximum found describes another place
        heights.append(gap + jnp.clip(part.value, 0, jnp.maximum(-gap, 0)) + np.log(count))
        parts.append(part)
    top = heights[0]
    for height in heights[1:]:
        top = jnp.maximum(top, height)
    weights = [jnp.exp(height - top) for height in heights]
    total = sum(weights[1:], start=weights[0])
    slope = sum(w * p.slope for w, p in zip(weights, parts, strict=True)) / total
    square = sum(w * (p.bend + p.slope * p.slope) for w, p in zip(weights, parts, strict=True)) / total
    follow = [jnp.zeros_like(value)] * 5
    for i, x in zip(scene.free, own.follow, strict=True):
        follow[i] = x
    if 4 in scene.free:
        follow[4] = follow[4] + 1
    rows = [value + top + jnp.log(total), slope, square - slope * slope, *follow, *(x for pair in point for x in pair)]
    return jnp.stack([x + jnp.zeros_like(value) for x in rows])


@jax.jit
def _pairs(parameters: Any) -> Any:
    """Points ``(10, pixels)`` of parameters ``(5, pixels)``: :func:`engine.pairs_of` in compiled code."""
    angles = [0.5 * jnp.arcsin(jnp.clip(parameters[0], -1, 1))]
    angles += [factor * x for factor, x in zip(FACTORS[1:], parameters[1:], strict=True)]
    return jnp.stack([f(x) for x in angles for f in (jnp.cos, jnp.sin)])


def phase_responses(
    scene: Scene, balanced: bool, statistics: Statistics, phase: np.ndarray, start: np.ndarray | None,
    shift: np.ndarray | None, iterations: int,
) -> Response:  # fmt: skip
    """What pixels ``(pixels)`` with statistics of their own say about the phase, at ``phase`` (pixels).

    ``start``: points ``(10, pixels)`` and by how much the phase has changed since, parameters ``(5, pixels)``, from
    which no change to an equivalent set is made, or None: the closed form.
    """
    pixels, dtype = len(statistics.residual), statistics.residual.dtype
    size = BLOCKS[pixels > BLOCKS[1]]
    out = np.empty((18, pixels), dtype)
    nothing, none = kernel.no_start(size, dtype), jnp.zeros(size, dtype)
    given = kernel.CLOSED_FORM
    if start is not None:
        given = kernel.STAY if len(start) == 5 else kernel.GIVEN
    phase = phase.astype(dtype)

    def work(begin: int) -> None:
        end = min(begin + size, pixels)
        take: Any = slice(begin, end)
        if end - begin < size:
            take = np.concatenate([np.arange(begin, end), np.full(size - end + begin, begin)])
        part = Statistics(*(x[take] for x in statistics))
        begun: Any = nothing if start is None else start[:, take].astype(dtype, copy=False)
        begun = _pairs(begun) if len(begun) == 5 else begun
        moved = none if shift is None else shift[take].astype(dtype)
        rows = _respond(scene, balanced, part, phase[take], begun, moved, given, iterations, dtype.type(1))
        out[:, begin:end] = np.asarray(rows)[:, : end - begin]

    each(work, range(0, pixels, size))
    points = out[8:]
    # dD = 2 cos delta dy_0, and the other angles are multiples of theirs
    jacobian = np.array([1.0, 0.5, 2.0, 0.5, 1.0], dtype)[:, None] * np.ones((1, pixels), dtype)
    jacobian[0] = 2 * (points[0] ** 2 - points[1] ** 2)
    return Response(out[0], out[1], out[2], out[3:8] * jacobian, points)
