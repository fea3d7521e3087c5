"""Columns of A by regression, then rows of A^-1 in a window, regularised by how well the columns are known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse

from fibre.calibration import columns, unmeasured
from fibre.records import CalibrationFields
from fibre.recovery.base import RowByRow
from polinfer.checks import real_number

__all__ = ["ForwardInverse"]


class _Known(NamedTuple):
    """The columns, rows first, and what is not known of each mode's row of A, summed over all inputs (2 m,): the noise
    of those at the points, and those between them."""

    values: scipy.sparse.csr_array
    noise: np.ndarray
    between: np.ndarray

    @property
    def ridge(self) -> np.ndarray:
        """Lambda, (2 m,)."""
        return self.noise + self.between


@dataclass(frozen=True)
class ForwardInverse(RowByRow):
    r"""The row that errs least on average, given what the calibration knows of A.

    The forward route: the columns :math:`\hat A` and their variances by windowed regression
    (:func:`fibre.calibration.columns`), then, for the fibrelets in a window around a point,

    .. math:: a = \arg\min \; \| e - a \hat A \|^2 + \sum_k |a_k|^2 \Lambda_k, \quad
              \Lambda_k = \sum_j \mathrm{var}(\hat A_{kj}) + \beta L_k

    which is the expectation of :math:`\|e - a A\|^2` over the true A given the measured fields, for light at the points
    and between them: L is what light where no spot was puts on a fibrelet (:func:`fibre.calibration.unmeasured`), and
    :math:`\beta` how bright it is there against the points. Without it a row may use fibrelets that the points hardly
    light, as long as the calibration's noise is small, and a real sample lights those too. So the regularisation is set
    by the noise and the lattice, not by hand; ``strength`` multiplies the first. At the minimum a row answers
    :math:`1 - \|e - a \hat A\|^2 - a \Lambda a^H` to its own point; what of that loss is due to L is made good by a
    factor on the row, which loses nothing against noise: amplitudes stay right.

    Parameters
    ----------
    window: metres, side of the square of fibrelets that a row may use. strength: >= 0, 1 is the noise's own. between:
    beta, >= 0, in units of an even light of the whole facet that had nothing in common with that at the points; a real
    one has much in common with it, and is smooth. 0: light at the points alone.

    Source: errors-in-variables ridge regression; the paper's window is the spacing of parallel spots, 68.2 um.
    """

    window: float = 27e-6
    strength: float = 1.0
    between: float = 0.1

    def __post_init__(self) -> None:
        real_number("window", self.window, above=0)
        real_number("strength", self.strength, low=0)
        real_number("between", self.between, low=0)

    def prepared(self, fields: CalibrationFields) -> _Known:
        """See :meth:`RowByRow.prepared`."""
        known = columns(fields)
        noise = np.asarray(known.variance.sum(axis=1)).ravel()
        return _Known(known.values, self.strength * noise, self.between * np.tile(unmeasured(fields), 2))

    def usable(self, prepared: _Known) -> np.ndarray:
        """Those with columns."""
        return np.diff(prepared.values.indptr) > 0

    def ridge(self, prepared: _Known) -> float:
        """Mean over the modes, in units of their mean power."""
        observed = np.diff(prepared.values.indptr) > 0
        scale = float((abs(prepared.values).power(2)).sum() / observed.sum())
        return float(prepared.ridge[observed].mean() / scale)

    def rows(self, prepared: _Known, points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """See :meth:`RowByRow.rows`."""
        block = prepared.values[chosen]
        gram = (block @ block.conj().T).toarray() + np.diag(prepared.ridge[chosen])
        count = prepared.values.shape[1] // 2
        target = block[:, np.concatenate([points, points + count])].toarray()  # a = e A^H (A A^H + L)^-1
        rows = np.asarray(scipy.linalg.solve(gram, target, assume_a="pos")).conj().T
        # how far each row falls short of answering 1 to its own point, and which share of that is the noise's
        own = np.einsum("rk,kr->r", rows, target).real
        noise, between = (np.abs(rows) ** 2 @ part[chosen] for part in (prepared.noise, prepared.between))
        total = noise + between
        share = np.where(total > 0, noise / np.where(total > 0, total, 1), 1)
        return np.asarray(rows * ((1 - (1 - own) * share) / np.where(own > 0, own, 1))[:, None])
