"""py_pol: complex conjugates, fast axes along (cos a, sin a), matrices in the first two axes or in objects."""

from __future__ import annotations

import importlib
import warnings
from typing import Any

import numpy as np

from ..checks import complex_array
from ..records import Parameters
from .axes import (
    diattenuator_arguments,
    diattenuator_parameters,
    real_arrays,
    retarder_arguments,
    retarder_parameters,
)
from .matrices import conjugate, flip, jones_matrices

__all__ = [
    "from_py_pol",
    "from_py_pol_diattenuator",
    "from_py_pol_object",
    "from_py_pol_retarder",
    "to_py_pol",
    "to_py_pol_diattenuator",
    "to_py_pol_object",
    "to_py_pol_retarder",
]


def to_py_pol(jones: Any, *, flip_vertical: bool = False) -> np.ndarray:
    """Jones matrices as arrays of py_pol: ``conj(J)`` with the matrix in the first two axes.

    The documentation of py_pol states waves ``e^{i(kz - omega t)}``; its matrices and its handedness are those of
    ``e^{i(omega t - kz)}``. ``Jones_matrix().from_matrix`` takes the result; :func:`to_py_pol_object` does that too.
    Fields convert in the same way: ``conj(E)``, component first.

    Parameters
    ----------
    jones: complex ``(*P, 2, 2)``, any unit.
    flip_vertical: whether component 1 points up there and down here: ``conj(diag(1, -1) J diag(1, -1))``.

    Returns
    -------
    complex ``(2, 2, *P)``, precision of the input.

    Raises
    ------
    ValueError, TypeError: ``jones`` is no array of 2 x 2 matrices.

    Source: py_pol 1.3, ``py_pol.jones_matrix``.

    >>> to_py_pol(np.zeros((3, 4, 2, 2))).shape
    (2, 2, 3, 4)
    """
    return np.moveaxis(conjugate(jones_matrices("jones", jones, flip_vertical)), (-2, -1), (0, 1))


def from_py_pol(matrix: Any, *, flip_vertical: bool = False) -> np.ndarray:
    """Jones matrices of py_pol in our convention, the reverse of :func:`to_py_pol`.

    With ``retarder`` and ``polariser`` of :mod:`polinfer.elements`, ``retarder_linear(R, azimuth=a)`` of py_pol is
    ``e^{i R/2} retarder(R, pi/2 - a, 0)`` here and ``diattenuator_linear(Tmax=T, Tmin=t, azimuth=a)`` is
    ``sqrt((T + t)/2) polariser((T - t)/(T + t), -a)``; with ``flip_vertical`` a counts the other way. Its common
    phases are arbitrary (it makes the first element real): fit with a gain, ``Model(gain=PhaseGain())``. Its ``'RP'``
    is a matrix product, hence our :class:`polinfer.PolariserFirst`.

    Parameters
    ----------
    matrix: ``(2, 2, *P)``, as ``J.parameters.matrix()`` gives it. An object goes to :func:`from_py_pol_object`.
    flip_vertical: whether component 1 points up there and down here.

    Returns
    -------
    complex ``(*P, 2, 2)``, precision of the input.

    Raises
    ------
    ValueError, TypeError: ``matrix`` does not start with two axes of length 2.

    >>> from_py_pol(np.zeros((2, 2, 5))).shape
    (5, 2, 2)
    """
    if hasattr(matrix, "M"):
        raise TypeError(
            f"matrix must be an array, got {type(matrix).__name__}; use from_py_pol_object for the objects of py_pol."
        )
    array = complex_array("matrix", matrix)
    if array.shape[:2] != (2, 2):
        raise ValueError(
            f"matrix must have shape (2, 2, ...) as in py_pol, got {array.shape}; move the axes of the matrix to the "
            "front with np.moveaxis(matrix, (-2, -1), (0, 1))."
        )
    return conjugate(flip(np.moveaxis(array, (0, 1), (-2, -1)), flip_vertical))


def to_py_pol_object(jones: Any, *, name: str = "J", flip_vertical: bool = False) -> Any:
    """A ``py_pol.jones_matrix.Jones_matrix`` that holds the matrices ``conj(J)``, see :func:`to_py_pol`.

    Parameters
    ----------
    jones: complex ``(*P, 2, 2)``. name: what the object is called when printed.
    flip_vertical: whether component 1 points up there and down here.

    Returns
    -------
    Jones_matrix of shape P, in double precision: py_pol knows no other.

    Raises
    ------
    ImportError: py_pol is not installed (``pip install 'polinfer[peers]'``).

    ``to_py_pol_object(jones).analysis.decompose_pure("PR")`` then splits it as :class:`polinfer.RetarderFirst` does.
    """
    matrices = to_py_pol(jones, flip_vertical=flip_vertical)
    # importing py_pol compiles code that Python warns of and switches the warnings of the whole process off
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            module = importlib.import_module("py_pol.jones_matrix")
        except ImportError as error:
            raise ImportError(
                "to_py_pol_object needs py_pol; pip install 'polinfer[peers]', or use to_py_pol, which returns arrays "
                "and does not need it."
            ) from error
    return module.Jones_matrix(name).from_matrix(matrices)


