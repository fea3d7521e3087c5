"""Newton steps on the log posterior of a block of pixels at once, element by element."""

from __future__ import annotations

from functools import partial
from math import pi
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..newton import tolerance
from .data import Data, times
from .likelihoods import Residual, Slopes
from .linear import factorise, solve
from .overlap import coefficients, energy, imaginary, overlap, overlap_slopes, turned
from .point import Point, matrix, polariser_vector, retarder_vector, rotate, unit
from .priors import COPIES, Term, log_prior
from .scene import Outline, Scene

__all__ = ["Place", "Posterior", "better_copy", "climb", "derivatives", "evaluate", "frozen", "held", "lowest_pivot",
           "moved", "precise_enough", "with_prior"]  # fmt: skip

LONGEST_STEP = 0.7  # radians of any angle y
LEAST_CURVATURE = 1e-6  # of a direction of which neither data nor prior say anything
ROOT_HALF = 0.5**0.5


class Posterior(NamedTuple):
    """Derivatives by the free angles at a point, of the log posterior or of a part of it."""

    gradient: dict[int, Any]
    hessian: dict[tuple[int, int], Any]


def evaluate(scene: Scene, data: Data, point: Point) -> tuple[Any, Residual]:
    """Log posterior, all constants included, from the residual itself."""
    seen = matrix(scene.retarder_first, polariser_vector(*point[:2]), retarder_vector(*point[2:]))
    at = scene.likelihood.residual(times(seen, data.illumination), data.response)
    value = scene.likelihood.value(at) + data.constant
    return value + (log_prior(scene.prior, point) + scene.constant), at


def derivatives(scene: Scene, balanced: bool, data: Data, point: Point, at: Residual) -> Posterior:
    """Gradient and Hessian of the log likelihood by the free angles (without the prior)."""
    slopes: Slopes = scene.likelihood.slopes(at)
    k = data.product
    if scene.likelihood.free_phase:
        k = turned(k, unit(*at.gain))
    first = overlap(coefficients(scene.retarder_first, k), point, data.one)
    free = scene.free
    gradient = {i: slopes.r * first.gradient[i] for i in free}
    hessian = {(i, j): slopes.r * first.hessian[i, j] for i in free for j in free if i <= j}
    outer: list[tuple[Any, list[Any], list[Any]]] = []
    if slopes.rr is not None:
        outer.append((slopes.rr, first.gradient, first.gradient))
    if slopes.across is not None:
        _, slant = overlap_slopes(coefficients(scene.retarder_first, imaginary(k)), point)
        outer.append((slopes.across, slant, slant))
    if not balanced:
        second = energy(scene.retarder_first, data.power, point)
        gradient = {i: g + slopes.m * second.gradient[i] for i, g in gradient.items()}
        hessian = {key: h + slopes.m * second.hessian[key] for key, h in hessian.items()}
        if slopes.mm is not None:
            outer.append((slopes.mm, second.gradient, second.gradient))
        if slopes.rm is not None:
            outer += [(slopes.rm, first.gradient, second.gradient), (slopes.rm, second.gradient, first.gradient)]
    for weight, left, right in outer:
        hessian = {(i, j): h + weight * left[i] * right[j] for (i, j), h in hessian.items()}
    return Posterior(gradient, hessian)


def with_prior(prior: tuple[Term | None, ...], point: Point, likelihood: Posterior) -> Posterior:
    """The derivatives of the log posterior."""
    gradient, hessian = dict(likelihood.gradient), dict(likelihood.hessian)
    for i, term in enumerate(prior):
        found = None if term is None else term.evaluate(point[i])
        if found is not None:
            gradient[i] = gradient[i] + found[1]
            hessian[i, i] = hessian[i, i] + found[2]
    return Posterior(gradient, hessian)


def frozen(scene: Scene | Outline, point: Point, gradient: dict[int, Any]) -> dict[int, Any]:
    """Where a bounded angle lies on its bound and would leave it uphill."""
    found = {}
    if 0 in scene.free:
        c, s = point.diattenuation
        found[0] = (jnp.abs(s) >= c * (1 - 4 * jnp.finfo(c.dtype).eps)) & (gradient[0] * s >= 0)
    if 2 in scene.free and scene.bounded:
        c, s = point.retardance
        found[2] = (c <= 0) & (gradient[2] * s >= 0)
    return found


