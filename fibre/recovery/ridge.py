"""Rows of A^-1 by ridge regression in a window, regularised by the calibration's own noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.spatial
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from fibre.calibration import columns
from fibre.records import CalibrationFields, Inverse
from fibre.recovery.base import RecoveryMethod
from polinfer.checks import real_number

__all__ = ["Ridge"]


@dataclass(frozen=True)
class Ridge(RecoveryMethod):
    r"""The row that errs least on average, given what the calibration knows.

    For the fibrelets in a window around a point, with the columns :math:`\hat A` and their variances,

    .. math:: a = \arg\min \; \| e - a \hat A \|^2 + \sum_k |a_k|^2 \Lambda_k, \quad
              \Lambda_k = \sum_j \mathrm{var}(\hat A_{kj})

    which is the expectation of :math:`\|e - a A\|^2` over the true A given the measured fields. So the
    regularisation is set by the noise and not by hand; ``strength`` multiplies it.

    Parameters
    ----------
    window: metres, side of the square of fibrelets that a row may use. strength: >= 0, 1 is the noise's own.

    Source: errors-in-variables ridge regression; the paper's window is the spacing of parallel spots, 68.2 um.
    """

    window: float = 27e-6
    strength: float = 1.0

    def __post_init__(self) -> None:
        real_number("window", self.window, above=0)
        real_number("strength", self.strength, low=0)

    def solve(self, fields: CalibrationFields, progress: bool) -> Inverse:
        """See :meth:`RecoveryMethod.solve`."""
        known = columns(fields)
        count, cores = len(fields.points), len(fields.fibrelets.centres)
        values, variance = known.values, known.variance
        # noise summed over all inputs, for both polarisations of the input
        ridge = self.strength * np.asarray(variance.sum(axis=1)).ravel()
        observed = np.diff(values.indptr) > 0
        tree = scipy.spatial.cKDTree(fields.fibrelets.centres)
        near = tree.query_ball_point(known.positions, self.window / 2, p=np.inf)
        rows, cols, data = [], [], []
        for point in tqdm(range(count), desc="rows of A^-1", unit="point", disable=not progress):
            chosen = np.asarray(sorted(near[point]), int)
            chosen = np.concatenate([chosen, chosen + cores])
            chosen = chosen[observed[chosen]]
            if len(chosen) == 0:
                raise ValueError(f"window {self.window:g} m holds no usable fibrelet at point {point}; widen it.")
            block = values[chosen]
            gram = (block @ block.conj().T).toarray() + np.diag(ridge[chosen])
            target = block[:, [point, point + count]].toarray()  # a = e A^H (A A^H + L)^-1
            # a hundred unknowns: threads would cost more than they bring, and fight with other programs
            with threadpool_limits(1, user_api="blas"):
                row = scipy.linalg.solve(gram, target, assume_a="pos").conj().T
            rows.append(np.repeat([point, point + count], len(chosen)))
            cols.append(np.tile(chosen, 2))
            data.append(row.ravel())
        place = (np.concatenate(rows), np.concatenate(cols))
        matrix = scipy.sparse.csr_array((np.concatenate(data), place), shape=(2 * count, 2 * cores))
        scale = float((abs(values).power(2)).sum() / observed.sum())
        return Inverse(matrix, float(ridge[observed].mean() / scale), fields)
