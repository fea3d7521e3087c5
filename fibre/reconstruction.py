"""From recorded fields to Jones data: the verb ``reconstruct``.

In: an :class:`fibre.Inverse` and :class:`fibre.RecordingFields`. Out: a :class:`polinfer.Measurement` on the grid of
distal points, with a noise estimate a pixel. Called by users and by the ``reconstruct`` command.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse

from fibre.calibration import columns, response_covariance
from fibre.coupling import fibrelets_a_point
from fibre.records import Inverse, RecordingFields
from polinfer import Measurement
from polinfer.checks import one_of_types

__all__ = ["reconstruct"]

# of what a point sees of the sample around it, in pitches squared: a triangle from one point to the next
SECOND_MOMENT = 1 / 6


def reconstruct(inverse: Inverse, recording_fields: RecordingFields) -> Measurement:
    r"""Fields at the distal facet, V with the sample and U without, as a measurement of Jones matrices.

    :math:`\hat V = A^{-1} y`, :math:`\hat U = A^{-1} y_{blank}` at every point and state; the illumination is the
    measured :math:`\hat U`, so that what the inverse gets wrong in amplitude and phase cancels.

    One sigma a pixel (per complex component of V) collects three errors. With :math:`J = \hat V \hat U^+` (for this
    purpose only), the rows a of A^-1 of a point and :math:`b = J a`, the error of state s in polarisation p is

    .. math:: e_{ps} = \sum_k a_{pk} (n_{ks} - \delta A_k V_s) - b_{pk} (m_{ks} - \delta A_k U_s)

    n and m being the noise of the recording with and without the sample, and :math:`\delta A_k` the error of the
    calibration, which enters both, for all states, and over the neighbourhood; its covariance is
    :func:`fibre.calibration.response_covariance`. Those errors are correlated over the states, so what counts is what
    they do to J, :math:`\sigma^2 = \tfrac14 \sum_p \sum_{st} E[e_{ps} e_{pt}^*] (U^+ U)_{st}`: the sigma of
    independent errors with the same :math:`E\,\mathrm{tr}[\delta J U U^H \delta J^H]`, the error as the likelihood
    weighs it. H and V differ in noise, and so do the states; one sigma does not say so. To this is added, in the same
    way, what is mixed in from places that differ. Of other points, by the regularisation: seen by sending the estimates
    through :math:`A^{-1} \hat A` once more. And of the sample between the points, where there are n > 1 fibrelets to a
    point: what a point sees of its surroundings falls to nothing at the next one, a triangle, whose second moment is a
    sixth of the pitch squared, so

    .. math:: \delta J = \left(1 - \frac1n\right) \frac{1}{12} \left( \Delta_y^2 J + \Delta_x^2 J \right)

    with the second differences over the grid, less what the noise of J puts into their squares.

    Raises
    ------
    TypeError: other records. ValueError: the recording's fibrelets are not the inverse's.
    """
    one_of_types("inverse", inverse, (Inverse,), "make it with recover().")
    one_of_types("recording_fields", recording_fields, (RecordingFields,), "make them with retrieve_fields(recording).")
    calibration = inverse.calibration
    if not np.array_equal(calibration.fibrelets.centres, recording_fields.fibrelets.centres):
        raise ValueError(
            "recording_fields must be in the fibrelets of the inverse; pass fibrelets=calibration_fields.fibrelets to "
            "retrieve_fields."
        )
    states = recording_fields.fields.shape[0]
    response, illumination = (_image(inverse, fields) for fields in (recording_fields.fields, recording_fields.blank))
    variance = _variance(inverse, recording_fields, response, illumination)
    rows, columns = calibration.grid
    return Measurement(
        illumination.reshape(rows, columns, 2, states),
        response.reshape(rows, columns, 2, states),
        np.sqrt(variance).reshape(rows, columns),
    )


def _image(inverse: Inverse, fields: np.ndarray) -> np.ndarray:
    """Fields (p, 2, n) at the points from mode amplitudes (n, 2, m)."""
    states, count = len(fields), len(inverse.calibration.points)
    values = inverse.matrix @ fields.reshape(states, -1).T
    return values.reshape(2, count, states).swapaxes(0, 1)


def _variance(inverse: Inverse, fields: RecordingFields, response: np.ndarray, illumination: np.ndarray) -> np.ndarray:
    """sigma^2 of every point, (p,), by the formula of :func:`reconstruct`."""
    count, _, states = response.shape
    pseudo = np.linalg.pinv(illumination)
    jones, projector = response @ pseudo, pseudo @ illumination  # (p, 2, 2), (p, n, n)
    distal = np.concatenate([x.swapaxes(0, 1).reshape(2 * count, states) for x in (response, illumination)], axis=1)
    shared = response_covariance(inverse.calibration, distal)  # (2 m, 2 n, 2 n)
    own = np.concatenate([x.reshape(states, -1).T for x in (fields.variance, fields.blank_variance)], axis=1)
    covariance = shared + own[:, :, None] * np.eye(2 * states)
    # V with V, U with U, and V with U, which stands for U with V too: one is the other's conjugate transpose
    cut = slice(states), slice(states, 2 * states)
    vv, uu, vu = (covariance[:, cut[i], cut[j]].reshape(len(covariance), -1) for i, j in ((0, 0), (1, 1), (0, 1)))
    parts = inverse.matrix[:count], inverse.matrix[count:]
    total = np.zeros(count)
    for p in range(2):
        a = parts[p]
        b = sum(scipy.sparse.diags_array(jones[:, p, q]) @ parts[q] for q in range(2))
        for left, right, block, share in ((a, a, vv, 1), (b, b, uu, 1), (a, b, vu, -2)):
            errors = left.conj().multiply(right).tocsr() @ block
            # e P e^H = sum of P_ts E[e_s^* e_t]
            total += share * np.einsum("ist,its->i", errors.reshape(count, states, states), projector).real
    # what the regularisation mixes in from neighbours that differ, seen by sending the estimates through it once more
    known = columns(inverse.calibration).values
    again = (inverse.matrix @ (known @ distal)).reshape(2, count, 2 * states).swapaxes(0, 1)
    blur = again[..., :states] - jones @ again[..., states:]
    total += np.einsum("ips,ist,ipt->i", blur, projector, blur.conj()).real
    total = np.maximum(total, 0)
    between = (1 - 1 / fibrelets_a_point(inverse.calibration)) * SECOND_MOMENT / 2
    return (total + between**2 * _curvature(jones, illumination, total, inverse.calibration.grid)) / 4


def _curvature(jones: np.ndarray, illumination: np.ndarray, noise: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """Squared second differences of J (p, 2, 2) over the grid, sum over both axes, as the light weighs them, (p,);
    less their expectation where the ``noise`` of J, weighed alike, is all there is. Edges have their neighbour's."""
    light = np.maximum((np.abs(illumination) ** 2).sum((1, 2)), 1e-300)
    field, relative = jones.reshape(*grid, 2, 2), (noise / light).reshape(grid)
    bend, expected = np.zeros_like(field), np.zeros(grid)
    for axis in range(2):
        if grid[axis] < 3:
            continue
        inside = np.clip(np.arange(grid[axis]), 1, grid[axis] - 2)
        for away, weight in ((-1, 1), (0, -2), (1, 1)):
            bend += weight * field.take(inside + away, axis)
            expected += weight**2 * relative.take(inside + away, axis)
    change = bend.reshape(-1, 2, 2) @ illumination
    return np.maximum((np.abs(change) ** 2).sum((1, 2)) - expected.ravel() * light, 0)
