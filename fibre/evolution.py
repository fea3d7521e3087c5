r"""Light along coupled cores: the exponential of a sparse Hermitian matrix, applied and never formed.

In: the coupling matrix K and amplitudes. Out: :math:`e^{\pm i K} c`. Called by :class:`fibre.Bundle` and
:class:`fibre.Transmission`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.special

__all__ = ["Evolution"]

TAIL = 1e-12  # Chebyshev coefficients below this are left out


@dataclass(frozen=True)
class Evolution:
    r"""The unitary :math:`e^{iK}` by its Chebyshev series.

    With the spectrum of K within :math:`a \pm b` (Gershgorin) and :math:`X = (K - a)/b`,

    .. math:: e^{iK} = e^{ia} \sum_n (2 - \delta_{n0})\, i^n J_n(b)\, T_n(X)

    whose terms fall faster than exponentially beyond n = b. One product with the sparse X each: nothing of the size of
    e^{iK} is stored, and the error is that of rounding.

    scaled: X, sparse (k, k). centre, half: a and b. Source: Tal-Ezer and Kosloff, J. Chem. Phys. 81, 3967 (1984).
    """

    scaled: scipy.sparse.csr_array
    centre: float
    half: float

    @classmethod
    def of(cls, matrix: Any) -> Evolution:
        """Of a Hermitian sparse ``matrix``."""
        matrix = scipy.sparse.csr_array(matrix)
        diagonal = matrix.diagonal().real
        around = np.asarray(abs(matrix).sum(axis=1)).ravel() - np.abs(diagonal)
        low, high = float((diagonal - around).min()), float((diagonal + around).max())
        # a scalar matrix has no width; any half-width will do
        centre, half = (high + low) / 2, max((high - low) / 2, 1e-3)
        shifted = (matrix - centre * scipy.sparse.eye_array(matrix.shape[0])) / half
        return cls(scipy.sparse.csr_array(shifted), centre, half)

    def coefficients(self, sign: int) -> np.ndarray:
        """Of T_0, T_1, ..., complex, for the direction ``sign`` of light (1: there, -1: back)."""
        order = np.arange(int(self.half + 12 * self.half ** (1 / 3) + 20))
        bessel = scipy.special.jv(order, self.half)
        kept = order[: np.flatnonzero(np.abs(bessel) > TAIL)[-1] + 1]
        values = np.where(kept == 0, 1, 2) * (1j * sign) ** kept * bessel[kept]
        return np.exp(1j * sign * self.centre) * values

    def apply(self, amplitudes: np.ndarray, sign: int = 1) -> np.ndarray:
        """exp(i sign K) times the columns of ``amplitudes``, complex128 (k, columns)."""
        first, second, *rest = self.coefficients(sign)
        before = amplitudes.astype(complex)
        now = self.scaled @ before
        total, twice = first * before + second * now, 2 * self.scaled
        for coefficient in rest:
            following = twice @ now
            following -= before
            before, now = now, following
            total += coefficient * now
        return total

    def apply_jax(self, amplitudes: jax.Array, sign: int = 1, rows: tuple[Any, Any] | None = None) -> jax.Array:
        """The same as :meth:`apply` in JAX, in the precision of ``amplitudes``; differentiable. ``rows``: :attr:`rows`
        as arguments of a compiled function, rather than constants in it."""
        indices, values = self.rows if rows is None else rows
        weights = jnp.asarray(values).astype(amplitudes.dtype)[..., None]

        def product(column: jax.Array) -> jax.Array:
            return (weights * column[indices]).sum(1)

        first, second, *rest = jnp.asarray(self.coefficients(sign), amplitudes.dtype)
        now = product(amplitudes)

        def term(carry: tuple[jax.Array, jax.Array, Any], coefficient: jax.Array) -> tuple[Any, None]:
            before, now, total = carry
            before, now = now, 2 * product(now) - before
            return (before, now, total + coefficient * now), None

        (_, _, total), _ = jax.lax.scan(term, (amplitudes, now, first * amplitudes + second * now), jnp.stack(rest))
        return total

    @property
    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Places and values of X row by row, padded with zeros to the longest row: (k, most)."""
        counts = np.diff(self.scaled.indptr)
        column = np.arange(counts.max())
        used = column < counts[:, None]
        indices, values = np.zeros(used.shape, np.int32), np.zeros(used.shape, self.scaled.dtype)
        indices[used], values[used] = self.scaled.indices, self.scaled.data
        return indices, values
