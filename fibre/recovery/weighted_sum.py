"""Rows without any inversion: recorded fields are compared with those of each point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from fibre.calibration import columns
from fibre.records import CalibrationFields
from fibre.recovery.base import RowByRow
from polinfer.checks import real_number

__all__ = ["WeightedSum"]


@dataclass(frozen=True)
class WeightedSum(RowByRow):
    r"""The overlap of a recorded field with the fields of the point's two polarisations.

    .. math:: a = (C^H C)^{-1} C^H

    with the point's own columns C (fibrelets in the window, 2) of :math:`\hat A`: phase conjugation. It takes no notice
    of other points, whose light it mixes in where their fields overlap: robust, and right only where points are far
    apart against the coupling.

    Parameters
    ----------
    window: metres, side of the square of fibrelets that a row may use.
    """

    window: float = 27e-6

    def __post_init__(self) -> None:
        real_number("window", self.window, above=0)

    def prepared(self, fields: CalibrationFields) -> scipy.sparse.csr_array:
        """See :meth:`RowByRow.prepared`."""
        return columns(fields).values

    def usable(self, prepared: scipy.sparse.csr_array) -> np.ndarray:
        """Those with columns."""
        return np.diff(prepared.indptr) > 0

    def ridge(self, prepared: scipy.sparse.csr_array) -> float:  # noqa: ARG002
        """None."""
        return 0.0

    def rows(self, prepared: scipy.sparse.csr_array, points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """See :meth:`RowByRow.rows`."""
        own = prepared[chosen][:, np.concatenate([points, points + prepared.shape[1] // 2])].toarray()
        return np.asarray(np.linalg.solve(own.conj().T @ own, own.conj().T))