def held(posterior: Posterior, stuck: dict[int, Any]) -> Posterior:
    """The problem in which the angles ``stuck`` do not move."""
    gradient = {i: jnp.where(stuck[i], 0, g) if i in stuck else g for i, g in posterior.gradient.items()}
    hessian = dict(posterior.hessian)
    for i, where in stuck.items():
        for key in hessian:
            if i in key:
                hessian[key] = jnp.where(where, -1.0 if key == (i, i) else 0.0, hessian[key])
    return Posterior(gradient, hessian)


def precise_enough(strength: Any) -> Any:
    """Largest accepted squared Newton decrement; the gradient is rounded like eps times the square of the SNR."""
    dtype = np.dtype(strength.dtype)
    return tolerance(dtype) + 20 * (jnp.finfo(dtype).eps * strength) ** 2


def lowest_pivot(strength: Any) -> Any:
    """Pivots of the Hessian above it may be 0: of a direction of which neither data nor prior say anything."""
    return -LEAST_CURVATURE - 8 * jnp.finfo(strength.dtype).eps * strength**2


def _project(scene: Scene, point: Point) -> Point:
    """Back onto the ranges of bounded angles."""
    if 0 in scene.free:
        c, s = point.diattenuation
        out = jnp.abs(s) > c
        point = point._replace(diattenuation=(jnp.where(out, ROOT_HALF, c), jnp.where(out, jnp.sign(s) * ROOT_HALF, s)))
    if 2 in scene.free and scene.bounded:
        c, s = point.retardance
        out = c < 0
        point = point._replace(retardance=(jnp.where(out, 0.0, c), jnp.where(out, jnp.sign(s), s)))
    return point


def moved(copy: tuple[tuple[int, float], ...], point: Point) -> Point:
    """One of the eight equivalent points."""
    pairs = []
    for (c, s), (sign, shift) in zip(point, copy, strict=True):
        turn = -1.0 if abs(shift - pi) < 1e-9 else 1.0
        pairs.append((turn * c, turn * sign * s))
    return Point(*pairs)


def better_copy(scene: Scene, point: Point) -> Point:
    """The equivalent point with the highest prior; it describes the same matrix."""
    if len(scene.groups) == 1:
        return point
    seen: list[tuple[Term | None, ...]] = []
    best, top = point, log_prior(scene.prior, point)
    for row, copy in zip(scene.copies, COPIES, strict=True):
        prior = tuple(None if t is None else t.transformed(*m) for t, m in zip(scene.prior, copy, strict=True))
        if not row or prior == scene.prior or prior in seen:
            continue
        seen.append(prior)
        value = log_prior(prior, point)
        better = value > top
        other = moved(copy, point)
        best = jax.tree.map(partial(jnp.where, better), other, best)
        top = jnp.where(better, value, top)
    return best


class Place(NamedTuple):
    """A point, the residual there, and the log posterior."""

    point: Point
    residual: Residual
    value: Any


def point_of(scene: Scene, rows: Any) -> Point:
    """The point with the cosine and sine of every free angle ``(2 free, pixels)``."""
    free = {i: (rows[2 * m], rows[2 * m + 1]) for m, i in enumerate(scene.free)}
    return Point(*(free[i] if known is None else known for i, known in enumerate(scene.fixed)))


