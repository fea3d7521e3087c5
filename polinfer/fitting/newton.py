"""Damped Newton iterations on the log posterior of many one-pixel problems at once.

One problem is a pixel and a start. The Hessian is exact (automatic differentiation), its eigenvalues are made positive,
the step is limited. Along a narrow curved valley of misfit the way leads over its side: a step that lowers the density
is taken if one of the few after it comes out higher, else it is taken back and damped. A fixed number of problems
(lanes) is advanced together by compiled code; finished ones make room for the next, so that a slow pixel does not hold
up the others.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..model import Model
from ..neighbours import Windowed
from ..statistics import Statistics
from .charts import to_parameters

__all__ = ["maximise"]

ROUND = 6  # iterations between two looks at which lanes have finished
LONGEST_STEP = 0.7  # radians in chart coordinates
KICK = 0.05  # step off a saddle
PATIENCE = 4  # steps that may lie below the best point
LANES = 128  # problems that compiled code advances at once


class _Place(NamedTuple):
    """A point and the log posterior there."""

    point: Any
    value: Any
    gradient: Any
    hessian: Any


class _State(NamedTuple):
    """Of every problem: where it is, and the best so far; JAX arrays inside compiled code, NumPy arrays outside.

    ``astray`` counts the steps since the best.
    """

    here: _Place
    best: _Place
    astray: Any
    damping: Any
    finished: Any
    converged: Any


def tolerance(dtype: np.dtype) -> float:
    """Largest accepted Newton decrement, squared: twice the nats that are still to be gained."""
    return 1e-10 if dtype == np.float64 else 2e-4


def value_gradient_hessian(
    function: Callable[[jax.Array], jax.Array], point: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Value, gradient and Hessian of a scalar function in one pass."""

    def gradient(x: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        value, slope = jax.value_and_grad(function)(x)
        return slope, (value, slope)

    hessian, (value, slope) = jax.jacfwd(gradient, has_aux=True)(point)
    return value, slope, hessian


def _advance(model: Model, statistics: Statistics | Windowed, state: _State) -> _State:
    """One iteration of one problem."""
    here, dtype = state.here, state.here.point.dtype
    eps = jnp.finfo(dtype).eps
    # Unit diagonal: what the prior says of a parameter that the data do not see is not lost beside a curvature of 1e16.
    scale = jnp.sqrt(jnp.maximum(jnp.abs(jnp.diagonal(here.hessian)), 1e-3))
    # the slope is rounded like eps times the square of the signal-to-noise ratio, the step like eps times that ratio
    enough = tolerance(np.dtype(dtype)) + 10 * (eps * jnp.max(scale)) ** 2
    curvature, axes = jnp.linalg.eigh(-here.hessian / (scale[:, None] * scale))
    floor = 30 * eps
    slope = axes.T @ (here.gradient / scale)
    size = jnp.maximum(jnp.abs(curvature), floor)
    # along negative curvature the point is not a maximum even if the slope vanishes there
    kick = KICK / jnp.max(jnp.abs(axes / scale[:, None]), axis=0)
    saddle = (curvature < -floor) & (-curvature * kick**2 > 2 * enough)
    decrement = jnp.sum(slope**2 / size)
    converged = (decrement < enough) & ~jnp.any(saddle) & jnp.isfinite(here.value) & (state.astray == 0)
    step = slope / (size + state.damping)
    kick = jnp.where(slope < 0, -kick, kick) / (1 + state.damping)
    step = (axes @ jnp.where(saddle & (jnp.abs(step) < jnp.abs(kick)), kick, step)) / scale
    step = step * jnp.minimum(1, LONGEST_STEP / jnp.maximum(jnp.max(jnp.abs(step)), 1e-30))
    first = ~jnp.isfinite(here.value)  # the state holds no density yet: look at the point itself
    trial = jnp.where(first, here.point, here.point + step)
    value, gradient, hessian = value_gradient_hessian(
        lambda x: model.log_density(to_parameters(model, x), statistics), trial
    )
    usable = jnp.isfinite(value) & jnp.all(jnp.isfinite(gradient)) & jnp.all(jnp.isfinite(hessian))
    # a residual near its minimum is rounded like eps times the signal-to-noise ratio
    rounding = 20 * eps * (1 + jnp.max(scale))
    better = usable & (first | (value >= state.best.value - rounding)) & ~converged
    lower = usable & ~better & ~converged & (state.astray < PATIENCE)
    damping = jnp.where(better, 0.1 * state.damping, jnp.maximum(10 * state.damping, 1e-2))
    damping = jnp.where(damping < 1e-3, 0, damping)
    damping = jnp.where(first, 0, jnp.where(lower, state.damping, damping))
    stuck = ~first & ~better & (jnp.max(jnp.abs(step)) < 30 * eps)
    new = _Place(trial, value, gradient, hessian)
    best = jax.tree.map(partial(jnp.where, better), new, state.best)
    return _State(
        jax.tree.map(partial(jnp.where, lower), new, best),
        best,
        jnp.where(lower, state.astray + 1, 0),
        damping,
        state.finished | converged | stuck | (first & ~usable),
        state.converged | converged,
    )


@partial(jax.jit, static_argnums=0)
def _advance_round(model: Model, statistics: Statistics | Windowed, state: _State) -> _State:
    step = jax.vmap(partial(_advance, model))

    def body(carry: tuple[jax.Array, _State]) -> tuple[jax.Array, _State]:
        count, now = carry
        new = step(statistics, now)
        keep = jax.tree.map(lambda a, b: jnp.where(now.finished.reshape(-1, *(1,) * (a.ndim - 1)), b, a), new, now)
        return count + 1, keep

    def condition(carry: tuple[jax.Array, _State]) -> jax.Array:
        return (carry[0] < ROUND) & ~jnp.all(carry[1].finished)

    return jax.lax.while_loop(condition, body, (jnp.zeros((), int), state))[1]


def _fresh(points: np.ndarray) -> _State:
    lanes, free = points.shape
    dtype = points.dtype
    place = _Place(
        points,
        np.full(lanes, -np.inf, dtype),
        np.zeros((lanes, free), dtype),
        np.broadcast_to(-np.eye(free, dtype=dtype), (lanes, free, free)),
    )
    return _State(
        jax.tree.map(np.copy, place),
        jax.tree.map(np.copy, place),
        np.zeros(lanes, np.int32),
        np.zeros(lanes, dtype),
        np.zeros(lanes, bool),
        np.zeros(lanes, bool),
    )


def maximise(
    model: Model, statistics: Statistics | Windowed, pixels: np.ndarray, points: np.ndarray, iterations: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Maximise the log posterior of ``pixels[i]`` (an index into the statistics) from ``points[i]``, for every i.

    Returns the coordinates ``(problems, free)``, the log posterior and whether the iteration converged.
    """
    problems = len(points)
    state = _fresh(points)
    spent = np.zeros(problems, int)
    waiting = np.arange(problems)
    host = jax.tree.map(np.asarray, statistics)
    while len(waiting):
        active, waiting = waiting[:LANES], waiting[LANES:]
        index = np.concatenate([active, np.full(LANES - len(active), active[0])])
        lane = jax.tree.map(lambda x, chosen=index: x[chosen], state)
        lane.finished[len(active) :] = True
        data = jax.tree.map(lambda x, chosen=pixels[index]: x[chosen], host)
        done = _advance_round(model, data, lane)
        for old, new in zip(jax.tree.leaves(state), jax.tree.leaves(done), strict=True):
            old[active] = np.asarray(new)[: len(active)]
        spent[active] += ROUND
        again = active[~state.finished[active] & (spent[active] < iterations)]
        waiting = np.concatenate([waiting, again])
    return state.best.point, state.best.value, state.converged
