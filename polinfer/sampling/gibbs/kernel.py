"""The compiled code: from a state to the next draws of a block of pixels, with what the diagnostics need."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ...fitting.fast.point import Point, retarder_vector
from ...fitting.fast.priors import FACTORS
from ...records import PERIODS, Parameters
from .circle import angle
from .plan import Plan
from .random import Random, Stream
from .sweep import Observed, State, sweep

__all__ = ["BATCH", "Batch", "advance", "invariants"]

BATCH = 25  # draws of a batch, at most


class Batch(NamedTuple):
    """Consecutive draws ``(BATCH, 5, chains, pixels)``, of the gain and of ``1 / sigma^2`` ``(BATCH, chains, pixels)``.

    Those beyond the number of draws are 0; the last two are None where there is nothing to infer. ``sums`` of the
    invariants less a constant and of their squares, ``(2, invariants, chains, pixels)``.
    """

    parameters: Any
    gain: Any
    precision: Any
    sums: Any


def invariants(plan: Plan, state: State) -> dict[str, Any]:
    """Functions of a state that are the same for all parameter sets of one matrix, those that diagnostics judge by.

    The names are those of :class:`polinfer.sampling.Diagnostics`.
    """
    point = state.point
    (c0, s0), (c1, s1), *_ = point
    d = 2 * s0 * c0
    found: dict[str, Any] = {}
    if {0, 1} & set(plan.free):
        found |= {"polariser.size": jnp.abs(d), "polariser.cos": d * c1, "polariser.sin": d * s1}
    if {2, 3, 4} & set(plan.free):
        q = dict(zip("wxyz", retarder_vector(*point[2:]), strict=True))
        if plan.bounded:
            found |= {f"retarder.{i}": x for i, x in q.items()}
        else:  # the other sign of q is the other sign of the gain
            found |= {f"retarder.{i}{j}": q[i] * q[j] for i in "wxyz" for j in "wxyz" if i <= j and i + j != "zz"}
    if plan.gain != "unit":
        re, im = state.gain
        square = jnp.maximum(re * re + im * im, 1e-30)
        found |= {"gain.cos": (re * re - im * im) / square, "gain.sin": 2 * re * im / square}
        if plan.gain == "complex":
            found["gain.size"] = 0.5 * jnp.log(square)
    if plan.noise != "known":
        found["sigma"] = jnp.log(state.precision)
    return found


def _aligned(plan: Plan, reference: Any, point: Point) -> tuple[Any, Any]:
    """Parameters of the copy nearest to a reference (cosines and sines of the parameters), and the sign of the gain."""
    (c0, s0), (x, y), (c2, s2), (c3, s3), (c4, s4) = point
    sign = jnp.ones_like(c2)
    if not plan.bounded:
        sign = jnp.where(c2 < 0, -1, 1).astype(c2.dtype)
        c2, s2 = sign * c2, sign * s2
    d = 2 * s0 * c0
    d_ref, (cx, sx), (ce, se), (ct, st), (cc, sc) = reference
    movable = set(plan.free)
    if movable >= {0, 1}:
        other = d * d_ref + (x * cx + y * sx) < 0  # half the difference of the squared distances
        flip = jnp.where(other, -1, 1).astype(d.dtype)
        d, x, y = flip * d, flip * x, flip * y
    # the exchanges that move free angles only
    flips, turns = ((1, -1) if movable >= own else (1,) for own in ({2, 3}, {3, 4}))
    if len(flips) * len(turns) > 1:
        # eta = 2 y2: its sine; cosines of the differences, axes count by their doubled angle
        sine = 2 * c2 * s2
        along, across = c3 * ct, s3 * st
        turn = c4 * cc + s4 * sc
        cosine_part = (c2 * c2 - s2 * s2) * ce
        best: Any = -jnp.inf
        a: Any = jnp.ones_like(sine)
        b: Any = a
        for f in flips:
            for g in turns:
                value = cosine_part + f * sine * se + f * along + f * g * across + g * turn
                better = value > best
                best = jnp.where(better, value, best)
                a, b = jnp.where(better, f, a), jnp.where(better, g, b)
        s2, c3, s3 = a * s2, a * c3, a * b * s3
        c4, s4 = b * c4, b * s4
    pairs = ((x, y), (c2, s2), (c3, s3), (c4, s4))
    found = [jnp.clip(d, -1, 1)]
    for name, (c, s) in zip(Parameters._fields[1:], pairs, strict=True):
        half = 0.5 * getattr(PERIODS, name)
        found.append(jnp.clip(angle((c, s)) / getattr(FACTORS, name), -half, half))
    return jnp.stack([jnp.broadcast_to(x, found[0].shape) for x in found]), sign


@partial(jax.jit, static_argnums=1)
def advance(
    plan: Plan, balanced: bool, draws: Any, thin: Any, data: Observed, reference: Any, centre: Any, state: State,
    stream: Stream,
) -> tuple[State, Stream, Batch]:  # fmt: skip
    """``draws`` draws, ``thin`` sweeps apart; ``centre`` (invariants, pixels) is taken off the invariants.

    The draws come in arrays of ``BATCH``, whatever their number: code is compiled for one size.
    """
    dtype = data.residual.dtype

    def one(_: Any, carry: Any) -> Any:
        state, stream = carry
        random = Random(stream, dtype, data.one)
        state = sweep(plan, balanced, data, state, random)
        return state, random.stream

    def told(state: State) -> tuple[Any, Any, Any]:
        parameters, sign = _aligned(plan, reference, state.point)
        gain = None if plan.gain == "unit" else jnp.stack([sign * state.gain[0], sign * state.gain[1]])
        return parameters, gain, None if plan.noise == "known" else state.precision

    def step(k: Any, carry: Any) -> Any:
        state, stream, sums, kept = carry
        state, stream = jax.lax.fori_loop(0, thin, one, (state, stream))
        found, shape = invariants(plan, state), state.precision.shape
        off = jnp.stack([jnp.broadcast_to(x, shape) - c for x, c in zip(found.values(), centre, strict=True)])
        kept = jax.tree.map(lambda room, new: jax.lax.dynamic_update_index_in_dim(room, new, k, 0), kept, told(state))
        return state, stream, sums + jnp.stack([off, off * off]), kept

    sums = jnp.zeros((2, len(centre), *state.precision.shape), dtype)
    kept = jax.tree.map(lambda x: jnp.zeros((BATCH, *x.shape), x.dtype), jax.eval_shape(told, state))
    state, stream, sums, kept = jax.lax.fori_loop(0, draws, step, (state, stream, sums, kept))
    parameters, gain, precision = kept
    return state, stream, Batch(parameters, gain, precision, sums)
