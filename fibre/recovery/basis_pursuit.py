"""Rows of A^-1 by basis pursuit denoising in a window: the published way, with its delta from the noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fibre.records import CalibrationFields
from fibre.recovery.base import RowByRow
from fibre.recovery.denoise import basis_pursuit_denoise
from fibre.recovery.ridge import Captures, ridge_rows
from polinfer.checks import integer, real_number

__all__ = ["BasisPursuit"]


@dataclass(frozen=True)
class BasisPursuit(RowByRow):
    r"""Rows of least l1 norm that explain the inputs within a residual.

    .. math:: \min_a \|a\|_1 \quad \text{subject to} \quad \| x - Y^T a \|_2 \le \delta

    for the inputs x (captures) of a point and the fields Y (fibrelets, captures) in the window around it, by
    :func:`fibre.basis_pursuit_denoise`. Neighbours share a window, and with it a factorisation.

    Parameters
    ----------
    delta: residual, in the unit of the inputs; None: from the noise, :math:`\delta^2 = \sum_k |a_k|^2 \sum_c
    \mathrm{var}(y_{ck}) + \|x - Y^T a\|^2` of the row a of :class:`fibre.Ridge` in the same window, so that its
    residual is attainable. window: metres, side of the square of fibrelets; None: the distance between spots that are
    lit together, as in the paper (68.2 um). together: points along each axis that share a window, >= 1. iterations:
    most, of the solver.

    Source: the paper (SPGL1 there); van den Berg and Friedlander (2008) for the problem.
    """

    delta: float | None = None
    window: float | None = None
    together: int = 3
    iterations: int = 2000

    def __post_init__(self) -> None:
        if self.delta is not None:
            real_number("delta", self.delta, low=0)
        if self.window is not None:
            real_number("window", self.window, above=0)
        integer("together", self.together, low=1)
        integer("iterations", self.iterations, low=1)

    def prepared(self, fields: CalibrationFields) -> Captures:
        """See :meth:`RowByRow.prepared`."""
        return Captures.of(fields)

    def usable(self, prepared: Captures) -> np.ndarray:
        """See :meth:`RowByRow.usable`."""
        return prepared.usable

    def ridge(self, prepared: Captures) -> float:  # noqa: ARG002
        """None."""
        return 0.0

    def groups(self, positions: np.ndarray) -> list[np.ndarray]:
        """Tiles of neighbouring points."""
        pitch = np.sqrt(np.prod(np.ptp(positions, axis=0)) / max(len(positions), 1)) if len(positions) > 1 else 1.0
        tile = np.floor((positions - positions.min(0)) / (self.together * max(pitch, 1e-12)) + 1e-6).astype(int)
        _, own = np.unique(tile, axis=0, return_inverse=True)
        return [np.flatnonzero(own == k) for k in range(own.max() + 1)]

    def rows(self, prepared: Captures, points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """See :meth:`RowByRow.rows`."""
        seen, targets = prepared.fields[:, chosen], prepared.targets(points)
        if self.delta is None:
            ridge = ridge_rows(prepared, points, chosen, 1.0)
            left = np.linalg.norm(targets - ridge @ seen.T, axis=1)
            delta = np.sqrt((np.abs(ridge) ** 2) @ prepared.noise[chosen] + left**2)
        else:
            delta = np.full(len(targets), self.delta)
        return basis_pursuit_denoise(seen, targets.T, delta, iterations=self.iterations).x.T
