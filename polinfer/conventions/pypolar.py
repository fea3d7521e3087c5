"""pypolar: complex conjugates, fast axes along (cos theta, sin theta)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..records import Parameters
from .axes import linear_retarder_arguments, linear_retarder_parameters
from .matrices import conjugate, jones_matrices

__all__ = ["from_pypolar", "from_pypolar_retarder", "to_pypolar", "to_pypolar_retarder"]


def to_pypolar(jones: Any, *, flip_vertical: bool = False) -> np.ndarray:
    """Jones matrices in the convention of pypolar: ``conj(J)``, since its waves are ``e^{i(omega t - kz)}``.

    Fields convert in the same way: ``conj(E)``. Its default convention is meant
    (``use_alternate_convention(False)``).

    Parameters
    ----------
    jones: complex ``(*P, 2, 2)``, any unit.
    flip_vertical: whether component 1 points up there and down here: ``conj(diag(1, -1) J diag(1, -1))``.

    Returns
    -------
    complex ``(*P, 2, 2)``, precision of the input; each matrix multiplies a field of pypolar.

    Raises
    ------
    ValueError, TypeError: ``jones`` is no array of 2 x 2 matrices.

    Source: pypolar 1.2, ``pypolar.jones``.

    >>> from polinfer.elements import retarder
    >>> plate = to_pypolar(retarder(np.pi / 2, 0.0, 0.0))  # the horizontal axis is slow: a smaller phase there
    >>> np.degrees(np.angle(np.diagonal(plate))).round().tolist()
    [-45.0, 45.0]
    """
    return conjugate(jones_matrices("jones", jones, flip_vertical))


def from_pypolar(matrix: Any, *, flip_vertical: bool = False) -> np.ndarray:
    """Jones matrices of pypolar in our convention, the reverse of :func:`to_pypolar`.

    With ``retarder`` and ``polariser`` of :mod:`polinfer.elements`, ``from_pypolar(op_retarder(theta, delta))`` is
    ``retarder(-delta, -theta, 0) = retarder(delta, pi/2 - theta, 0)`` and ``from_pypolar(op_linear_polarizer(theta))``
    is ``polariser(1, -theta) / sqrt 2``; with ``flip_vertical`` the angles are ``+theta``.

    Parameters
    ----------
    matrix: ``(*P, 2, 2)``. (Given arrays of angles, pypolar builds ``(2, 2, *P)``: use ``np.moveaxis``.)
    flip_vertical: whether component 1 points up there and down here.

    Returns
    -------
    complex ``(*P, 2, 2)``, precision of the input.

    Raises
    ------
    ValueError, TypeError: ``matrix`` is no array of 2 x 2 matrices.

    >>> from polinfer import RetarderFirst, decompose
    >>> plate = np.diag([np.exp(0.25j * np.pi), np.exp(-0.25j * np.pi)])  # op_quarter_wave_plate(0)
    >>> p = decompose(from_pypolar(plate), RetarderFirst())
    >>> round(float(p.retardance), 3), round(float(p.retardance_angle), 3)  # the vertical axis is slow
    (1.571, 1.571)
    """
    return conjugate(jones_matrices("matrix", matrix, flip_vertical))


def to_pypolar_retarder(parameters: Parameters, *, flip_vertical: bool = False) -> dict[str, np.ndarray]:
    """The retarder of the parameters as arguments of ``pypolar.jones.op_retarder``.

    ``theta`` is the angle of the fast axis, in [0, pi), and ``delta = |eta|``. For ``eta >= 0`` that is
    ``theta = pi/2 - theta_eta`` (``pi/2 + theta_eta`` with ``flip_vertical``), else without the pi/2.

    Parameters
    ----------
    parameters: shape P, radians; the retarders must be linear: xi = 0 or pi, or an axis at 0 or pi/2.
    flip_vertical: whether component 1 points up there and down here.

    Returns
    -------
    ``{"theta": ..., "delta": ...}``, each of shape P, radians.

    Raises
    ------
    ValueError: a retarder is elliptical; :func:`to_pypolar` converts its matrix.

    >>> arguments = to_pypolar_retarder(Parameters(0.0, 0.0, 1.0, 0.3, 0.0))
    >>> {name: round(float(x), 3) for name, x in arguments.items()}
    {'theta': 1.271, 'delta': 1.0}
    """
    azimuth, retardance = linear_retarder_arguments("pypolar", parameters, flip_vertical)
    return {"theta": azimuth, "delta": retardance}


def from_pypolar_retarder(theta: Any, delta: Any, *, flip_vertical: bool = False) -> Parameters:
    """Canonical parameters (D = 0) of ``pypolar.jones.op_retarder(theta, delta)``, up to the sign of the matrix.

    Parameters
    ----------
    theta: angle of the fast axis, radians. delta: retardance, radians, reduced to (-pi, pi].
    flip_vertical: whether component 1 points up there and down here.

    >>> p = from_pypolar_retarder(np.pi / 2 - 0.3, 1.0)
    >>> round(float(p.retardance), 3), round(float(p.retardance_angle), 3)
    (1.0, 0.3)
    """
    return linear_retarder_parameters(flip_vertical, theta=theta, delta=delta)
