"""Basis pursuit denoising: the smallest l1 norm that explains the data, for many right-hand sides of one matrix.

In: a matrix, right-hand sides, how large their residuals may be. Out: solutions with residuals recomputed from the
arguments, and a status that can be relied on. Called by :class:`fibre.BasisPursuit` and by users.
"""

from __future__ import annotations

import enum
from typing import Any, NamedTuple

import numpy as np

from polinfer.checks import complex_array, integer, real_array, real_number

__all__ = ["DenoiseStatus", "Solution", "basis_pursuit_denoise"]

BALANCE = 5.0  # of the two constraints: what the root mean square singular value is made
EVERY = 10  # iterations between two looks at the gap
SLACK = 1e-3  # of the residual, relative to delta
RANK = 1e-12  # singular values below this, of the largest, are none


class DenoiseStatus(enum.IntFlag):
    """What to know about a solution; flags add up."""

    OK = 0
    NOT_CONVERGED = 1  # its norm may be larger than the least by more than the tolerance: allow more iterations
    INFEASIBLE = 2  # no x has a residual of delta or less: the solution is that of the least one


class Solution(NamedTuple):
    """x: complex (n, k). residual: (k,), ||A x - b||, recomputed. status: (k,) :class:`DenoiseStatus`. gap: (k,), by
    how much at most the norm exceeds the least one, relative. iterations: how many."""

    x: np.ndarray
    residual: np.ndarray
    status: np.ndarray
    gap: np.ndarray
    iterations: int


def basis_pursuit_denoise(
    matrix: Any,
    rhs: Any,
    delta: Any,
    weights: Any = None,
    start: Any = None,
    tolerance: float = 1e-3,
    iterations: int = 5000,
) -> Solution:
    r"""Minimise an l1 norm within a ball of residuals, for every column of ``rhs``.

    .. math:: \min_x \sum_j w_j |x_j| \quad \text{subject to} \quad \|A x - b\|_2 \le \delta

    Alternating directions with the constraints x = z, A x = y: the least-squares step needs one singular value
    decomposition of A for all right-hand sides and iterations, so that closely similar columns of A do no harm; z is
    shrunk and y is put back into the ball, each in closed form. The step length of every right-hand side follows its
    own residuals. The dual problem gives a lower bound of the norm, and so the ``gap`` at which a right-hand side is
    finished.

    A and b are brought to unit size first, so that results scale with the data. The residual is certified: it is
    recomputed, and at most delta (1 + 1e-3) (or 1e-12 of b, where delta asks for less than rounding), or the status
    says not.

    Parameters
    ----------
    matrix: complex or real (m, n). rhs: (m, k). delta: (k,) or one number, >= 0, in the unit of rhs. weights: > 0, of
    all right-hand sides (n,) or of each its own (n, k); None: 1. start: (n, k) to begin with, or None. tolerance:
    relative gap, > 0. iterations: most, >= 1.

    Raises
    ------
    ValueError: shapes, values that are not finite, numbers out of range.

    Source: Boyd et al., Found. Trends Mach. Learn. 3, 1 (2011), for alternating directions; the problem is that of
    van den Berg and Friedlander, SIAM J. Sci. Comput. 31, 890 (2008), solved otherwise.

    >>> from fibre import basis_pursuit_denoise
    >>> rng = np.random.default_rng(0)
    >>> matrix = rng.normal(size=(20, 50)) + 1j * rng.normal(size=(20, 50))
    >>> x = np.zeros((50, 1), complex)
    >>> x[[3, 30], 0] = [1, 2j]
    >>> found = basis_pursuit_denoise(matrix, matrix @ x, 1e-6)
    >>> bool(np.allclose(found.x, x, atol=0.01)), int(found.status[0]), bool(found.residual[0] <= 1.001e-6)
    (True, 0, True)
    """
    given = complex_array("matrix", matrix, shape=(None, None), finite=True)
    m, n = given.shape
    wanted = complex_array("rhs", rhs, shape=(m, None), finite=True)
    count = wanted.shape[1]
    ball = np.broadcast_to(np.asarray(delta, float), (count,)) if np.ndim(delta) == 0 else delta
    ball = real_array("delta", ball, shape=(count,), low=0, finite=True).astype(float)
    shape = (n, count) if np.ndim(weights) == 2 else (n,)
    weight = real_array("weights", np.ones(n) if weights is None else weights, shape=shape, above=0, finite=True)
    weight = np.broadcast_to(weight if weight.ndim == 2 else weight[:, None], (n, count))
    tolerance, iterations = real_number("tolerance", tolerance, above=0), integer("iterations", iterations, low=1)
    before = None if start is None else complex_array("start", start, shape=(n, count), finite=True)

    a, b = given.astype(complex), wanted.astype(complex)
    size = np.linalg.norm(b, axis=0)
    x, gap, spent = np.zeros((n, count), complex), np.zeros(count), 0
    sought = np.flatnonzero(size > ball)
    if len(sought) and np.any(a):
        problem = _Problem(a, b[:, sought] / size[sought], ball[sought] / size[sought], weight[:, sought])
        first = None if before is None else before[:, sought] / size[sought]
        found, gap[sought], spent = problem.solve(first, tolerance, iterations)
        x[:, sought] = found * size[sought]
    x = x.astype(np.result_type(given, wanted))
    residual = np.linalg.norm(a @ x - b, axis=0)
    status = np.where(gap > tolerance, DenoiseStatus.NOT_CONVERGED, 0)
    rounding = (1e-12 if x.dtype == complex else 1e-6) * size
    status |= np.where(residual > np.maximum((1 + SLACK) * ball, rounding), DenoiseStatus.INFEASIBLE, 0)
    return Solution(x, residual, status.astype(np.uint8), gap, spent)


