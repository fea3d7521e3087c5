"""Coordinates in which an ensemble of walkers sees no edge and no copies, and the density there.

The priors are flat, or at least finite, in the angles. Against the uniform measure of the quaternions of the retarder,
or of the disk of the polariser, they would have poles, ``1 / (sin^2(eta / 2) |sin 2 theta_eta|)`` and ``1 / |D|``, in
which a walker sticks. The coordinates are therefore the angles, with D = sin delta, in which the matrix is smooth:

- A circle of period P is unrolled onto a line, and the density is multiplied by a share of the distance u from a
  centre: 1 up to |u| = 0.35 P, 0 from 0.65 P on, and a squared cosine between. Of the copies of every angle that lie
  P apart the shares add up to 1, so the angle modulo P keeps its distribution and the integral its value, and there is
  neither a wrap nor an edge. A density narrower than 0.35 P has one copy only, and no faint ones that walkers miss.
- The density is the sum over the equivalent copies of a point (:func:`polinfer.orbit`; the maps keep volumes), times a
  factor that adds up to 1 over the copies of every point and is next to 1 near the centre: shares of
  ``exp(6 sum_i cos(2 pi u_i / P_i))``. Copies differ by half a period in at least one circle, so the walkers need to
  know one of them only, and the integral stays the same. :meth:`Target.unfold` then draws the copy with the
  probability that its density gives it, exactly.

What is left are the bounds of delta, where its Jacobian ``cos delta`` vanishes, and those of eta where the gain is 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from math import asin, inf, pi
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..circular import wrap
from ..degeneracy import reduce_ranges
from ..fitting.local_gaussian import distinct_copies
from ..model import Model
from ..records import PERIODS, Parameters

__all__ = ["Target", "centre_of", "copies", "draw_prior", "into_chart", "log_window", "periods"]

BLOCK = 1024  # points of a large batch
RAMP = 0.15  # half the length of the ramp between shares of 1 and 0, in periods
CONTRAST = 6.0  # a copy at a distance has e^-12 of the weight


@cache
def copies(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Signs and shifts ``(copies, free)`` of the maps ``x -> sign x + shift`` between equivalent copies.

    They are the rows of :func:`polinfer.orbit` that the model can tell apart, in its order.

    >>> signs, shifts = copies(Model(fixed={"diattenuation": 0.0, "circularity": 0.0}))
    >>> signs.tolist(), (shifts / np.pi).tolist()
    ([[1.0, 1.0], [-1.0, 1.0]], [[0.0, 0.0], [0.0, 0.5]])
    """
    half, quarter = pi, 0.5 * pi
    polarisers = (((1, 1), (0, 0)), ((-1, 1), (0, quarter)))
    retarders = (((1, 1, 1), (0, 0, 0)), ((-1, 1, 1), (0, quarter, 0)), ((1, -1, 1), (0, 0, half)),
                 ((-1, -1, 1), (0, quarter, half)))  # fmt: skip
    rows = [((*p, *r), (*a, *b)) for p, a in polarisers for r, b in retarders]
    table = np.array(rows, float)[distinct_copies(model)]
    columns = [Parameters._fields.index(name) for name in model.free]
    return table[:, 0, columns], table[:, 1, columns]


@cache
def periods(model: Model) -> np.ndarray:
    """Period ``(free,)`` of every coordinate; infinite for delta, and for eta where the gain is 1."""
    bounded = () if model.known_gain.free_phase else ("retardance",)
    return np.array([inf if name in bounded else getattr(PERIODS, name) for name in model.free])


def centre_of(model: Model, parameters: Parameters) -> np.ndarray:
    """Coordinates ``(..., free)`` of parameters."""
    columns = [np.asarray(getattr(parameters, name), float) for name in model.free]
    if "diattenuation" in model.free:
        k = model.free.index("diattenuation")
        columns[k] = np.arcsin(np.clip(columns[k], -1, 1))
    return np.stack(columns, axis=-1)


def draw_prior(model: Model, centre: np.ndarray, rng: np.random.Generator, count: int) -> np.ndarray:
    """Coordinates ``(count, free)`` whose density is ``Target.evaluate(x)[1]``."""
    columns = {name: np.asarray(model.priors[name].sample(rng, (count,)), float) for name in model.free}
    x = centre_of(model, Parameters(**(dict.fromkeys(Parameters._fields, 0.0) | columns)))
    return into_chart(model, centre, x, rng)


