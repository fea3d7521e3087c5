"""The posterior and its maximum written out once more: nothing here is shared with the package.

From the matrix products multiplied out, on the data themselves instead of their sufficient statistics, for the default
priors; in NumPy or JAX alike. The maximum is sought by damped Newton steps from random starts, all at once, in angles
(delta with D = sin delta) in which nothing is singular but the axis of an element that does nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import erf, log, pi, sqrt
from typing import Any

import jax
import jax.numpy as jnp
import jax.scipy.special
import numpy as np
import scipy.special

BLOCK = 2**15  # optimisations that are in memory at once
ITERATIONS, POLISHING = 40, 60


@dataclass(frozen=True)
class Oracle:
    """The default scene: ordering by name, gain "unit", "phase" or "complex" (of scale 1).

    Points are arrays ``(5, ...)``: D, theta_D, eta, theta_eta, xi; responses ``(..., 2, n)``.
    """

    ordering: str
    gain: str

    def jones(self, point: Any, xp: Any = np) -> list[list[Any]]:
        """Elements of the matrix."""
        d, td, eta, te, xi = point
        plus, minus = xp.sqrt(xp.maximum(1 + d, 0)), xp.sqrt(xp.maximum(1 - d, 0))
        return self._product(0.5 * (plus + minus), 0.5 * (plus - minus), td, eta, te, xi, xp)

    def _product(self, m: Any, half: Any, td: Any, eta: Any, te: Any, xi: Any, xp: Any) -> list[list[Any]]:
        c, s = xp.cos(eta / 2), xp.sin(eta / 2)
        off = -1j * s * xp.sin(2 * te)
        retarder = [
            [c + 1j * s * xp.cos(2 * te), off * xp.exp(-1j * xi)],
            [off * xp.exp(1j * xi), c - 1j * s * xp.cos(2 * te)],
        ]
        cosine, sine = half * xp.cos(2 * td), half * xp.sin(2 * td)
        polariser = [[m + cosine, -sine], [-sine, m - cosine]]
        a, b = (polariser, retarder) if self.ordering == "RetarderFirst" else (retarder, polariser)
        return [[a[i][0] * b[0][j] + a[i][1] * b[1][j] for j in range(2)] for i in range(2)]

    def log_likelihood(self, point: Any, response: Any, illumination: Any, sigma: float, xp: Any = np) -> Any:
        """Log density of the data, the gain integrated out."""
        return self._log_data(self.jones(point, xp), response, illumination, sigma, xp)

    def _log_data(self, matrix: Any, response: Any, illumination: Any, sigma: float, xp: Any) -> Any:
        n = illumination.shape[-1]
        seen = [[matrix[i][0] * illumination[..., 0, k] + matrix[i][1] * illumination[..., 1, k] for k in range(n)]
                for i in range(2)]  # fmt: skip
        data = [[response[..., i, k] for k in range(n)] for i in range(2)]
        pairs = [(seen[i][k], data[i][k]) for i in range(2) for k in range(n)]
        constant = -2 * n * log(pi * sigma**2)

        def misfit(g: Any) -> Any:
            return sum((g * m - v).real ** 2 + (g * m - v).imag ** 2 for m, v in pairs) / sigma**2

        if self.gain == "unit":
            return constant - misfit(1.0)
        overlap = sum(m.conj() * v for m, v in pairs)
        power = sum(m.real**2 + m.imag**2 for m, _ in pairs)
        if self.gain == "complex":
            best = overlap / (power + sigma**2)
            return constant - misfit(best) - best.real**2 - best.imag**2 - xp.log1p(power / sigma**2)
        size = xp.sqrt(overlap.real**2 + overlap.imag**2)
        i0e = (scipy if xp is np else jax.scipy).special.i0e
        return constant - misfit(overlap / size) + xp.log(i0e(2 * size / sigma**2))

    def log_prior(self, point: Any, xp: Any = np) -> Any:
        """Default priors, without their bounds."""
        d, xi = point[0], point[4]
        flat = -2 * log(pi) - log(2 * pi) - log(0.5 * sqrt(2 * pi) * erf(sqrt(2)))
        return flat - 2 * d**2 + xp.cos(xi) - log(2 * pi * scipy.special.i0(1.0))

    def log_posterior(self, point: Any, response: Any, illumination: Any, sigma: float, xp: Any = np) -> Any:
        """Log density of data and parameters."""
        return self.log_likelihood(point, response, illumination, sigma, xp) + self.log_prior(point, xp)

    def parameters(self, chart: Any, xp: Any = np) -> Any:
        """Points of coordinates without bounds."""
        delta, td, eta, te, xi = chart
        # with a unit gain J(eta + 2 pi) = -J, so pi is an edge
        return xp.stack([xp.sin(delta), td, pi * xp.sin(eta) if self.gain == "unit" else eta, te, xi])

    def chart(self, point: np.ndarray) -> np.ndarray:
        """Coordinates of points."""
        d, td, eta, te, xi = point
        bounded = np.arcsin(np.clip(eta / pi, -1, 1)) if self.gain == "unit" else eta
        return np.stack([np.arcsin(np.clip(d, -1, 1)), td, bounded, te, xi])

    def from_chart(self, chart: Any, response: Any, illumination: Any, sigma: float) -> Any:
        """Negative log density at coordinates without bounds, in JAX."""
        delta, td, _, te, xi = chart
        point = self.parameters(chart, jnp)
        matrix = self._product(jnp.cos(delta / 2), jnp.sin(delta / 2), td, point[2], te, xi, jnp)
        return -(self._log_data(matrix, response, illumination, sigma, jnp) + self.log_prior(point, jnp))

    def climb(self, point: np.ndarray, response: np.ndarray, illumination: np.ndarray, sigma: float,
              iterations: int = POLISHING) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Points ``(5, pixels)`` after damped Newton steps, and the log density there."""
        chart, found, values = self.chart(point), np.empty(point.shape), np.empty(point.shape[1])
        illumination = np.broadcast_to(illumination, (*response.shape[:-2], *illumination.shape[-2:]))
        step = _newton(self, sigma)
        for begin in range(0, point.shape[1], BLOCK):
            part = slice(begin, begin + BLOCK)
            fill = np.minimum(np.arange(begin, begin + min(BLOCK, point.shape[1])), point.shape[1] - 1)
            place = (jnp.asarray(chart[:, fill]), jnp.asarray(response[fill]), jnp.asarray(illumination[fill]))
            end, value = (np.asarray(x) for x in step(*place, iterations))
            count = len(values[part])
            found[:, part], values[part] = self.parameters(end[:, :count]), -value[:count]
        return found, values

    def maximum(self, response: np.ndarray, illumination: np.ndarray, sigma: float, starts: int, rng: Any,
                ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Best of so many random starts in every pixel: points ``(5, pixels)`` and their log density."""
        pixels = response.shape[0]
        illumination = np.broadcast_to(illumination, (pixels, *illumination.shape[-2:]))
        high = np.array([1, pi / 2, pi, pi / 2, pi])[:, None]
        point = rng.uniform(-1, 1, (5, starts * pixels)) * high
        every = np.tile(np.arange(pixels), starts)
        found, values = self.climb(point, response[every], illumination[every], sigma, ITERATIONS)
        best = np.argmax(np.nan_to_num(values, nan=-np.inf).reshape(starts, pixels), axis=0)
        return self.climb(found[:, best * pixels + np.arange(pixels)], response, illumination, sigma)


@cache
def _newton(oracle: Oracle, sigma: float) -> Any:
    """Compiled minimisation of many pixels at once; a step that does not go down is taken again, shorter."""

    def one(chart: jax.Array, response: jax.Array, illumination: jax.Array) -> jax.Array:
        return oracle.from_chart(chart, response, illumination, sigma)

    batch = {"in_axes": (1, 0, 0)}
    value_of = jax.vmap(one, **batch)
    slope_of = jax.vmap(jax.grad(one), **batch, out_axes=1)
    curvature_of = jax.vmap(jax.jacfwd(jax.grad(one)), **batch, out_axes=2)

    @jax.jit
    def minimise(chart: jax.Array, response: jax.Array, illumination: jax.Array, iterations: int) -> Any:
        def body(_: int, state: Any) -> Any:
            chart, value, damping = state
            slope = slope_of(chart, response, illumination)
            curvature = curvature_of(chart, response, illumination)
            size = jnp.einsum("iip->ip", jnp.abs(curvature)).max(axis=0)
            added = damping * size
            step = _solve([[curvature[i, j] + (added if i == j else 0) for j in range(5)] for i in range(5)], slope)
            length = jnp.sqrt(jnp.sum(step**2, axis=0))
            tried = chart - step * jnp.minimum(1, 1 / jnp.where(length > 0, length, 1))
            other = value_of(tried, response, illumination)
            good = (other <= value) & jnp.isfinite(length)
            damping = jnp.where(good, jnp.where(damping < 1e-9, 0, damping / 8), 4 * damping + 1e-4)
            return jnp.where(good, tried, chart), jnp.where(good, other, value), damping

        start = (chart, value_of(chart, response, illumination), jnp.full(chart.shape[1], 1e-2))
        return jax.lax.fori_loop(0, iterations, body, start)[:2]

    return minimise


def _solve(matrix: list[list[Any]], vector: Any) -> Any:
    """Cholesky written out over the pixels; where the matrix is not positive definite the result is NaN."""
    n = len(matrix)
    root: list[list[Any]] = [[None] * n for _ in range(n)]
    for j in range(n):
        for i in range(j, n):
            rest = matrix[i][j] - sum(root[i][k] * root[j][k] for k in range(j))
            root[i][j] = jnp.sqrt(rest) if i == j else rest / root[j][j]
    half: list[Any] = []
    for i in range(n):
        half.append((vector[i] - sum(root[i][k] * half[k] for k in range(i))) / root[i][i])
    full: list[Any] = [None] * n
    for i in reversed(range(n)):
        full[i] = (half[i] - sum(root[k][i] * full[k] for k in range(i + 1, n))) / root[i][i]
    return jnp.stack(full)
