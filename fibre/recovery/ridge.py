"""Rows of A^-1 straight from the calibration's captures, by ridge regression in a window."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg

from fibre.coupling import clean_fibrelets, lit_points
from fibre.records import CalibrationFields
from fibre.recovery.base import RowByRow
from polinfer.checks import real_number

__all__ = ["Captures", "Ridge", "ridge_rows"]


class Captures(NamedTuple):
    """fields: (captures, 2 m). noise: (2 m,), variances summed over the captures. inputs: (2 p, captures). usable:
    (2 m,), modes without the reference spot."""

    fields: np.ndarray
    noise: np.ndarray
    inputs: np.ndarray
    usable: np.ndarray

    @classmethod
    def of(cls, fields: CalibrationFields) -> Captures:
        """Of a calibration in which every point was lit in two states or more."""
        lit_points(fields)
        count = len(fields.fields)
        noise = fields.variance.sum(0).ravel()
        return cls(
            fields.fields.reshape(count, -1), noise, fields.inputs.toarray(), np.tile(clean_fibrelets(fields), 2)
        )

    def targets(self, points: np.ndarray) -> np.ndarray:
        """What lit the points in each capture, (2 g, captures)."""
        return self.inputs[np.concatenate([points, points + len(self.inputs) // 2])]


def ridge_rows(captures: Captures, points: np.ndarray, chosen: np.ndarray, strength: float) -> np.ndarray:
    """Rows (2 g, c) by the formula of :class:`Ridge`; in the space of captures, of which there are fewer."""
    seen = captures.fields[:, chosen]
    # a = x (Y^H L^-1 Y + 1)^-1 Y^H L^-1, Y the captures' fields as columns
    weighted = seen.conj() / np.maximum(strength * captures.noise[chosen], 1e-300)
    system = weighted @ seen.T + np.eye(len(seen))
    return np.asarray(scipy.linalg.solve(system.T, captures.targets(points).T, assume_a="pos").T @ weighted)


@dataclass(frozen=True)
class Ridge(RowByRow):
    r"""The inverse's rows by ridge regression of the inputs on the measured fields.

    .. math:: a = \arg\min \; \sum_c | x_c - a\, y_c |^2 + \sum_k |a_k|^2 \Lambda_k, \quad
              \Lambda_k = \sum_c \mathrm{var}(y_{ck})

    over captures c, in which the point was lit with x_c (mostly 0) and the fibrelets in the window around it were seen
    with y_c: what is expected of new fields of the same statistics, seen with the same noise. No columns of A are
    found, and nothing is assumed of them but that spots that are lit together do not share a window: always alike, they
    could not be told apart.

    Parameters
    ----------
    window: metres, side of the square of fibrelets that a row may use; None: the distance between spots that are lit
    together, at most 27 um. strength: >= 0 times the noise's own.

    Source: minimum mean squared error, Tikhonov regularisation in the paper's window.
    """

    window: float | None = None
    strength: float = 1.0

    def __post_init__(self) -> None:
        if self.window is not None:
            real_number("window", self.window, above=0)
        real_number("strength", self.strength, low=0)

    def width(self, fields: CalibrationFields) -> float:
        """See :meth:`RowByRow.width`."""
        return min(27e-6, super().width(fields)) if self.window is None else self.window

    def prepared(self, fields: CalibrationFields) -> Captures:
        """See :meth:`RowByRow.prepared`."""
        return Captures.of(fields)

    def usable(self, prepared: Captures) -> np.ndarray:
        """See :meth:`RowByRow.usable`."""
        return prepared.usable

    def ridge(self, prepared: Captures) -> float:
        """Mean over the modes, in units of their mean power."""
        power = (np.abs(prepared.fields) ** 2).sum(0)
        return float(self.strength * prepared.noise.mean() / power.mean())

    def rows(self, prepared: Captures, points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """See :meth:`RowByRow.rows`."""
        return ridge_rows(prepared, points, chosen, self.strength)