def into_chart(model: Model, centre: np.ndarray, x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Coordinates ``(points, free)`` moved to copies and turns at random, in proportion to the shares there.

    Draws of a posterior (any copies) become draws of ``Target``.
    """
    signs, shifts = copies(model)
    kernel = _log_kernel(model, centre, x)
    chosen = np.argmax(kernel + rng.gumbel(size=kernel.shape), axis=1)
    x = signs[chosen] * x + shifts[chosen]
    period = periods(model)
    circle = np.isfinite(period)
    u = x[:, circle] - centre[circle]
    size = period[circle]
    u -= size * np.floor(u / size)  # in [0, P): the other copy within reach is at u - P
    x[:, circle] = centre[circle] + np.where(rng.uniform(size=u.shape) < _root_share(u / size) ** 2, u, u - size)
    return x


def _root_share(u: Any) -> Any:
    """Square root of the share of an angle ``u`` periods from the centre."""
    xp: Any = np if isinstance(u, np.ndarray) else jnp
    return xp.cos(0.5 * pi * xp.clip((abs(u) - 0.5 + RAMP) / (2 * RAMP), 0, 1))


def _log_kernel(model: Model, centre: Any, x: Any) -> Any:
    """Logarithms of the shares ``(points, copies)`` of the copies of a point, up to a constant for each point."""
    xp: Any = np if isinstance(x, np.ndarray) else jnp
    signs, shifts = copies(model)
    period = periods(model)
    circle = np.isfinite(period)
    u = (signs * x[:, None, :] + shifts - centre)[..., circle] / period[circle]
    return CONTRAST * xp.sum(xp.cos(2 * pi * u), axis=-1)


def log_window(model: Model, centre: Any, x: Any) -> Any:
    """What the log density of coordinates ``(points, free)`` is multiplied by, ``(points,)``: both shares together."""
    xp: Any = np if isinstance(x, np.ndarray) else jnp
    period = periods(model)
    circle = np.isfinite(period)
    u = (x[:, circle] - centre[circle]) / period[circle]
    inside = xp.all(abs(u) < 0.5 + RAMP, axis=1)
    if "diattenuation" in model.free:
        inside = inside & (abs(x[:, model.free.index("diattenuation")]) <= asin(1.0))
    factor = xp.where(inside[:, None], _root_share(u), 1.0)
    kernel = _log_kernel(model, centre, x)
    top = xp.max(kernel, axis=1)
    share = kernel[:, 0] - top - xp.log(xp.sum(xp.exp(kernel - top[:, None]), axis=1))
    return xp.where(inside, share + 2 * xp.sum(xp.log(factor), axis=1), -xp.inf)


@partial(jax.jit, static_argnums=0)
def _log_copies(model: Model, x: jax.Array, statistics: Any) -> tuple[jax.Array, jax.Array]:
    """Log posterior and log prior ``(points, copies)`` of the copies of coordinates ``(points, free)``."""
    signs, shifts = (jnp.asarray(table, x.dtype) for table in copies(model))
    moved = signs * x[:, None, :] + shifts
    values = dict.fromkeys(Parameters._fields, jnp.zeros(moved.shape[:-1], x.dtype))
    jacobian = jnp.zeros(x.shape[:1], x.dtype)
    for i, (name, period) in enumerate(zip(model.free, periods(model), strict=True)):
        value = moved[..., i]
        if name == "diattenuation":
            jacobian = jnp.log(jnp.maximum(jnp.cos(x[:, i]), 0))
            value = jnp.sin(value)
        values[name] = wrap(value, period) if np.isfinite(period) else value
    parameters = Parameters(**values)
    one = jax.tree.map(lambda a: a[None, None], statistics)
    found = model.log_density(parameters, one), model.log_prior(parameters)
    density, prior = (jnp.where(jnp.isnan(a), -jnp.inf, a) + jacobian[:, None] for a in found)
    return density, prior


@partial(jax.jit, static_argnums=0)
def _log_target(model: Model, x: jax.Array, centre: jax.Array, statistics: Any) -> jax.Array:
    """Log density and log prior density of coordinates ``(points, free)``, ``(2, points)``."""
    every = jnp.stack(_log_copies(model, x, statistics))
    return jax.nn.logsumexp(every, axis=-1) + log_window(model, centre, x)


@dataclass(frozen=True, eq=False)
class Target:
    """The density of one pixel in these coordinates; its integral over them is the evidence.

    ``statistics`` are those of one pixel or window, without a pixel axis, on the device; ``centre`` ``(free,)`` is
    where the circles are unrolled from. Batches are padded to ``rows``, four times as many, or ``BLOCK`` points, so
    that three shapes are compiled.
    """

    model: Model
    statistics: Any
    centre: np.ndarray
    rows: int

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Log density ``(points,)`` of coordinates ``(points, free)``."""
        return self.evaluate(x)[0]

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Log density and log prior density ``(points,)`` at coordinates ``(points, free)``."""
        sizes = (size for size in (self.rows, 4 * self.rows) if len(x) <= size)
        parts = [
            np.asarray(_log_target(self.model, padded, self.centre, self.statistics), float)[:, :count]
            for padded, count in self._batches(x, next(sizes, BLOCK))
        ]
        density, prior = np.concatenate(parts, axis=1)
        return density, prior

    def unfold(self, x: np.ndarray, rng: np.random.Generator) -> Parameters:
        """Parameters ``(points,)`` of coordinates, each moved to one of its copies; NaN where dropped."""
        density = np.concatenate([
            np.asarray(_log_copies(self.model, padded, self.statistics)[0], float)[:count]
            for padded, count in self._batches(x, BLOCK)
        ])  # fmt: skip
        chosen = np.argmax(density + rng.gumbel(size=density.shape), axis=1)  # draws from the normalised densities
        signs, shifts = copies(self.model)
        moved = signs[chosen] * x + shifts[chosen]
        values: dict[str, Any] = {name: np.full(len(x), value) for name, value in self.model.fixed.items()}
        values |= {name: np.zeros(len(x)) for name in self.model.dropped}
        values |= {name: moved[:, i] for i, name in enumerate(self.model.free)}
        if "diattenuation" in self.model.free:
            values["diattenuation"] = np.sin(values["diattenuation"])
        found = reduce_ranges(Parameters(**values))._asdict()
        found |= {name: values[name] for name in self.model.fixed}
        return Parameters(**(found | {name: np.full(len(x), np.nan) for name in self.model.dropped}))

    def _batches(self, x: np.ndarray, size: int) -> Iterator[tuple[np.ndarray, int]]:
        """The points in parts of one size, and how many of a part are meant."""
        for begin in range(0, len(x), size):
            part = x[begin : begin + size]
            yield np.concatenate([part, np.broadcast_to(self.centre, (size - len(part), x.shape[1]))]), len(part)
