"""The closed form as a starting point: the polariser from ``J J^H`` or ``J^H J``, then the retarder that fits best."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from .data import Data
from .overlap import Pauli, coefficients, imaginary
from .point import Pair, Point, dot, polariser_vector, unit
from .scene import Scene

__all__ = ["closed_form"]


def _mix(a: Pair, b: Pair) -> tuple[Any, Any]:
    """Real part of ``a conj(b)`` and its imaginary part."""
    return a[0] * b[0] + a[1] * b[1], a[1] * b[0] - a[0] * b[1]


def closed_form(scene: Scene, data: Data) -> Point:
    """Where the climb starts, the fixed angles in place."""
    k = data.jones
    sign = -1 if scene.retarder_first else 1
    total = 0.5 * sum(re * re + im * im for re, im in k)
    scale = 1 / jnp.where(total > 0, total, 1)
    x = scale * (_mix(k.one, k.z)[0] + sign * _mix(k.x, k.y)[1])
    y = -scale * (_mix(k.one, k.x)[0] + sign * _mix(k.y, k.z)[1])
    value = jnp.minimum(jnp.sqrt(x * x + y * y), 0.999)
    cosine = jnp.sqrt(0.5 * (1 + jnp.sqrt(1 - value * value)))
    first, second = _fixed(scene, 0, (cosine, 0.5 * value / cosine)), _fixed(scene, 1, unit(x, y))
    u = polariser_vector(first, second)
    # seen through the polariser the matrix is a complex quaternion; the retarder is its real part
    q = _quaternion(scene.retarder_first, k, u)
    if scene.likelihood.free_phase:
        other = _quaternion(scene.retarder_first, imaginary(k), u)
        half = _half_phase(q, other)
        q = [half[0] * part + half[1] * rest for part, rest in zip(q, other, strict=True)]
        down = q[0] < 0
        q = [jnp.where(down, -part, part) for part in q]
    real = jnp.maximum(q[0], 0) if scene.bounded else q[0]
    flip = jnp.where(q[2] < 0, -1.0, 1.0).astype(value.dtype)  # circularity within a quarter turn of 0
    rho = flip * jnp.sqrt(q[2] * q[2] + q[3] * q[3])
    return Point(
        first,
        second,
        _fixed(scene, 2, unit(real, jnp.sqrt(q[1] * q[1] + rho * rho))),
        _fixed(scene, 3, unit(q[1], rho)),
        _fixed(scene, 4, unit(flip * q[2], flip * q[3])),
    )


def _fixed(scene: Scene, index: int, pair: Pair) -> Pair:
    known = scene.fixed[index]
    return pair if known is None else known


def _quaternion(retarder_first: bool, k: Pauli, u: list[Any]) -> list[Any]:
    t = coefficients(retarder_first, k)
    return [dot([row[i] for row in t], u) for i in range(4)]


def _half_phase(real: list[Any], imaginary: list[Any]) -> Pair:
    """Half the phase of the square of a complex quaternion: turned by it the real part is as long as it can be."""
    c = sum(a * a - b * b for a, b in zip(real, imaginary, strict=True))
    s = 2 * sum(a * b for a, b in zip(real, imaginary, strict=True))
    cosine, sine = unit(c, s)
    half = jnp.sqrt(jnp.maximum(0.5 * (1 + cosine), 0))
    other = jnp.sqrt(jnp.maximum(0.5 * (1 - cosine), 0))
    return half, jnp.where(sine < 0, -other, other)
