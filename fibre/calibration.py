"""The columns of the transmission matrix from calibration captures in which many points were lit at once.

In: :class:`fibre.CalibrationFields`. Out: for every distal point the columns of A near it, with variances. Called by
the recovery methods.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.spatial
from scipy.linalg.blas import zherk
from scipy.linalg.lapack import zpotrf, ztrtri
from threadpoolctl import threadpool_limits

from fibre.coupling import (
    clean_fibrelets,
    coupling_profile,
    fibrelets_a_point,
    lit_points,
    made,
    once,
    positions_on_camera,
)
from fibre.records import CalibrationFields

__all__ = [
    "Columns",
    "columns",
    "response_covariance",
    "unmeasured",
    "usual_response",
]

FAINT = 1e-5  # of the coupling's peak: fainter responses are left out


@dataclass(frozen=True)
class Columns:
    """Columns of the transmission matrix A, point by point, as far as the spots light the fibrelets.

    values: sparse complex (2 m, 2 p), rows h of all fibrelets then v, columns h of all points then v. variance:
    sparse real, the same pattern, E|error|^2. positions: (p, 2) metres, the points on the camera.
    """

    values: scipy.sparse.csr_array
    variance: scipy.sparse.csr_array
    positions: np.ndarray


@dataclass(frozen=True)
class _Regressions:
    r"""The regression of some fibrelets on the inputs near them, padded to a common number q of points.

    cores: (k,). chosen: (k, 2 q), indices of the inputs (h of the points, then v). root: (k, 2 q), the root of T, 0
    where padded. scaled: (k, 2 q, captures), T^1/2 X. weight: 1/var, (2, k, captures) for either polarisation of the
    output.
    """

    cores: np.ndarray
    chosen: np.ndarray
    root: np.ndarray
    scaled: np.ndarray
    weight: np.ndarray

    def roots(self, polarisation: int) -> np.ndarray:
        r"""W with :math:`W^H W = (1 + T^{1/2} X \, \mathrm{diag}(1/\mathrm{var}) X^H T^{1/2})^{-1}`, (k, 2 q, 2 q)."""
        size = self.root.shape[1]
        found = np.empty((len(self.cores), size, size), complex)
        white = self.scaled * np.sqrt(self.weight[polarisation])[:, None]
        # threads that wait for each other take twice as long for matrices as small as these
        with threadpool_limits(1, user_api="blas"):
            for rows, root in zip(white, found, strict=True):
                # triangles only, a quarter of the work of an inverse; Fortran's order turns a matrix into its conjugate
                system = zherk(1.0, rows.T, trans=2)
                system.ravel(order="K")[:: size + 1] += 1
                factor, failed = zpotrf(system, lower=0, overwrite_a=1)
                inverse, singular = ztrtri(factor, lower=0, overwrite_c=1)
                if failed or singular:
                    raise np.linalg.LinAlgError("fields and variances of the calibration make no finite system.")
                root[:] = inverse.T
        return found


def _regressions(fields: CalibrationFields, fraction: float, chunk: int) -> Iterator[_Regressions]:
    count = len(fields.points)
    positions, clean = positions_on_camera(fields), clean_fibrelets(fields)
    lit_points(fields)
    profile = coupling_profile(fields)
    near = scipy.spatial.cKDTree(positions).query_ball_point(fields.fibrelets.centres, profile.reach(fraction))
    inputs = np.vstack([fields.inputs.toarray(), np.zeros(fields.inputs.shape[1])])  # last row: no point at all
    usable = [core for core in np.flatnonzero(clean) if near[core]]
    if not usable:
        raise ValueError("calibration_fields have no fibrelet within reach of a point; check the registration.")
    for start in range(0, len(usable), chunk):
        cores = np.array(usable[start : start + chunk])
        points = np.full((len(cores), max(len(near[core]) for core in cores)), -1)
        for i, core in enumerate(cores):
            points[i, : len(near[core])] = near[core]
        away = np.hypot(*np.moveaxis(positions[points] - fields.fibrelets.centres[cores][:, None], -1, 0))
        root = np.sqrt(np.tile(np.where(points >= 0, profile(away), 0), 2))
        chosen = np.where(root > 0, np.concatenate([points, points + count], axis=1), 2 * count)
        scaled = root[..., None] * inputs[chosen]
        weight = 1 / fields.variance[:, :, cores].transpose(1, 2, 0)
        yield _Regressions(cores, chosen, root, scaled, weight)


def unmeasured(fields: CalibrationFields) -> np.ndarray:
    r"""Power on each fibrelet, (m,), of light that enters where no spot was, in proportion to an even light's.

    The facet has more fibrelets than points where the points are far apart: with n fibrelets to a point, light has n
    dimensions there and the calibration has seen one. What comes of the others is known on average,

    .. math:: \frac{1 - 1/n}{n^2} \sum_l \tau^2(|r_k - r_l|)

    over all fibrelets l, with the :func:`coupling_profile`: an even light is the sum of spots at all points, and
    its amplitude on a fibrelet falls as the points' density, 1/n. 0 where points are as dense as fibrelets.
    """
    centres, count = fields.fibrelets.centres, fibrelets_a_point(fields)
    if count == 1:
        return np.zeros(len(centres))
    tree, profile = scipy.spatial.cKDTree(centres), coupling_profile(fields)
    share = (1 - 1 / count) / count**2
    pairs = tree.sparse_distance_matrix(tree, profile.reach(FAINT), output_type="coo_matrix")
    return share * np.bincount(pairs.row, profile(pairs.data), len(centres))


def columns(fields: CalibrationFields, fraction: float = FAINT, chunk: int = 128) -> Columns:
    r"""Columns of A by linear regression with a local prior, one fibrelet at a time.

    A fibrelet's amplitude in capture c is :math:`y_c = \sum_j A_j x_{jc} + n_c` over all points j lit within reach.
    With the prior :math:`A_j \sim CN(0, \tau^2(d_j))` of the measured :func:`coupling_profile`, T = diag tau^2 and
    N = diag var,

    .. math:: \hat A = y N^{-1} X^H \Sigma, \quad \Sigma = (T^{-1} + X N^{-1} X^H)^{-1}
              = T^{1/2} (1 + T^{1/2} X N^{-1} X^H T^{1/2})^{-1} T^{1/2}

    so spots that were lit together are told apart as well as the translations allow, and what stays ambiguous between
    them is in the covariance. Points beyond the distance at which the profile has fallen to ``fraction`` of its peak
    are left out. Fibrelets that carry the reference spot get no columns. ``chunk`` fibrelets are worked on at a time.
    Made once for a calibration.
    """
    return once(fields, f"columns, {fraction!r}", lambda: _columns(fields, fraction, chunk))


def _columns(fields: CalibrationFields, fraction: float, chunk: int) -> Columns:
    count, cores = len(fields.points), len(fields.fibrelets.centres)
    inputs = np.vstack([fields.inputs.toarray().conj(), np.zeros(fields.inputs.shape[1])])
    seen, noise = (x.reshape(-1, 2 * cores).T for x in (fields.fields, fields.variance))
    rows, cols, values, variances = [], [], [], []
    for own, chosen, roots in _covariance_roots(fields, fraction, chunk):
        real = chosen < 2 * count
        right = np.einsum("kjc,kc->kj", inputs[chosen], seen[own] / noise[own])
        found = np.einsum("kl,kli->ki", np.einsum("kj,klj->kl", right, roots.conj()), roots)
        rows.append(np.broadcast_to(own[:, None], real.shape)[real])
        cols.append(chosen[real])
        values.append(found[real])
        variances.append((roots.real**2 + roots.imag**2).sum(1)[real])
    place = (np.concatenate(rows), np.concatenate(cols))
    shape = (2 * cores, 2 * count)
    return Columns(
        scipy.sparse.csr_array((np.concatenate(values), place), shape=shape),
        scipy.sparse.csr_array((np.concatenate(variances), place), shape=shape),
        positions_on_camera(fields),
    )


def response_covariance(
    fields: CalibrationFields, inputs: np.ndarray, fraction: float = FAINT, chunk: int = 128
) -> np.ndarray:
    r"""How uncertain the calibration leaves each fibrelet's response to given distal fields.

    For fields Z (2 p, s) and the error :math:`\delta A` of a row of A, :math:`E[(\delta A Z)^H \delta A Z] = Z^H \Sigma
    Z` with the covariance of :func:`columns`: complex (2 m, s, s), rows h of all fibrelets then v, 0 where there are
    no columns. Errors of different rows are independent. What does not depend on Z is made once for a calibration.
    """
    inputs = np.vstack([inputs, np.zeros(inputs.shape[1])])
    cores = len(fields.fibrelets.centres)
    covariance = np.zeros((2 * cores, inputs.shape[1], inputs.shape[1]), complex)
    kept = once(fields, _roots_name(fraction), lambda: list(_covariance_roots(fields, fraction, chunk)))
    for rows, chosen, roots in kept:
        whitened = roots @ inputs[chosen]
        covariance[rows] = whitened.conj().swapaxes(-1, -2) @ whitened
    return covariance


def _roots_name(fraction: float) -> str:
    return f"roots of the covariance, {fraction!r}"


def _covariance_roots(
    fields: CalibrationFields, fraction: float, chunk: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    r"""Rows of A (k,), the inputs that reach them (k, 2 q), and roots of their covariance: :math:`\Sigma = W^H W`.

    They are large, so that only :func:`response_covariance`, which asks for them again and again, keeps them; once they
    are there they serve :func:`columns` too.
    """
    cores = len(fields.fibrelets.centres)
    if (kept := made(fields, _roots_name(fraction))) is not None:
        yield from kept
        return
    for part in _regressions(fields, fraction, chunk):
        for polarisation in range(2):
            yield polarisation * cores + part.cores, part.chosen, part.roots(polarisation) * part.root[:, None]


def usual_response(
    fields: CalibrationFields, inputs: np.ndarray, fraction: float = FAINT, chunk: int = 128
) -> np.ndarray:
    r"""Covariance of responses to given distal fields before looking closer: :math:`Z^H T Z`.

    T are the variances of the :func:`coupling_profile`. Complex (2 m, s, s), as :func:`response_covariance`.
    """
    inputs = np.vstack([inputs, np.zeros(inputs.shape[1])])
    cores = len(fields.fibrelets.centres)
    covariance = np.zeros((2 * cores, inputs.shape[1], inputs.shape[1]), complex)
    for part in _regressions(fields, fraction, chunk):
        z = part.root[..., None] * inputs[part.chosen]
        covariance[part.cores] = covariance[cores + part.cores] = z.conj().swapaxes(-1, -2) @ z
    return covariance
