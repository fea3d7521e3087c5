"""chromatix: the same waves, fields in the order (z, y, x), fast axes along (cos theta, sin theta)."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np

from ..checks import complex_array
from ..degeneracy import canonicalise
from ..records import Parameters
from .axes import half_turn, real_arrays, reduced
from .matrices import flip, jones_matrices

__all__ = ["from_chromatix", "from_chromatix_retarder", "to_chromatix", "to_chromatix_retarder"]


def to_chromatix(jones: Any, *, flip_vertical: bool = False) -> np.ndarray:
    """Matrices that act on the vector fields (z, y, x) of chromatix, the same waves ``e^{i(kz - omega t)}``.

    ``[[0, 0, 0], [0, J11, J10], [0, J01, J00]]``, the matrix that ``chromatix.functional.polarizer`` builds. That
    function takes one matrix, ``polarizer(field, J00, J01, J10, J11)`` with our elements as they are; it divides them
    by their Frobenius norm, sqrt 2 for ours, and before June 2024 it applied the transpose. For a map, multiply
    ``field.u`` (..., y, x, 3) by the result yourself.

    Parameters
    ----------
    jones: complex ``(*P, 2, 2)``, any unit.
    flip_vertical: whether component 1 points up there and down here: J01 and J10 change sign.

    Returns
    -------
    complex ``(*P, 3, 3)``, precision of the input.

    Raises
    ------
    ValueError, TypeError: ``jones`` is no array of 2 x 2 matrices.

    Source: chromatix, ``chromatix.functional.polarizers``.

    >>> to_chromatix([[1, 2], [3, 4]]).real.astype(int).tolist()
    [[0, 0, 0], [0, 4, 3], [0, 2, 1]]
    """
    matrices = jones_matrices("jones", jones, flip_vertical)
    result = np.zeros((*matrices.shape[:-2], 3, 3), matrices.dtype)
    result[..., 1:, 1:] = matrices[..., ::-1, ::-1]
    return result


def from_chromatix(matrix: Any, *, flip_vertical: bool = False) -> np.ndarray:
    """Jones matrices from those that act on (z, y, x), the reverse of :func:`to_chromatix`.

    The component z of a beam is not transmitted by a Jones matrix: ``matrix[..., 0, 0]`` is left out. (Simulated
    fields convert in the same way: ``field.u[..., :0:-1]`` is (x, y), our two components.)

    Parameters
    ----------
    matrix: complex ``(*P, 3, 3)``.
    flip_vertical: whether component 1 points up there and down here.

    Returns
    -------
    complex ``(*P, 2, 2)``, precision of the input.

    Raises
    ------
    ValueError: not 3 x 3 matrices, or z is coupled to x or y.

    >>> from_chromatix([[0, 0, 0], [0, 4, 3], [0, 2, 1]]).real.astype(int).tolist()
    [[1, 2], [3, 4]]
    """
    matrices = complex_array("matrix", matrix, trailing=(3, 3))
    coupling = np.maximum(np.abs(matrices[..., 0, 1:]), np.abs(matrices[..., 1:, 0]))
    if np.any(coupling > 0):
        raise ValueError(
            f"matrix must not couple z to x or y, got elements up to {float(np.nanmax(coupling)):.3g} in the first row "
            "or column; a Jones matrix has no component along the beam."
        )
    return flip(matrices[..., :0:-1, :0:-1], flip_vertical)


def to_chromatix_retarder(parameters: Parameters, *, flip_vertical: bool = False) -> dict[str, np.ndarray]:
    """The retarder of the parameters as arguments of ``chromatix.functional.phase_retarder``.

    Its formula, without the common factor of :func:`to_chromatix`, is ``retarder(-eta, -theta, phi)`` of
    :mod:`polinfer.elements`, so theta is a fast axis for ``eta > 0``: ``theta = pi/2 - theta_eta`` for our
    ``eta >= 0`` and ``-theta_eta`` otherwise, ``phi = xi``.

    Parameters
    ----------
    parameters: shape P, radians.
    flip_vertical: whether component 1 points up there and down here: theta changes sign.

    Returns
    -------
    ``{"theta": [0, pi), "eta": [0, pi], "phi": (-pi, pi]}``, each of shape P, radians. ``phase_retarder`` takes single
    numbers; for a map use :func:`to_chromatix`.

    >>> arguments = to_chromatix_retarder(Parameters(0.0, 0.0, 1.0, 0.3, 0.2))
    >>> {name: round(float(x), 3) for name, x in arguments.items()}
    {'theta': 1.271, 'eta': 1.0, 'phi': 0.2}
    """
    p = reduced(parameters)
    angle = p.retardance_angle if flip_vertical else -p.retardance_angle
    angle = np.where(p.retardance < 0, angle, angle + angle.dtype.type(pi / 2))
    return {"theta": half_turn(angle), "eta": np.abs(p.retardance), "phi": p.circularity}


def from_chromatix_retarder(theta: Any, eta: Any, phi: Any = 0.0, *, flip_vertical: bool = False) -> Parameters:
    """Canonical parameters (D = 0) of ``phase_retarder(field, theta, eta, phi)``, up to the sign of the matrix.

    Parameters
    ----------
    theta: angle of the fast axis, radians. eta: retardance, radians, reduced to (-pi, pi]. phi: circularity, radians.
    flip_vertical: whether component 1 points up there and down here.

    >>> p = from_chromatix_retarder(np.pi / 2 - 0.3, 1.0, 0.2)
    >>> [round(float(x), 3) for x in p[2:]]
    [1.0, 0.3, 0.2]
    """
    theta, eta, phi = real_arrays(theta=theta, eta=eta, phi=phi)
    zero = np.zeros_like(eta)
    return canonicalise(Parameters(zero, zero, -eta, theta if flip_vertical else -theta, phi))
