"""Elliptical retarders as vectors, for media in which several effects act at the same depth."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["retarder_of"]


def retarder_of(straight: Any, diagonal: Any, circular: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Retardance, its angle and circularity of ``exp(i/2 (straight Z - diagonal X - circular Y))``, radians.

    X, Y, Z are the Pauli matrices. A linear retarder has ``(eta cos 2 theta, eta sin 2 theta, 0)``; a rotation by
    alpha, which turns an axis at t into one at t + alpha, has ``(0, 0, -2 alpha)``. Along the same path they add up.
    With length w, ``eta = w``, ``2 theta = arg(straight + i |diagonal + i circular|)``,
    ``xi = arg(diagonal + i circular)``; eta may exceed pi.

    >>> eta, theta, xi = retarder_of(0.0, 0.0, -0.2)
    >>> bool(np.allclose([eta, theta, xi], [0.2, np.pi / 4, -np.pi / 2]))
    True
    """
    straight, diagonal, circular = np.broadcast_arrays(
        *(np.asarray(x, np.float64) for x in (straight, diagonal, circular))
    )
    across = np.hypot(diagonal, circular)
    return np.hypot(straight, across), 0.5 * np.arctan2(across, straight), np.arctan2(circular, diagonal)
