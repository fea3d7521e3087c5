"""Parameters of a matrix in closed form, and how much the assumed ordering matters."""

from __future__ import annotations

from typing import Any

import numpy as np

from .checks import complex_array, one_of_types, real_array
from .degeneracy import canonicalise
from .neighbours import Window, box_mean
from .orderings import Ordering, PolariserFirst, RetarderFirst
from .records import Parameters

__all__ = ["decompose", "ordering_error"]


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
    matrices = complex_array("jones", jones, trailing=(2, 2))
    real_type = np.zeros((), matrices.dtype).real.dtype
    if neighbours is not None:
        one_of_types("neighbours", neighbours, (Window,), "pass Window(rows, columns) or None.")
        matrices = box_mean(matrices, neighbours, trailing=2)
    useful = np.isfinite(matrices).all(axis=(-1, -2)) & (np.abs(matrices) > 0).any(axis=(-1, -2))
    found = ordering.decompose(np.where(useful[..., None, None], matrices.astype(np.complex128), np.eye(2)))
    if found is None:
        raise ValueError(f"ordering {type(ordering).__name__} has no closed form; use fit.")
    return Parameters(*(np.where(useful, x, np.nan).astype(real_type) for x in canonicalise(found)))


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
    forward = np.asarray(RetarderFirst().jones(values))
    difference = np.abs(forward - np.asarray(PolariserFirst().jones(values)))
    with np.errstate(divide="ignore", invalid="ignore"):
        q = np.mean(np.where(difference == 0, 0, difference / np.abs(forward)), axis=(-1, -2))
    size = np.sqrt(np.sum(difference**2, axis=(-1, -2)) / np.sum(np.abs(forward) ** 2, axis=(-1, -2)))
    return q, size
