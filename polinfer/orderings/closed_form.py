"""The two elements of a Jones matrix in closed form, shared by both orderings (NumPy)."""

from __future__ import annotations

import numpy as np

__all__ = ["diattenuator_of", "retarder_of"]


def diattenuator_of(intensity: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Diattenuation (>= 0), its angle and the polariser ``(..., 2, 2)`` from ``J J^H`` or ``J^H J``.

    For a polariser ``A^2 / (tr A^2 / 2) = 1 + D [[cos 2t, -sin 2t], [-sin 2t, -cos 2t]]``. A zero matrix gives D = 0.
    """
    trace = np.real(intensity[..., 0, 0] + intensity[..., 1, 1])
    trace = np.where(trace > 0, trace, 1.0)
    cosine = np.real(intensity[..., 0, 0] - intensity[..., 1, 1]) / trace
    sine = -2 * np.real(intensity[..., 0, 1]) / trace
    value = np.minimum(np.hypot(cosine, sine), 1.0)
    angle = 0.5 * np.arctan2(sine, cosine)
    mean = 0.5 * (np.sqrt(1 + value) + np.sqrt(1 - value))
    half = 0.5 * value / mean
    matrix = np.empty(intensity.shape)
    matrix[..., 0, 0] = mean + half * np.cos(2 * angle)
    matrix[..., 1, 1] = mean - half * np.cos(2 * angle)
    matrix[..., 0, 1] = matrix[..., 1, 0] = -half * np.sin(2 * angle)
    return value, angle, matrix


def retarder_of(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Retardance in [0, pi], its angle in [0, pi/2] and circularity of the retarder nearest to ``e^{i a} matrix``.

    The complex quaternion of the matrix is turned by half the phase of its square, which makes its real part as long
    as it can be; that part is the unit quaternion
    ``(cos eta/2, sin eta/2 cos 2t, sin eta/2 sin 2t cos xi, sin eta/2 sin 2t sin xi)``.
    """
    a, b, c, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1]
    quaternion = 0.5 * np.stack([a + d, -1j * (a - d), 1j * (b + c), c - b])
    phase = 0.5 * np.angle(np.sum(quaternion**2, axis=0))
    real = np.real(np.exp(-1j * phase) * quaternion)
    real = np.where(real[0] < 0, -real, real)
    retardance = 2 * np.arctan2(np.sqrt(np.sum(real[1:] ** 2, axis=0)), real[0])
    angle = 0.5 * np.arctan2(np.hypot(real[2], real[3]), real[1])
    return retardance, angle, np.arctan2(real[3], real[2])
