"""How the log posterior of a pixel changes with the phase of the second arm, for any model: automatic differentiation.

The counterpart of :mod:`polinfer.fitting.fast.tilt` for orderings and priors of a user's own, and its witness.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from ..model import Model, as_device
from ..records import Parameters
from ..statistics import Statistics
from .local_gaussian import equivalent
from .newton import value_gradient_hessian

__all__ = ["respond"]

LEAST = 64


@partial(jax.jit, static_argnums=0)
def _derivatives(
    model: Model, points: jax.Array, phase: jax.Array, statistics: Statistics
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Log posterior, gradient and Hessian by the free parameters and the phase, ``(copies, pixels, free + 1)``."""

    def one(point: jax.Array, angle: jax.Array, data: Statistics) -> tuple[jax.Array, jax.Array, jax.Array]:
        def function(x: jax.Array) -> jax.Array:
            values = dict.fromkeys(Parameters._fields, jnp.zeros((), x.dtype))
            values |= {name: x[i] for i, name in enumerate(model.free)}
            turn = jnp.stack([jnp.ones_like(x[-1]) + 0j, jnp.exp(1j * x[-1])])[:, None]
            turned = data._replace(illumination=data.illumination * turn, response=data.response * turn)
            return model.log_density(Parameters(**values), turned)

        return value_gradient_hessian(function, jnp.append(point, angle))

    return jax.vmap(jax.vmap(one), in_axes=(0, None, None))(points, phase, statistics)


def respond(
    model: Model, parameters: Parameters, phase: np.ndarray, statistics: Statistics
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of pixels at their most probable ``parameters`` for ``phase``: log density with the equivalent sets summed, its
    first and second derivative by the phase, ``(pixels)``, and those of the parameters, ``(5, pixels)``.
    """
    pixels, free = len(phase), len(model.free)
    fill = np.concatenate([np.arange(pixels), np.zeros(max(1 << (pixels - 1).bit_length(), LEAST) - pixels, int)])
    own = Parameters(*(np.asarray(x, float)[fill] for x in parameters))
    copies = equivalent(model, own)
    first = np.stack([getattr(own, name) for name in model.free], axis=-1)[None]
    points = np.concatenate([first, np.stack([getattr(copies, name) for name in model.free], axis=-1)])
    data = as_device(Statistics(*(x[fill] for x in statistics)), statistics.response.dtype)
    kind = data.residual.dtype
    found = _derivatives(model, jnp.asarray(points, kind), jnp.asarray(phase[fill], kind), data)
    value, gradient, hessian = (np.asarray(x, float)[:, :pixels] for x in found)
    usable = np.isfinite(value) & np.isfinite(gradient).all(-1) & np.isfinite(hessian).all((-1, -2))
    curvature = np.where(usable[..., None, None], -hessian[..., :free, :free], np.eye(free))
    mixed = np.where(usable[..., None], hessian[..., free, :free], 0)
    climb = np.where(usable[..., None], gradient[..., :free], 0)
    _hold(model, points[:, :pixels], climb, curvature, mixed)
    lowest = np.linalg.eigvalsh(curvature)[..., 0]
    there = usable & (lowest > 0)
    curvature = np.where(there[..., None, None], curvature, np.eye(free))
    mixed, climb = (np.where(there[..., None], x, 0) for x in (mixed, climb))
    step, follow = np.moveaxis(np.linalg.solve(curvature, np.stack([climb, mixed], axis=-1)), -1, 0)
    height = np.where(usable, value, -np.inf)
    # a parabola that rises above the maximum found describes another place
    height = np.minimum(height + 0.5 * np.sum(climb * step, axis=-1), np.maximum(height, height[0]))
    slope = np.where(usable, gradient[..., free] + np.sum(mixed * step, axis=-1), 0)
    bend = np.where(there, hessian[..., free, free] + np.sum(mixed * follow, axis=-1), 0)
    top = height[1:].max(axis=0)
    weight = np.where(np.isfinite(top), np.exp(height[1:] - np.where(np.isfinite(top), top, 0)), 0)
    total = np.maximum(weight.sum(axis=0), 1e-300)
    mean = np.sum(weight * slope[1:], axis=0) / total
    square = np.sum(weight * (bend[1:] + slope[1:] ** 2), axis=0) / total
    moved = np.zeros((5, pixels))
    for i, name in enumerate(model.free):
        moved[Parameters._fields.index(name)] = follow[0, :, i]
    return top + np.log(total), mean, square - mean**2, moved


def _hold(model: Model, points: np.ndarray, gradient: np.ndarray, curvature: np.ndarray, mixed: np.ndarray) -> None:
    """Parameters on a bound that they would leave uphill do not move."""
    eps = 1e-9 if points.dtype == np.float64 else 1e-5
    for name, (low, high) in model.bounds.items():
        k = model.free.index(name)
        near = eps * (high - low)
        stuck = ((points[..., k] <= low + near) & (gradient[..., k] < 0)) | (
            (points[..., k] >= high - near) & (gradient[..., k] > 0)
        )
        gradient[stuck, k], mixed[stuck, k] = 0, 0
        curvature[stuck, k, :], curvature[stuck, :, k] = 0, 0
        curvature[stuck, k, k] = 1
