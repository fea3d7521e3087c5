"""The compiled code: from data to the rows of the result, a block of pixels at a time.

In two parts: the climb, and the description of where it has ended, which models of both orderings and of any gain have
in common.
"""

from __future__ import annotations

from functools import cache, partial
from math import pi
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ...statistics import Statistics
from .climb import climb
from .data import Data, Matrix, prepare
from .describe import Maximum, describe, maximum
from .scene import Scene
from .start import closed_form

__all__ = ["CLOSED_FORM", "GIVEN", "PATIENT", "STAY", "Shared", "climb_responses", "climb_statistics", "described",
           "from_responses", "from_statistics", "no_start"]  # fmt: skip

# where a climb starts: in the closed form, or in a point that is given; whether it may change to another copy of it;
# and whether it is patient, which narrow curved valleys need, but which may lead to another maximum
CLOSED_FORM, GIVEN, STAY, PATIENT = range(4)
PATIENCE = 4


class Shared(NamedTuple):
    """What all pixels of a frame share: ``U sqrt(w) = R Q`` with weights w, and the sum of ``log w`` of the data."""

    root: Any
    rows: Any
    root_weight: Any
    log_weight: Any
    count: Any


@cache
def no_start(pixels: int, dtype: Any) -> jax.Array:
    """Stands for a start where there is none."""
    return jax.device_put(np.zeros((10, pixels), dtype))


def _parts(a: Any) -> Matrix:
    return [[(jnp.real(a[..., i, j]), jnp.imag(a[..., i, j])) for j in (0, 1)] for i in (0, 1)]


def _climb(scene: Scene, balanced: bool, data: Data, start: Any, given: Any, iterations: Any) -> Maximum:
    closed = closed_form(scene, data)
    # a start may come from another model: what is fixed stays
    told = start if len(scene.free) == 5 else jnp.stack([start[2 * i + k] for i in scene.free for k in (0, 1)])
    begun = jnp.where(given != CLOSED_FORM, told, jnp.stack(jax.tree.leaves(closed)))
    patience = jnp.where(given == PATIENT, PATIENCE, 0)
    return maximum(scene, data, *climb(scene, balanced, data, begun, iterations, given != STAY, patience))


described = jax.jit(describe, static_argnums=0)


def from_statistics(
    scene: Scene, balanced: bool, statistics: Statistics, start: Any, given: Any, iterations: Any, one: Any
) -> tuple[Any, Any]:
    """Rows ``(rows, pixels)`` and flags of pixels with statistics of their own.

    ``start`` (10, pixels) are (cosine, sine) of the five angles; ``given`` says how they are used.
    """
    top = climb_statistics(scene, balanced, statistics, start, given, iterations, one)
    found: tuple[Any, Any] = described(scene.outline, one, top)
    return found


@partial(jax.jit, static_argnums=1)
def climb_statistics(
    scene: Scene, balanced: bool, statistics: Statistics, start: Any, given: Any, iterations: Any, one: Any
) -> Maximum:
    """The climb of :func:`from_statistics`."""
    data = prepare(
        balanced,
        _parts(statistics.illumination),
        _parts(statistics.response),
        statistics.residual,
        statistics.constant,
        one,
    )
    return _climb(scene, balanced, data, start, given, iterations)


def from_responses(
    scene: Scene, balanced: bool, response: Any, sigma: Any, shared: Shared, start: Any, given: Any, iterations: Any,
    one: Any,
) -> tuple[Any, Any]:  # fmt: skip
    """The same from the responses ``(pixels, 2, n)`` themselves, where all pixels share the illumination."""
    top = climb_responses(scene, balanced, response, sigma, shared, start, given, iterations, one)
    found: tuple[Any, Any] = described(scene.outline, one, top)
    return found


@partial(jax.jit, static_argnums=1)
def climb_responses(
    scene: Scene, balanced: bool, response: Any, sigma: Any, shared: Shared, start: Any, given: Any, iterations: Any,
    one: Any,
) -> Maximum:  # fmt: skip
    """The climb of :func:`from_responses`.

    ``Y = V Q^H`` and ``E = |V - Y Q|^2`` are formed on the way, the residual directly.
    """
    inverse = 1 / sigma
    states = response.shape[-1]
    real, imaginary = jnp.real(shared.rows), jnp.imag(shared.rows)
    v = []
    for i in (0, 1):
        row = []
        for k in range(states):
            weight = shared.root_weight[k]
            scale = jnp.where(weight > 0, weight, 0) * inverse
            row.append(
                tuple(jnp.where(weight > 0, part(response[:, i, k]) * scale, 0) for part in (jnp.real, jnp.imag))
            )
        v.append(row)
    y = [
        [
            (
                sum(v[i][k][0] * real[j, k] + v[i][k][1] * imaginary[j, k] for k in range(states)),
                sum(v[i][k][1] * real[j, k] - v[i][k][0] * imaginary[j, k] for k in range(states)),
            )
            for j in (0, 1)
        ]
        for i in (0, 1)
    ]
    residual: Any = 0.0
    for i in (0, 1):
        for k in range(states):
            re = v[i][k][0] - sum(y[i][j][0] * real[j, k] - y[i][j][1] * imaginary[j, k] for j in (0, 1))
            im = v[i][k][1] - sum(y[i][j][0] * imaginary[j, k] + y[i][j][1] * real[j, k] for j in (0, 1))
            residual = residual + re * re + im * im
    constant = shared.log_weight - shared.count * jnp.log(pi * sigma * sigma) - residual
    root = [[(re * inverse, im * inverse) for re, im in row] for row in _parts(shared.root)]
    data = prepare(balanced, root, y, residual, constant, one)
    return _climb(scene, balanced, data, start, given, iterations)
