"""From recorded fields to Jones data: the verb ``reconstruct``.

In: an :class:`fibre.Inverse` and :class:`fibre.RecordingFields`. Out: a :class:`polinfer.Measurement` on the grid of
distal points, with a noise estimate a pixel. Called by users and by the ``reconstruct`` command.
"""

from __future__ import annotations

import numpy as np

from fibre.records import Inverse, RecordingFields
from polinfer import Measurement
from polinfer.checks import one_of_types

__all__ = ["reconstruct"]


def reconstruct(inverse: Inverse, recording_fields: RecordingFields) -> Measurement:
    r"""Fields at the distal facet, V with the sample and U without, as a measurement of Jones matrices.

    :math:`\hat V = A^{-1} y`, :math:`\hat U = A^{-1} y_{blank}` at every point and state; the illumination is the
    measured :math:`\hat U`, so that what the inverse gets wrong in amplitude and phase cancels. One sigma a pixel
    (per complex component of V) collects, with J estimated by :math:`\hat V \hat U^+` for this purpose only,

    .. math:: \sigma^2 = \overline{\mathrm{var} V} + \tfrac12 \|J\|^2 \, \overline{\mathrm{var} U}
              + \tfrac n2 \, (\|J\|^2 - \tfrac12 |\mathrm{tr} J|^2) \sum_{j} X_{j} |u_{j}|^2

    The first two are the noise of the recordings, averaged over the polarisations and the n states: the H and V
    variances differ, and one sigma cannot say so. The third is the noise X of the calibration itself. It multiplies V
    and U alike, so what commutes with J cancels (for E with independent entries of variance v,
    :math:`E\|EJ - JE\|^2 = v (4\|J\|^2 - 2|\mathrm{tr} J|^2)`); it is the same for all states, so it does not average
    down over them, hence n/2. J is taken to be smooth over the range of crosstalk.

    Raises
    ------
    TypeError: other records. ValueError: the recording's fibrelets are not the inverse's.
    """
    one_of_types("inverse", inverse, (Inverse,), "make it with recover().")
    one_of_types("recording_fields", recording_fields, (RecordingFields,), "make them with retrieve_fields(recording).")
    if not np.array_equal(inverse.fibrelets.centres, recording_fields.fibrelets.centres):
        raise ValueError(
            "recording_fields must be in the fibrelets of the inverse; pass fibrelets=calibration_fields.fibrelets to "
            "retrieve_fields."
        )
    response, response_variance = _image(inverse, recording_fields.fields, recording_fields.variance)
    illumination, illumination_variance = _image(inverse, recording_fields.blank, recording_fields.blank_variance)
    jones = response @ np.linalg.pinv(illumination)
    power = (np.abs(jones) ** 2).sum((-2, -1))
    trace = np.abs(np.trace(jones, axis1=-2, axis2=-1)) ** 2
    count, states = len(inverse.points), response.shape[-1]
    light = (np.abs(illumination) ** 2).sum(1).mean(-1)
    leak = inverse.crosstalk_variance @ light
    crosstalk = (leak[:count] + leak[count:]) / 2
    variance = (
        response_variance.mean((1, 2))
        + power / 2 * illumination_variance.mean((1, 2))
        + states / 2 * np.maximum(power - trace / 2, 0) * crosstalk
    )
    rows, columns = inverse.grid
    return Measurement(
        illumination.reshape(rows, columns, 2, states),
        response.reshape(rows, columns, 2, states),
        np.sqrt(variance).reshape(rows, columns),
    )


def _image(inverse: Inverse, fields: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fields (p, 2, n) at the points and their variances, from mode amplitudes (n, 2, m)."""
    states, count = len(fields), len(inverse.points)
    values = inverse.matrix @ fields.reshape(states, -1).T
    spread = abs(inverse.matrix).power(2) @ variance.reshape(states, -1).T
    return values.reshape(2, count, states).swapaxes(0, 1), spread.reshape(2, count, states).swapaxes(0, 1)
