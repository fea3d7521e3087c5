"""Parameters of a matrix in closed form, and how much the assumed ordering matters."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np

from .checks import complex_array, one_of_types, real_array
from .degeneracy import canonicalise
from .neighbours import Window, box_mean
from .orderings import Ordering, PolariserFirst, RetarderFirst
from .orderings.on_host import jones_on_host
from .records import Parameters
from .threads import each

__all__ = ["decompose", "ordering_error"]

CHUNK = 8192  # matrices whose intermediate results stay in the processor's cache
MARGIN = 1e-9  # far more than rounding


def decompose(jones: Any, ordering: Ordering, neighbours: Window | None = None) -> Parameters:
    """Parameters of measured Jones matrices in closed form: no iteration, no prior.

    The diattenuator follows from ``J J^H`` (or ``J^H J``), the retarder is the one nearest to what is left. Exact for
    matrices that are a complex factor times a product of the two elements; for noisy ones the retarder is the
    conditional optimum given the diattenuator.

    Parameters
    ----------
    jones: complex ``(*P, 2, 2)``. ordering: one that has a closed form, :class:`RetarderFirst` or
        :class:`PolariserFirst`.
    neighbours: a window over whose finite matrices the mean is taken first, or None. Matrices are added as they are:
        phases of their own in every pixel cancel, for these use :func:`polinfer.fit`.

    Returns
    -------
    Parameters of shape P, the canonical ones, radians; NaN where a matrix is not finite, or the one decomposed is zero.

    Raises
    ------
    ValueError: a wrong shape, or an ordering without a closed form. TypeError: arguments of a wrong kind.

    >>> truth = Parameters(0.3, 0.4, 1.0, 0.6, 0.2)
    >>> found = decompose(2j * RetarderFirst().jones(truth), RetarderFirst())
    >>> [round(float(x), 3) for x in found]
    [0.3, 0.4, 1.0, 0.6, 0.2]
    """
    one_of_types("ordering", ordering, (Ordering,), "pass an instance such as RetarderFirst().")
    matrices = np.ascontiguousarray(complex_array("jones", jones, trailing=(2, 2)))
    real_type = np.zeros((), matrices.dtype).real.dtype
    if neighbours is not None:
        one_of_types("neighbours", neighbours, (Window,), "pass Window(rows, columns) or None.")
        matrices = box_mean(matrices, neighbours, trailing=2)
    if ordering.decompose(np.eye(2, dtype=complex)) is None:
        raise ValueError(f"ordering {type(ordering).__name__} has no closed form; use fit.")
    shape = matrices.shape[:-2]
    flat = matrices.reshape(-1, 2, 2)
    out = np.empty((5, len(flat)), real_type)

    def work(begin: int) -> None:
        part = slice(begin, begin + CHUNK)
        out[:, part] = _decompose(flat[part], ordering)

    each(work, range(0, len(flat), CHUNK))
    return Parameters(*out.reshape(5, *shape))


def _decompose(matrices: np.ndarray, ordering: Ordering) -> np.ndarray:
    """Canonical parameters ``(5, pixels)`` of matrices ``(pixels, 2, 2)``."""
    size = np.sum(np.abs(matrices.view(matrices.real.dtype).reshape(-1, 8)), axis=-1, dtype=float)
    useless = ~(np.isfinite(size) & (size > 0))
    if useless.any():
        matrices = np.where(useless[:, None, None], np.eye(2), matrices)
    found = ordering.decompose(matrices)
    assert found is not None
    values, unsure = _canonical(np.stack([np.asarray(x, float) for x in found]))
    if unsure.any():
        values[:, unsure] = canonicalise(Parameters(*(np.asarray(x)[unsure] for x in found)))
    values[:, useless] = np.nan
    return values


def _canonical(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What :func:`polinfer.canonicalise` makes of D and eta >= 0 and theta_eta in [0, pi/2], and where it is not sure.

    Of such values the copies are antipodal in each angle, so the choice is one of signs. Next to a tie or to an end of
    a range rounding may decide.
    """
    d, axis, eta, angle, xi = values
    # how far 2 theta_D is from pi/2 on the circle; from the other copy it is pi less that
    apart = pi - np.abs(np.abs(2 * axis - 0.5 * pi) - pi)
    gain = 4 * d - pi * (2 * apart - pi)  # squared distance of the other copy less that of this one
    stays, flips = gain > 0, np.abs(xi) > 0.5 * pi
    axis = np.where(stays, axis, axis - np.copysign(0.5 * pi, axis))
    found = [
        np.where(stays, d, -d),
        axis,
        np.where(flips, -eta, eta),
        np.where(flips, 0.5 * pi - angle, angle),
        np.where(flips, xi - np.copysign(pi, xi), xi),
    ]
    sure = (d >= 0) & (eta >= 0) & (eta <= pi) & (angle > MARGIN) & (angle < 0.5 * pi - MARGIN)
    sure &= (np.abs(gain) > MARGIN) & (np.abs(axis) < 0.5 * pi - MARGIN) & (np.abs(np.abs(xi) - 0.5 * pi) > MARGIN)
    return np.stack(found) + 0, ~sure  # 0 in place of -0


def ordering_error(parameters: Parameters) -> tuple[np.ndarray, np.ndarray]:
    """How different the matrices of the two orderings are, for the same parameters.

    Returns ``(q, frobenius)`` of shape P. With ``J = A_pol A_ret`` and ``Jrev = A_ret A_pol``, q is the mean over the
    four elements of ``|J - Jrev| / |J|`` (unbounded: an element of J may vanish) and frobenius is
    ``||J - Jrev||_F / ||J||_F``, at most 2.

    Source: Gordon et al., supplementary information: Q, with the elements taken from the matrix products.

    >>> q, frobenius = ordering_error(Parameters(0.0, 0.3, 1.0, 0.5, 0.2))
    >>> bool(frobenius < 1e-6)
    True
    """
    one_of_types("parameters", parameters, (Parameters,), "pass Parameters(...).")
    values = Parameters(*(real_array(n, x) for n, x in zip(Parameters._fields, parameters, strict=True)))
    forward = jones_on_host(RetarderFirst(), values)
    difference = np.abs(forward - jones_on_host(PolariserFirst(), values))
    with np.errstate(divide="ignore", invalid="ignore"):
        q = np.mean(np.where(difference == 0, 0, difference / np.abs(forward)), axis=(-1, -2))
    size = np.sqrt(np.sum(difference**2, axis=(-1, -2)) / np.sum(np.abs(forward) ** 2, axis=(-1, -2)))
    return q, size
