"""The posterior and its maximum written out once more, in plain NumPy: nothing here is shared with the package.

From the matrix products multiplied out, on the data themselves instead of their sufficient statistics, for the default
priors. The maximum is sought by damped Newton steps with derivatives on paper, from random starts, all at once, in
angles without edges: u of x = c sin u where x is bounded, delta of D = sin delta, in which the matrix is smooth.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erf, log, pi, sqrt
from typing import Any

import numpy as np
from scipy.special import i0, i0e, i1e

BLOCK = 4096  # pixels whose derivatives are in memory at once
ITERATIONS, TOLERANCE = 60, 1e-9  # nats that the next step promises


def _product(a: Any, b: Any) -> np.ndarray:
    return np.array([[a[i][0] * b[0][j] + a[i][1] * b[1][j] for j in range(2)] for i in range(2)])


def _inner(a: np.ndarray, b: np.ndarray) -> Any:
    return sum(a[i, j].conj() * b[i, j] for i in range(2) for j in range(2))


@dataclass(frozen=True)
class Oracle:
    """The default scene: ordering "RetarderFirst" or "PolariserFirst", gain "unit", "phase" or "complex" (of scale 1).

    Points are arrays ``(5, ...)``: D, theta_D, eta, theta_eta, xi; responses are ``(..., 2, n)``.
    """

    ordering: str
    gain: str

    def jones(self, point: Any) -> np.ndarray:
        """Matrices ``(2, 2, ...)``."""
        plus, minus = np.sqrt(np.maximum(1 + point[0], 0)), np.sqrt(np.maximum(1 - point[0], 0))
        return self._jones(0.5 * (plus + minus), 0.5 * (plus - minus), *point[1:])

    def _jones(self, mean: Any, half: Any, td: Any, eta: Any, te: Any, xi: Any) -> np.ndarray:
        """The same from the cosine and the sine of delta / 2: D itself is rounded next to 1, where J is steep in it."""
        c, s = np.cos(eta / 2), np.sin(eta / 2)
        off = -1j * s * np.sin(2 * te)
        diagonal = 1j * s * np.cos(2 * te)
        retarder = [[c + diagonal, off * np.exp(-1j * xi)], [off * np.exp(1j * xi), c - diagonal]]
        cosine, sine = half * np.cos(2 * td), half * np.sin(2 * td)
        polariser = [[mean + cosine, -sine], [-sine, mean - cosine]]
        return _product(polariser, retarder) if self.ordering == "RetarderFirst" else _product(retarder, polariser)

    def log_likelihood(self, point: Any, response: np.ndarray, illumination: np.ndarray, sigma: float) -> Any:
        """Log density of the data, the gain integrated out."""
        return self._log_likelihood(self.jones(point), response, illumination, sigma)

    def _log_likelihood(self, matrix: np.ndarray, response: np.ndarray, illumination: np.ndarray, sigma: float) -> Any:
        n = illumination.shape[-1]
        pairs = [
            (matrix[i][0] * illumination[..., 0, k] + matrix[i][1] * illumination[..., 1, k], response[..., i, k])
            for i in range(2)
            for k in range(n)
        ]
        constant = -2 * n * log(pi * sigma**2)

        def misfit(g: Any) -> Any:
            return sum((g * m - v).real ** 2 + (g * m - v).imag ** 2 for m, v in pairs) / sigma**2

        if self.gain == "unit":
            return constant - misfit(1.0)
        overlap = sum(m.conj() * v for m, v in pairs)
        if self.gain == "complex":
            power = sum(m.real**2 + m.imag**2 for m, _ in pairs)
            best = overlap / (power + sigma**2)
            return constant - misfit(best) - best.real**2 - best.imag**2 - np.log1p(power / sigma**2)
        size = np.abs(overlap)
        return constant - misfit(overlap / size) + np.log(i0e(2 * size / sigma**2))

    def log_prior(self, point: Any) -> Any:
        """Default priors, without their bounds."""
        flat = -2 * log(pi) - log(2 * pi) - log(0.5 * sqrt(2 * pi) * erf(sqrt(2)))
        return flat - 2 * point[0] ** 2 + np.cos(point[4]) - log(2 * pi * i0(1.0))

    def log_posterior(self, point: Any, response: np.ndarray, illumination: np.ndarray, sigma: float) -> Any:
        """Log density of data and parameters."""
        return self.log_likelihood(point, response, illumination, sigma) + self.log_prior(point)

    def maximum(
        self, response: np.ndarray, illumination: np.ndarray, sigma: float, starts: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Best of so many random starts in every pixel: points ``(5, pixels)`` and their log density."""
        pixels = response.shape[0]
        high = np.array([1, pi / 2, pi, pi / 2, pi])[:, None, None]
        points = rng.uniform(-1, 1, (5, starts, pixels)) * high
        found = [self.climb(points[:, k], response, illumination, sigma) for k in range(starts)]
        values = np.array([value for _, value in found])
        best = np.argmax(values, axis=0)
        return np.array([point for point, _ in found])[best, :, np.arange(pixels)].T, np.max(values, axis=0)

    def climb(
        self, point: np.ndarray, response: np.ndarray, illumination: np.ndarray, sigma: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """The maxima that are reached from points ``(5, pixels)``, and the log density there."""
        found, values = point.copy(), np.empty(point.shape[1])
        illumination = np.broadcast_to(illumination, (*response.shape[:-2], *illumination.shape[-2:]))
        for begin in range(0, point.shape[1], BLOCK):
            part = slice(begin, begin + BLOCK)
            found[:, part], values[part] = self._climb(point[:, part], response[part], illumination[part], sigma)
        return found, values

    def _climb(
        self, point: np.ndarray, response: np.ndarray, illumination: np.ndarray, sigma: float
    ) -> tuple[np.ndarray, np.ndarray]:
        # with a unit gain J(eta + 2 pi) = -J, so pi is an edge
        reach = np.array([pi / 2, np.inf, pi if self.gain == "unit" else np.inf, np.inf, np.inf])[:, None]
        bounded = np.isfinite(reach)
        radius = np.where(bounded, reach, 1)
        angles = np.concatenate([np.arcsin(point[:1]), point[1:]])
        u = np.where(bounded, np.arcsin(np.clip(angles / radius, -1, 1)), angles)

        def angles_of(u: np.ndarray) -> np.ndarray:
            return np.where(bounded, radius * np.sin(u), u)

        def value_of(u: np.ndarray, rows: Any) -> np.ndarray:
            angles = angles_of(u)
            matrix = self._jones(np.cos(angles[0] / 2), np.sin(angles[0] / 2), *angles[1:])
            prior = self.log_prior((np.sin(angles[0]), *angles[1:]))
            return np.asarray(self._log_likelihood(matrix, response[rows], illumination[rows], sigma) + prior)

        active = np.arange(point.shape[1])
        value, damping = value_of(u, active), np.full(point.shape[1], 1e-2)
        for _ in range(ITERATIONS):
            angles = angles_of(u[:, active])
            slope, curvature = self._derivatives(angles, response[active], illumination[active], sigma)
            first = np.where(bounded, radius * np.cos(u[:, active]), 1)
            bend = np.where(bounded, -slope * angles, 0)
            slope, curvature = slope * first, curvature * first * first[:, None]
            for i in range(5):
                curvature[i, i] += bend[i]
            size = np.max(np.abs(np.einsum("iip->ip", curvature)), axis=0)
            for attempt in range(8):  # the derivatives stay, a step that does not go up is shortened
                matrix = curvature + damping[active] * size * np.eye(5)[:, :, None]
                step, promised = _solve(matrix, slope)
                length = np.sqrt(np.sum(step**2, axis=0))
                tried = u[:, active] - step * np.minimum(1, 1 / np.where(length > 0, length, 1))
                other = value_of(tried, active)
                good = np.isfinite(length) & (other >= value[active])
                if attempt == 0:
                    done = good & (promised < TOLERANCE)
                u[:, active[good]], value[active[good]] = tried[:, good], other[good]
                lower = np.where(damping[active] < 1e-9, 0, damping[active] / 8)
                damping[active] = np.where(good, lower, 4 * damping[active] + 1e-4)
                keep = ~good
                if not keep.any():
                    break
                # the ones that went up wait for new derivatives
                if attempt == 0:
                    every, finished = active, done
                active, slope, curvature, size = active[keep], slope[:, keep], curvature[:, :, keep], size[keep]
            active = every[~finished] if attempt else active[~done]
            if len(active) == 0:
                break
        angles = angles_of(u)
        return np.concatenate([np.sin(angles[:1]), angles[1:]]), value

    def _derivatives(
        self, angles: np.ndarray, response: np.ndarray, illumination: np.ndarray, sigma: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """First and second derivatives of the negative log density in delta and the four angles."""
        matrix, first, second = self._jones_derivatives(angles)
        adjoint = illumination.conj()
        power = np.einsum("pik,pjk->ijp", illumination, adjoint)
        data = np.einsum("pik,pjk->ijp", response, adjoint)
        loaded, pushed = _product(matrix, power), [_product(m, power) for m in first]
        p = _inner(loaded, matrix).real
        p1 = np.array([2 * _inner(loaded, m).real for m in first])
        a, a1 = _inner(matrix, data), np.array([_inner(m, data) for m in first])
        q, q1 = (a.real, a1.real) if self.gain == "unit" else (np.abs(a), (a.conj() * a1).real / np.abs(a))
        variance = sigma**2
        if self.gain == "unit":
            fp, fq, fpp, fpq, fqq = 1 / variance, -2 / variance, 0.0, 0.0, 0.0
        elif self.gain == "phase":
            z = 2 * q / variance
            ratio = i1e(z) / i0e(z)
            fp, fq, fpp, fpq = 1 / variance, -2 / variance * ratio, 0.0, 0.0
            fqq = -4 / variance**2 * (1 - ratio / z - ratio**2)
        else:
            total = p + variance
            fp, fq = 1 / total + q**2 / (variance * total**2), -2 * q / (variance * total)
            fpp, fpq = -1 / total**2 - 2 * q**2 / (variance * total**3), 2 * q / (variance * total**2)
            fqq = -2 / (variance * total)
        slope = fp * p1 + fq * q1
        curvature = np.empty((5, *slope.shape))
        for i in range(5):
            for j in range(i + 1):
                p2 = 2 * (_inner(pushed[i], first[j]) + _inner(loaded, second[i][j])).real
                a2 = _inner(second[i][j], data)
                q2 = a2.real if self.gain == "unit" else (
                    (a1[i].conj() * a1[j]).real + (a.conj() * a2).real) / q - q1[i] * q1[j] / q  # fmt: skip
                curvature[i, j] = curvature[j, i] = (
                    fp * p2
                    + fq * q2
                    + fpp * p1[i] * p1[j]
                    + fpq * (p1[i] * q1[j] + q1[i] * p1[j])
                    + fqq * q1[i] * q1[j]
                )
        slope[0] += 2 * np.sin(2 * angles[0])
        slope[4] += np.sin(angles[4])
        curvature[0, 0] += 4 * np.cos(2 * angles[0])
        curvature[4, 4] += np.cos(angles[4])
        return slope, curvature

    def _jones_derivatives(self, angles: np.ndarray) -> tuple[np.ndarray, list[np.ndarray], list[list[np.ndarray]]]:
        """The matrix, its first derivatives, and its second ones (j <= i)."""
        delta, td, eta, te, xi = angles
        one = np.eye(2)[:, :, None]

        def axis(t: np.ndarray) -> np.ndarray:
            return np.array([[np.cos(2 * t), -np.sin(2 * t)], [-np.sin(2 * t), -np.cos(2 * t)]])

        def sphere(diagonal: np.ndarray, off: np.ndarray, turn: complex) -> np.ndarray:
            left, right = -off * np.conj(turn) * np.exp(-1j * xi), -off * turn * np.exp(1j * xi)
            return np.array([[diagonal + 0j, left], [right, -diagonal + 0j]])

        c, s, p, dp = np.cos(delta / 2), np.sin(delta / 2), axis(td), 2 * axis(td + pi / 4)
        a = c * one + s * p
        a1 = [0.5 * (c * p - s * one), s * dp]
        a2 = [[-0.25 * a], [0.5 * c * dp, -4 * s * p]]
        c, s, t, nothing = 1j * np.cos(eta / 2), 1j * np.sin(eta / 2), 2 * te, np.zeros_like(xi)
        n, nt = sphere(np.cos(t), np.sin(t), 1), sphere(-2 * np.sin(t), 2 * np.cos(t), 1)
        nx, ntx = sphere(nothing, np.sin(t), 1j), sphere(nothing, 2 * np.cos(t), 1j)
        b = -1j * c * one + s * n
        b1 = [0.5 * (c * n + 1j * s * one), s * nt, s * nx]
        b2 = [[-0.25 * b], [0.5 * c * nt, -4 * s * n], [0.5 * c * nx, s * ntx, s * sphere(nothing, np.sin(t), -1)]]
        forward = self.ordering == "RetarderFirst"

        def multiply(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            return _product(x, y) if forward else _product(y, x)

        first = [multiply(x, b) for x in a1] + [multiply(a, y) for y in b1]
        second = [[multiply(x, b) for x in row] for row in a2]
        second += [[multiply(x, b1[k]) for x in a1] + [multiply(a, y) for y in b2[k]] for k in range(3)]
        return multiply(a, b), first, second


def _solve(matrix: np.ndarray, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solutions ``(5, pixels)`` and the gain that they promise, by Cholesky; NaN where not positive definite."""
    n = len(matrix)
    root: list[list[Any]] = [[None] * n for _ in range(n)]
    half: list[Any] = []
    full: list[Any] = [None] * n
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for j in range(n):
            for i in range(j, n):
                rest = matrix[i, j] - sum(root[i][k] * root[j][k] for k in range(j))
                root[i][j] = np.sqrt(rest) if i == j else rest / root[j][j]
        for i in range(n):
            half.append((vector[i] - sum(root[i][k] * half[k] for k in range(i))) / root[i][i])
        for i in reversed(range(n)):
            full[i] = (half[i] - sum(root[k][i] * full[k] for k in range(i + 1, n))) / root[i][i]
    return np.array(full), 0.5 * sum(x**2 for x in half)