def from_py_pol_object(matrix: Any, *, flip_vertical: bool = False) -> np.ndarray:
    """Jones matrices in a ``Jones_matrix`` of py_pol, in our convention; see :func:`from_py_pol`.

    Parameters
    ----------
    matrix: a ``py_pol.jones_matrix.Jones_matrix`` of shape P.
    flip_vertical: whether component 1 points up there and down here.

    Returns
    -------
    complex ``(*P, 2, 2)``. py_pol gives a single matrix the shape (1,); here P is then ``()``.

    Raises
    ------
    TypeError: another object; the Mueller matrices of py_pol are no Jones matrices.

    >>> from types import SimpleNamespace
    >>> stands_for_an_object = SimpleNamespace(type="Jones_matrix", M=np.ones((2, 2, 6)), shape=[2, 3])
    >>> from_py_pol_object(stands_for_an_object).shape
    (2, 3, 2, 2)
    """
    if getattr(matrix, "type", None) != "Jones_matrix":
        raise TypeError(
            f"matrix must be a Jones_matrix of py_pol, got {type(matrix).__name__}; arrays go to from_py_pol, and a "
            "Mueller object becomes a Jones_matrix by its from_Mueller."
        )
    stored = np.asarray(matrix.M)
    shape = () if matrix.shape is None else tuple(int(n) for n in matrix.shape)
    if shape == (1,):
        shape = ()
    return from_py_pol(stored.reshape((2, 2, *shape)), flip_vertical=flip_vertical)


def to_py_pol_retarder(parameters: Parameters, *, flip_vertical: bool = False) -> dict[str, np.ndarray]:
    """The retarder of the parameters as arguments of ``Jones_matrix().retarder_azimuth_ellipticity``.

    ``ret = |eta|``; ``azimuth`` and ``ellipticity`` are those of the fast eigenstate, positive ellipticity for
    ``(1, i) / sqrt 2`` in py_pol, ``(1, -i) / sqrt 2`` here. For ``eta >= 0`` its Stokes vector is
    ``-(cos 2 theta_eta, -sin 2 theta_eta cos xi, sin 2 theta_eta sin xi)``.

    Parameters
    ----------
    parameters: shape P, radians.
    flip_vertical: whether component 1 points up there and down here: azimuth and ellipticity change sign.

    Returns
    -------
    ``{"ret": [0, pi], "azimuth": [0, pi), "ellipticity": [-pi/4, pi/4]}``, each of shape P, radians.

    >>> arguments = to_py_pol_retarder(Parameters(0.0, 0.0, 1.0, np.pi / 4, np.pi / 2))
    >>> {name: round(float(x), 3) for name, x in arguments.items() if name != "azimuth"}  # circular: no azimuth
    {'ret': 1.0, 'ellipticity': -0.785}
    """
    retardance, azimuth, ellipticity = retarder_arguments(parameters, flip_vertical)
    return {"ret": retardance, "azimuth": azimuth, "ellipticity": ellipticity}


def from_py_pol_retarder(ret: Any, azimuth: Any, ellipticity: Any = 0.0, *, flip_vertical: bool = False) -> Parameters:
    """Canonical parameters (D = 0) of ``retarder_azimuth_ellipticity`` or ``retarder_linear``, up to a phase.

    Parameters
    ----------
    ret: retardance, radians. azimuth, ellipticity: of the fast eigenstate, radians.
    flip_vertical: whether component 1 points up there and down here.

    >>> p = from_py_pol_retarder(np.pi / 2, np.pi / 6)
    >>> round(float(p.retardance), 3), round(float(p.retardance_angle), 3)
    (1.571, 1.047)
    """
    ret, azimuth, ellipticity = real_arrays(ret=ret, azimuth=azimuth, ellipticity=ellipticity)
    return retarder_parameters(ret, azimuth, ellipticity, flip_vertical)


def to_py_pol_diattenuator(parameters: Parameters, *, flip_vertical: bool = False) -> dict[str, np.ndarray]:
    """The polariser of the parameters as arguments of ``Jones_matrix().diattenuator_linear``.

    ``Tmax = 1 + |D|`` and ``Tmin = 1 - |D|``, so that the matrix is ``A_pol``, of mean transmission 1; divide both by
    ``1 + |D|`` for an element that does not amplify. ``azimuth`` is ``-theta_D`` (``+ pi/2`` where D < 0).

    Parameters
    ----------
    parameters: shape P. flip_vertical: whether component 1 points up there and down here.

    Returns
    -------
    ``{"Tmax": ..., "Tmin": ..., "azimuth": [0, pi)}``, each of shape P.

    >>> arguments = to_py_pol_diattenuator(Parameters(0.2, -0.3, 0.0, 0.0, 0.0))
    >>> {name: round(float(x), 3) for name, x in arguments.items()}
    {'Tmax': 1.2, 'Tmin': 0.8, 'azimuth': 0.3}
    """
    largest, least, azimuth = diattenuator_arguments(parameters, flip_vertical)
    return {"Tmax": largest, "Tmin": least, "azimuth": azimuth}


def from_py_pol_diattenuator(Tmax: Any, Tmin: Any, azimuth: Any, *, flip_vertical: bool = False) -> Parameters:
    """Canonical parameters (no retardance) of ``diattenuator_linear``: ``D = (Tmax - Tmin) / (Tmax + Tmin)``.

    The mean transmission ``(Tmax + Tmin)/2`` is no parameter: its root is a gain.

    Parameters
    ----------
    Tmax, Tmin: transmissions of intensity along and across the axis, >= 0. azimuth: of that axis, radians.
    flip_vertical: whether component 1 points up there and down here.

    >>> p = from_py_pol_diattenuator(0.6, 0.4, -0.3)
    >>> round(float(p.diattenuation), 3), round(float(p.diattenuation_angle), 3)
    (0.2, 0.3)
    """
    return diattenuator_parameters("azimuth", flip_vertical, Tmax=Tmax, Tmin=Tmin, azimuth=azimuth)
