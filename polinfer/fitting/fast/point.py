"""Where a pixel is: five unit vectors, of which J is a multilinear function.

The angles are ``y = (delta/2, 2 theta_D, eta/2, 2 theta_eta, xi)`` with ``D = sin delta``, each held as the pair
(cosine, sine). They are the coordinates of the climb: no trigonometric function is evaluated on the way. With

``u = (cos y0, sin y0 cos y1, sin y0 sin y1)`` and
``q = (cos y2, sin y2 cos y3, sin y2 sin y3 cos y4, sin y2 sin y3 sin y4)``

the elements are ``A_pol = u0 + u1 Z - u2 X`` and ``A_ret = q0 + i (q1 Z - q2 X - q3 Y)`` in the Pauli matrices. All
functions are element-wise: a component is an array of pixels, or a number that is :class:`Known` while tracing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from .known import ZERO

__all__ = ["Pair", "Point", "dot", "matrix", "polariser_vector", "polariser_vectors", "retarder_vector",
           "retarder_vectors", "rotate", "sine_of_double", "unit"]  # fmt: skip

Pair = tuple[Any, Any]
Vector = list[Any]


class Point(NamedTuple):
    """(cosine, sine) of each of the five angles y."""

    diattenuation: Pair
    diattenuation_angle: Pair
    retardance: Pair
    retardance_angle: Pair
    circularity: Pair


def dot(left: Vector, right: Vector) -> Any:
    """Scalar product."""
    return sum((a * b for a, b in zip(left, right, strict=True)), start=ZERO)


def unit(x: Any, y: Any) -> Pair:
    """The direction of (x, y); (1, 0) where there is none."""
    square = x * x + y * y
    there = square > 0
    scale = jax.lax.rsqrt(jnp.where(there, square, 1))
    return jnp.where(there, x * scale, 1), jnp.where(there, y * scale, 0)


def rotate(pair: Pair, step: Any) -> Pair:
    """Turned by ``2 atan(step / 2)``, which is ``step`` to second order, and brought back to length 1."""
    c, s = pair
    half = 0.5 * step
    square = half * half
    length = 1.5 - 0.5 * (c * c + s * s)
    scale = (1 + square) / length
    return (c * (1 - square) - s * step) / scale, (s * (1 - square) + c * step) / scale


def sine_of_double(pair: Pair) -> Any:
    """``2 cos y sin y``, next to 1 and -1 to within rounding of the result, not of its square root.

    J depends on ``sqrt(1 - |D|)``: what is nearer to the number next to 1 in this than to 1 is rounded to it.
    """
    c, s = pair
    cosine = (c - s) * (c + s)
    away = cosine * cosine / (1 + jnp.sqrt(jnp.maximum(1 - cosine * cosine, 0)))
    next_to_one = 0.5 * jnp.finfo(c.dtype).eps
    away = jnp.where((away > 0.25 * next_to_one) & (away < next_to_one), next_to_one, away)
    return jnp.where(jnp.abs(cosine) < 0.5, jnp.sign(s) * (1 - away), 2 * c * s)


def polariser_vector(diattenuation: Pair, angle: Pair) -> Vector:
    """u of the angles 0 and 1, ``point[:2]``."""
    (c, s), (x, y) = diattenuation, angle
    return [c, s * x, s * y]


def retarder_vector(retardance: Pair, angle: Pair, circularity: Pair) -> Vector:
    """q of the angles 2, 3 and 4, ``point[2:]``."""
    (c, s), (x, y), (a, b) = retardance, angle, circularity
    sy = s * y
    return [c, s * x, sy * a, sy * b]


def polariser_vectors(point: Point) -> tuple[Vector, dict[tuple[int, ...], Vector]]:
    """u, and its derivatives by the angles 0 and 1: keys (0,), (1,), (0, 1), (1, 1); the one by (0, 0) is -u."""
    (c, s), (x, y) = point.diattenuation, point.diattenuation_angle
    sx, sy, cx, cy = s * x, s * y, c * x, c * y
    return [c, sx, sy], {
        (0,): [-s, cx, cy],
        (1,): [ZERO, -sy, sx],
        (0, 1): [ZERO, -cy, cx],
        (1, 1): [ZERO, -sx, -sy],
    }


def retarder_vectors(point: Point) -> tuple[Vector, dict[tuple[int, ...], Vector]]:
    """q, and its derivatives by the angles 2, 3 and 4; the one by (2, 2) is -q."""
    (c, s), (x, y), (a, b) = point.retardance, point.retardance_angle, point.circularity
    sx, sy, cx, cy = s * x, s * y, c * x, c * y
    return [c, sx, sy * a, sy * b], {
        (2,): [-s, cx, cy * a, cy * b],
        (3,): [ZERO, -sy, sx * a, sx * b],
        (4,): [ZERO, ZERO, -sy * b, sy * a],
        (2, 3): [ZERO, -cy, cx * a, cx * b],
        (2, 4): [ZERO, ZERO, -cy * b, cy * a],
        (3, 3): [ZERO, -sx, -sy * a, -sy * b],
        (3, 4): [ZERO, ZERO, -sx * b, sx * a],
        (4, 4): [ZERO, ZERO, -sy * a, -sy * b],
    }


def matrix(retarder_first: bool, u: Vector, q: Vector) -> list[list[Pair]]:
    """J as real and imaginary parts of its elements."""
    a, b, d = u[0] + u[1], -u[2], u[0] - u[1]
    retarder = [[(q[0], q[1]), (-q[3], -q[2])], [(q[3], -q[2]), (q[0], -q[1])]]
    if retarder_first:
        rows = ((a, b), (b, d))
        return [
            [tuple(r[0] * x + r[1] * y for x, y in zip(retarder[0][j], retarder[1][j], strict=True)) for j in (0, 1)]
            for r in rows
        ]
    columns = ((a, b), (b, d))
    return [
        [tuple(c[0] * x + c[1] * y for x, y in zip(retarder[i][0], retarder[i][1], strict=True)) for c in columns]
        for i in (0, 1)
    ]
