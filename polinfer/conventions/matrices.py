"""What the conversions of matrices share: their check, the sense of the vertical component, the sense of the waves."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..checks import complex_array

__all__ = ["conjugate", "flip", "jones_matrices"]

_MIRROR = np.array([[1, -1], [-1, 1]], np.int8)


def flip(matrices: np.ndarray, flip_vertical: bool) -> np.ndarray:
    """``diag(1, -1) J diag(1, -1)`` if asked for: matrices ``(*P, 2, 2)`` whose component 1 points the other way.

    >>> flip(np.ones((2, 2)), True).tolist()
    [[1.0, -1.0], [-1.0, 1.0]]
    """
    # adding 0 makes -0 to 0: the phase of -1 - 0i is -pi, and packages read a handedness from that sign
    return matrices * _MIRROR + 0 if flip_vertical else matrices + 0


def jones_matrices(name: str, matrices: Any, flip_vertical: bool) -> np.ndarray:
    """Complex ``(*P, 2, 2)``, checked under the name of the argument and flipped if asked for."""
    return flip(complex_array(name, matrices, trailing=(2, 2)), flip_vertical)


def conjugate(matrices: np.ndarray) -> np.ndarray:
    """Complex conjugates without negative zeros: between waves ``e^{i(kz - omega t)}`` and ``e^{i(omega t - kz)}``.

    >>> conjugate(np.array([1 + 2j, -1 + 0j])).tolist()
    [(1-2j), (-1+0j)]
    """
    return np.conj(matrices) + 0
