"""katsu: Mueller matrices, S3 positive for (1, -i) / sqrt 2, fast axes along (cos a, sin a)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..checks import real_array, real_number
from ..records import Parameters
from .axes import (
    diattenuator_arguments,
    diattenuator_parameters,
    linear_retarder_arguments,
    linear_retarder_parameters,
)
from .matrices import flip, jones_matrices

__all__ = [
    "from_katsu",
    "from_katsu_diattenuator",
    "from_katsu_retarder",
    "to_katsu",
    "to_katsu_diattenuator",
    "to_katsu_retarder",
]

# Stokes vector of E (x) conj(E): S3 = 2 Im(Ex conj(Ey)); sqrt(2) times a unitary matrix
_STOKES = np.array([[1, 0, 0, 1], [1, 0, 0, -1], [0, 1, 1, 0], [0, -1j, 1j, 0]])


def to_katsu(jones: Any, *, flip_vertical: bool = False) -> np.ndarray:
    """Mueller matrices as katsu has them: ``M = A (J (x) conj(J)) A^-1``.

    A takes ``E (x) conj(E)`` to the Stokes vector ``(|Ex|^2 + |Ey|^2, |Ex|^2 - |Ey|^2, 2 Re Ex conj(Ey),
    2 Im Ex conj(Ey))``: with our waves S3 > 0 for ``(1, -i) / sqrt 2``. The phase of the gain is lost, its square is a
    factor of M. It is the same as ``jones_to_mueller`` of ``katsu.polarimetry`` for one matrix.

    Parameters
    ----------
    jones: complex ``(*P, 2, 2)``, any unit.
    flip_vertical: whether component 1 points up there and down here: S2 and S3 change sign.

    Returns
    -------
    real ``(*P, 4, 4)``, precision of the input, squared unit of the input.

    Raises
    ------
    ValueError, TypeError: ``jones`` is no array of 2 x 2 matrices.

    Source: katsu, ``katsu.mueller`` and ``katsu.polarimetry``; Chipman, Lam and Young, "Polarized Light and Optical
    Systems" (2018).

    >>> to_katsu(np.diag([1, 1j])).round(3).tolist()  # fast axis horizontal, a quarter of a period
    [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, -1.0, 0.0]]
    """
    matrices = jones_matrices("jones", jones, flip_vertical)
    stokes = _STOKES.astype(matrices.dtype)
    with np.errstate(invalid="ignore"):
        product = matrices[..., :, None, :, None] * np.conj(matrices)[..., None, :, None, :]
        product = product.reshape(*matrices.shape[:-2], 4, 4)
        return (stokes @ product @ np.conj(stokes.T)).real / 2 + 0


def from_katsu(mueller: Any, tolerance: float = 1e-5, *, flip_vertical: bool = False) -> np.ndarray:
    """Jones matrices of pure Mueller matrices, the reverse of :func:`to_katsu` up to a phase for each pixel.

    A Mueller matrix is pure if the Hermitian ``H = vec(J) vec(J)^H`` that holds the same numbers in another order has
    one eigenvalue l4 > 0 and no others; the result is the matrix of that eigenvector. The nearest pure Mueller matrix
    is at the relative distance ``sqrt(l1^2 + l2^2 + l3^2) / sqrt(l1^2 + l2^2 + l3^2 + l4^2)`` in the Frobenius norm.

    The phase is chosen so that det J > 0 and Re tr J >= 0, as for :meth:`polinfer.Ordering.jones` with
    ``|eta| < pi`` and ``|D| < 1``; where det J = 0 the trace is positive. It means nothing: fit with a gain,
    ``Model(gain=PhaseGain())``, and beware that the errors of such data are neither normal nor independent.

    Parameters
    ----------
    mueller: real ``(*P, 4, 4)``; NaN stays NaN.
    tolerance: largest relative distance from a pure matrix that is accepted, in [0, 1]. Measured matrices need more
        than the default; what is taken is the nearest pure one.
    flip_vertical: whether component 1 points up there and down here.

    Returns
    -------
    complex ``(*P, 2, 2)``, precision of the input.

    Raises
    ------
    ValueError: not 4 x 4 matrices, or matrices that depolarise more than ``tolerance`` allows.

    Source: S. R. Cloude, "Group theory and polarisation algebra", Optik 75, 26-36 (1986).

    >>> from_katsu(np.diag([1.0, 1.0, 1.0, 1.0])).real.round(3).tolist()
    [[1.0, 0.0], [0.0, 1.0]]
    >>> from_katsu(np.diag([1.0, 0.9, 0.9, 0.9]))
    Traceback (most recent call last):
    ...
    ValueError: mueller must hold pure Mueller matrices, got 1 of 1 that depolarise: the farthest is at a relative
    distance of 0.0468 from the nearest pure one, tolerance is 1e-05; raise tolerance to take the nearest pure
    matrices, or mask these pixels.
    """
    matrices = real_array("mueller", mueller, trailing=(4, 4))
    tolerance = real_number("tolerance", tolerance, low=0, high=1)
    known = np.isfinite(matrices).all(axis=(-1, -2))
    stokes = _STOKES
    product = np.conj(stokes.T) @ np.where(known[..., None, None], matrices, 0).astype(np.float64) @ stokes / 2
    hermitian = np.swapaxes(product.reshape(*known.shape, 2, 2, 2, 2), -3, -2).reshape(product.shape)
    values, vectors = np.linalg.eigh(hermitian)
    rest = np.sum(values[..., :3] ** 2, axis=-1) + np.minimum(values[..., 3], 0) ** 2
    total = np.sum(values**2, axis=-1)
    distance = np.sqrt(rest / np.where(total > 0, total, 1))
    bad = distance > tolerance
    if np.any(bad):
        raise ValueError(
            f"mueller must hold pure Mueller matrices, got {np.count_nonzero(bad)} of {bad.size} that depolarise: the "
            f"farthest is at a relative distance of {float(distance.max()):.3g} from the nearest pure one, tolerance "
            f"is {tolerance:g}; raise tolerance to take the nearest pure matrices, or mask these pixels."
        )
    jones = np.sqrt(np.maximum(values[..., 3], 0))[..., None, None] * vectors[..., 3].reshape(*known.shape, 2, 2)
    jones = _with_phase(jones, float(np.finfo(matrices.dtype).eps) ** 0.5)
    jones = np.where(known[..., None, None], jones, np.nan)
    return flip(jones.astype(np.result_type(matrices.dtype, np.complex64)), flip_vertical)


def _with_phase(jones: np.ndarray, small: float) -> np.ndarray:
    """Matrices times the phase factor that makes the determinant positive, or the trace, or the largest element."""
    size = np.sqrt(np.sum(np.abs(jones) ** 2, axis=(-1, -2)))
    determinant = jones[..., 0, 0] * jones[..., 1, 1] - jones[..., 0, 1] * jones[..., 1, 0]
    trace = jones[..., 0, 0] + jones[..., 1, 1]
    flat = jones.reshape(*size.shape, 4)
    largest = np.take_along_axis(flat, np.argmax(np.abs(flat), axis=-1)[..., None], axis=-1)[..., 0]
    turn = np.where(np.abs(trace) > small * size, trace, largest)
    turn = np.where(np.abs(determinant) > small * size**2, np.sqrt(determinant), turn)
    turn = np.where((trace * np.conj(turn)).real < 0, -turn, turn)
    length = np.abs(turn)
    factor = np.where(length > 0, np.conj(turn) / np.where(length > 0, length, 1), 1)
    return np.asarray(jones * factor[..., None, None])


def to_katsu_retarder(parameters: Parameters, *, flip_vertical: bool = False) -> dict[str, np.ndarray]:
    """The retarder of the parameters as arguments of ``katsu.mueller.linear_retarder`` (add ``shape=`` for maps).

    ``a`` is the angle of the fast axis, in [0, pi), and ``r = |eta|``. For ``eta >= 0`` that is
    ``a = pi/2 - theta_eta`` (``pi/2 + theta_eta`` with ``flip_vertical``), else without the pi/2.

    Parameters
    ----------
    parameters: shape P, radians; the retarders must be linear: xi = 0 or pi, or an axis at 0 or pi/2.
    flip_vertical: whether component 1 points up there and down here.

    Returns
    -------
    ``{"a": ..., "r": ...}``, each of shape P, radians.

    Raises
    ------
    ValueError: a retarder is elliptical; :func:`to_katsu` converts its matrix.

    >>> arguments = to_katsu_retarder(Parameters(0.0, 0.0, 1.0, 0.3, 0.0))
    >>> {name: round(float(x), 3) for name, x in arguments.items()}
    {'a': 1.271, 'r': 1.0}
    """
    azimuth, retardance = linear_retarder_arguments("katsu", parameters, flip_vertical)
    return {"a": azimuth, "r": retardance}


def from_katsu_retarder(a: Any, r: Any, *, flip_vertical: bool = False) -> Parameters:
    """Canonical parameters (D = 0) of ``katsu.mueller.linear_retarder(a, r)``.

    Parameters
    ----------
    a: angle of the fast axis, radians. r: retardance, radians.
    flip_vertical: whether component 1 points up there and down here.

    >>> p = from_katsu_retarder(np.pi / 2 - 0.3, 1.0)
    >>> round(float(p.retardance), 3), round(float(p.retardance_angle), 3)
    (1.0, 0.3)
    """
    return linear_retarder_parameters(flip_vertical, a=a, r=r)


def to_katsu_diattenuator(parameters: Parameters, *, flip_vertical: bool = False) -> dict[str, np.ndarray]:
    """The polariser of the parameters as arguments of ``katsu.mueller.linear_diattenuator``.

    ``Tmax = 1 + |D|`` and ``Tmin = 1 - |D|``, so that the matrix is that of ``A_pol``, of mean transmission 1; divide
    both by ``1 + |D|`` for an element that does not amplify. ``a`` is ``-theta_D`` (``+ pi/2`` where D < 0).

    Parameters
    ----------
    parameters: shape P. flip_vertical: whether component 1 points up there and down here.

    Returns
    -------
    ``{"a": [0, pi), "Tmin": ..., "Tmax": ...}``, each of shape P; a in radians.

    >>> arguments = to_katsu_diattenuator(Parameters(0.2, -0.3, 0.0, 0.0, 0.0))
    >>> {name: round(float(x), 3) for name, x in arguments.items()}
    {'a': 0.3, 'Tmin': 0.8, 'Tmax': 1.2}
    """
    largest, least, azimuth = diattenuator_arguments(parameters, flip_vertical)
    return {"a": azimuth, "Tmin": least, "Tmax": largest}


def from_katsu_diattenuator(a: Any, Tmin: Any, Tmax: Any = 1.0, *, flip_vertical: bool = False) -> Parameters:
    """Canonical parameters (no retardance) of ``linear_diattenuator``: ``D = (Tmax - Tmin) / (Tmax + Tmin)``.

    The mean transmission ``(Tmax + Tmin)/2`` is no parameter: its root is a gain.

    Parameters
    ----------
    a: angle of the transmitting axis, radians. Tmin, Tmax: transmissions of intensity across and along it, >= 0.
    flip_vertical: whether component 1 points up there and down here.

    >>> p = from_katsu_diattenuator(-0.3, 0.25)
    >>> round(float(p.diattenuation), 3), round(float(p.diattenuation_angle), 3)
    (0.6, 0.3)
    """
    return diattenuator_parameters("a", flip_vertical, a=a, Tmin=Tmin, Tmax=Tmax)