class _Problem:
    """Right-hand sides of unit length, in the coordinates of the singular vectors.

    A = U S V^H: what of b is outside the range of A is part of any residual, and is taken off the ball.
    """

    def __init__(self, matrix: np.ndarray, rhs: np.ndarray, ball: np.ndarray, weight: np.ndarray) -> None:
        left, singular, right = np.linalg.svd(matrix, full_matrices=False)
        kept = singular > RANK * singular[0]
        self.scale = float(np.sqrt((singular[kept] ** 2).mean())) / BALANCE
        self.singular = (singular[kept] / self.scale)[:, None]
        self.right, self.back = right[kept], np.ascontiguousarray(right[kept].conj().T)
        self.target = left[:, kept].conj().T @ rhs
        outside = np.linalg.norm(rhs - left[:, kept] @ self.target, axis=0)
        self.ball = np.sqrt(np.maximum(ball**2 - outside**2, 0))
        self.weight = weight / weight.max(0)

    def solve(self, start: np.ndarray | None, tolerance: float, iterations: int) -> tuple[np.ndarray, np.ndarray, int]:
        """Solutions, gaps, and iterations."""
        s, w = self.singular, self.weight
        filtered = s / (1 + s**2)
        count = self.target.shape[1]
        done, gaps = np.zeros((len(w), count), complex), np.full(count, np.inf)
        active, target, ball = np.arange(count), self.target, self.ball
        z = np.zeros_like(done) if start is None else start * self.scale
        y = s * (self.right @ z)
        u, v = np.zeros_like(z), np.zeros_like(y)
        rho = 1 / np.maximum(np.abs(self.back @ (target / s)).max(0), 1e-300)
        if start is not None:
            # at a solution the multiplier is parallel to what is left of the data, as long as the weights allow
            multiplier = target - y
            slope = self.back @ (s * multiplier)
            length = np.maximum((np.abs(slope) / w).max(0) * rho, 1e-300)
            u, v = slope / length, -multiplier / length
        number = 0
        for number in range(1, iterations + 1):
            p, q = z - u, y - v
            inside = self.right @ p
            step = filtered * (q - s * inside)
            x = p + self.back @ step
            ax = s * (inside + step)
            z_before, y_before = z, y
            z = _shrunk(x + u, w / rho)
            y = _in_ball(ax + v, target, ball)
            u, v = u + x - z, v + ax - y
            if number % EVERY and number != iterations:
                continue
            feasible, gap = self._judged(z, -rho * v, target, ball, w)
            finished = gap <= tolerance if number < iterations else np.ones(len(active), bool)
            done[:, active[finished]], gaps[active[finished]] = feasible[:, finished], gap[finished]
            if finished.all():
                break
            # residuals of both constraints against their change: the larger one says which way the step length is off
            primal = np.hypot(np.linalg.norm(x - z, axis=0), np.linalg.norm(ax - y, axis=0))
            dual = np.hypot(np.linalg.norm(z - z_before, axis=0), np.linalg.norm(y - y_before, axis=0))
            change = np.clip(np.sqrt(primal / np.maximum(dual, 0.01 * primal + 1e-300)), 0.2, 5)
            settle = (number > iterations // 2) | ((change > 1 / 3) & (change < 3))
            change = np.where(settle, 1, change)
            rho, u, v = rho * change, u / change, v / change
            go = ~finished
            active, target, ball, rho = active[go], target[:, go], ball[go], rho[go]
            z, y, u, v, w = z[:, go], y[:, go], u[:, go], v[:, go], w[:, go]
        return done / self.scale, gaps, number

    def _judged(
        self, z: np.ndarray, dual: np.ndarray, target: np.ndarray, ball: np.ndarray, w: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The nearest x within the ball to each z, or z where its residual will do; and the gaps.

        For any dual variable with :math:`|A^H \\lambda|_j \\le w_j` the norm is at least
        :math:`\\mathrm{Re}\\,\\lambda^H b - \\delta \\|\\lambda\\|`.
        """
        s = self.singular
        left = s * (self.right @ z) - target
        size = np.linalg.norm(left, axis=0)
        excess = np.maximum(1 - ball / np.maximum(size, 1e-300), 0)
        feasible = z - self.back @ (left * excess / s)
        steepest = (np.abs(self.back @ (s * dual)) / w).max(0)
        dual = dual / np.maximum(steepest, 1)
        bound = (dual.conj() * target).sum(0).real - ball * np.linalg.norm(dual, axis=0)
        norm = (w * np.abs(feasible)).sum(0)
        gap = (norm - bound) / np.maximum(norm, 1e-300)
        return np.where(size <= (1 + SLACK / 2) * ball, z, feasible), gap


def _shrunk(values: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Moduli less ``by``, 0 where that is negative; phases as they are."""
    size = np.abs(values)
    return np.asarray(values * np.maximum(1 - by / np.maximum(size, 1e-300), 0))


def _in_ball(values: np.ndarray, centre: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """The nearest points within ``radius`` of the centres, column by column."""
    away = values - centre
    size = np.linalg.norm(away, axis=0)
    return np.asarray(centre + away * np.minimum(1, radius / np.maximum(size, 1e-300)))