def climb(
    scene: Scene, balanced: bool, data: Data, start: Any, iterations: Any, exchange: Any = True, patience: Any = 0
) -> tuple[Place, Posterior]:
    """At most ``iterations`` damped Newton steps uphill; the best place that they reach, and the derivatives there.

    ``start`` are the cosine and sine of every free angle in turn, ``(2 free, pixels)``.

    A step that lowers the density is taken back, unless one of the next ``patience`` comes out higher. With
    ``exchange`` a point gives way to an equivalent one with a higher prior on the way.

    The code of a step is all there is: the first one, with a slope of 0, only looks at the start.
    """

    def higher(point: Point) -> Point:
        if len(scene.groups) == 1:
            return point
        return jax.tree.map(partial(jnp.where, exchange), better_copy(scene, point), point)

    eps = jnp.finfo(data.strength.dtype).eps
    enough, lowest = precise_enough(data.strength), lowest_pivot(data.strength)
    free, n, shape = scene.free, len(scene.free), data.strength.shape

    def look(point: Point) -> Place:
        value, at = evaluate(scene, data, point)
        return Place(point, at, value / data.one)

    structure: Any = jax.tree.structure(jax.eval_shape(look, point_of(scene, start)))

    def packed(place: Place) -> Any:
        # one array: the compiler makes one piece of code of a choice between two of them, not one for each component
        return jnp.stack([jnp.broadcast_to(x, shape) for x in jax.tree.leaves(place)])

    def unpacked(rows: Any) -> Place:
        return jax.tree.unflatten(structure, list(rows))

    def advance(carry: Any) -> Any:
        count, here, best, damping, age, done, gradient, hessian = carry
        first = count == 0
        (point, _, _), (_, at, value) = unpacked(here), unpacked(best)
        slope = held(Posterior(gradient, hessian), frozen(scene, point, gradient))
        a = {(m, k): -slope.hessian[i, j] for m, i in enumerate(free) for k, j in enumerate(free) if m <= k}
        for m in range(n):
            a[m, m] = a[m, m] + damping * (jnp.abs(a[m, m]) + LEAST_CURVATURE)
        found = factorise(a, n, LEAST_CURVATURE)
        step, decrement = solve(found.lower, [slope.gradient[i] for i in free])
        decrement = decrement / data.one
        arrived = (decrement < enough) & (found.smallest > lowest) & (damping == 0) & (age == 0) & ~first
        turned_by = jnp.clip(jnp.stack(step), -LONGEST_STEP, LONGEST_STEP)
        cosines, sines = rotate((here[: 2 * n : 2], here[1 : 2 * n : 2]), turned_by)
        pairs = list(point)
        for m, i in enumerate(free):
            pairs[i] = (cosines[m], sines[m])
        trial = look(higher(_project(scene, Point(*pairs))))
        # the residual is rounded like eps times the signal-to-noise ratio, and is squared
        rounding = 10 * eps * (1 + data.strength) * jnp.sqrt(1 + at.square)
        accept = (first | (trial.value >= value - rounding)) & ~done
        # along a narrow curved valley of misfit the way leads over its side, if the next steps come out higher
        astray = ~accept & jnp.isfinite(trial.value) & (age < patience) & (count < iterations)
        failed = ~accept & ~astray
        damping = jnp.where(accept, 0.1 * damping, jnp.where(failed, jnp.maximum(10 * damping, 1e-2), damping))
        damping = jnp.where(damping < 1e-3, 0.0, damping)
        # the last step is taken, too: it is paid for, and leaves far less to gain than was asked for
        done = done | arrived | (first & ~jnp.isfinite(trial.value))
        there = packed(trial)
        best = jnp.where(accept, there, best)
        here = jnp.where(astray & ~done, there, best)
        now = unpacked(here)
        gradient, hessian = with_prior(
            scene.prior, now.point, derivatives(scene, balanced, data, now.point, now.residual)
        )
        return count + 1, here, best, damping, jnp.where(astray, age + 1, 0), done, gradient, hessian

    def unfinished(carry: Any) -> Any:
        return (carry[0] <= iterations) & ~jnp.all(carry[5])

    zero = jnp.zeros_like(data.strength)
    none = jnp.zeros(shape, bool)
    begin = jnp.concatenate([start, jnp.broadcast_to(zero, (structure.num_leaves - 2 * n, *shape))])
    flat = dict.fromkeys(free, zero), {(i, j): zero - (i == j) for i in free for j in free if i <= j}
    carry = (jnp.zeros((), jnp.int32), begin, begin, zero, none.astype(jnp.int32), none, *flat)
    _, _, best, _, _, _, gradient, hessian = jax.lax.while_loop(unfinished, advance, carry)
    return unpacked(best), Posterior(gradient, hessian)
