"""Split parallel calibration captures into the response of each distal point.

In: :class:`fibre.CalibrationFields`. Out: for every point the columns of A near it, with variances. Called by the
recovery methods.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.spatial

from fibre.records import CalibrationFields

__all__ = ["Columns", "columns"]


@dataclass(frozen=True)
class Columns:
    """Columns of the transmission matrix A, point by point, as far as the spots light the fibrelets.

    values: sparse complex (2 m, 2 p), rows h of all fibrelets then v, columns h of all points then v. variance:
    sparse real, the same pattern, E|error|^2. positions: (p, 2) metres, the points on the camera.
    """

    values: scipy.sparse.csc_array
    variance: scipy.sparse.csc_array
    positions: np.ndarray


def columns(fields: CalibrationFields) -> Columns:
    r"""Least-squares columns of A from spots that were lit in parallel.

    Every fibrelet of a capture belongs to the lit point that is nearest to it (spots are spaced so that they do not
    meet), and the captures of one point in states U give :math:`A_j = Y_j U^+`. Fibrelets that carry the reference
    spot are left out: they hold no clean light.
    """
    count, cores = len(fields.points), len(fields.fibrelets.centres)
    affine = fields.registration
    positions = fields.points @ affine[:, :2].T + affine[:, 2]
    power = (np.abs(fields.reference) ** 2).sum(0)
    clean = power <= 0.03 * power.max()
    inputs = fields.inputs.tocsc()
    lit: dict[int, list[int]] = {}
    nearest: dict[int, np.ndarray] = {}
    for capture in range(inputs.shape[1]):
        rows = inputs.indices[inputs.indptr[capture] : inputs.indptr[capture + 1]]
        points = np.unique(rows % count)
        if len(points) == 0:
            continue
        _, owner = scipy.spatial.cKDTree(positions[points]).query(fields.fibrelets.centres)
        nearest[capture] = points[owner]
        for point in points:
            lit.setdefault(int(point), []).append(capture)
    missing = sorted(set(range(count)) - set(lit))
    if missing:
        raise ValueError(f"inputs must light every point, but never light {len(missing)} of them, first {missing[0]}.")
    entries: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
    for point, captures in lit.items():
        cell = np.flatnonzero((nearest[captures[0]] == point) & clean)
        states = inputs[[point, point + count], :][:, captures].toarray()
        if np.linalg.matrix_rank(states) < 2:
            raise ValueError(f"inputs must light point {point} in two polarisation states or more, got {states.shape[1]}.")
        pseudo = np.linalg.pinv(states)  # (n, 2)
        y = fields.fields[captures][:, :, cell]  # (n, 2, cell)
        a = np.einsum("npk,nq->pkq", y, pseudo)
        spread = np.einsum("npk,nq->pkq", fields.variance[captures][:, :, cell], np.abs(pseudo) ** 2)
        row = np.broadcast_to((np.arange(2)[:, None] * cores + cell)[..., None], a.shape)
        column = np.broadcast_to(np.arange(2) * count + point, a.shape)
        entries.append((row.ravel(), column.ravel(), a.ravel(), spread.ravel()))
    row, column, values, variance = (np.concatenate(part) for part in zip(*entries, strict=True))
    shape = (2 * cores, 2 * count)
    return Columns(
        scipy.sparse.csc_array((values, (row, column)), shape=shape),
        scipy.sparse.csc_array((variance, (row, column)), shape=shape),
        positions,
    )
