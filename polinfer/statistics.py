"""Sufficient statistics of complex Gaussian data: any number of states becomes two.

With a factorisation ``U = R Q`` of the weighted illumination, R 2 x 2 and Q of orthonormal rows, the residual splits
exactly, ``|g J U - V|^2 = |g J R - Y|^2 + E`` with ``Y = V Q^H`` (2 x 2) and ``E = |V - Y Q|^2``. In terms of
``S = U U^H = R R^H`` and the least-squares matrix ``Jhat = V U^+`` the first term is
``tr[(g J - Jhat) S (g J - Jhat)^H]``; in this form neither an inverse nor the square of the condition number appears, a
single state is no special case, and single precision loses nothing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .records import Measurement

__all__ = ["Factor", "Statistics", "Summary", "factor", "least_squares_jones", "project", "summarise"]

BLOCK = 8192  # pixels that are brought to double precision at once: they stay in the processor's cache
# A row that is this much of the other one's multiple is one: what is left of it is rounding.
PARALLEL = 1e-14


class Statistics(NamedTuple):
    """What the likelihood needs of the data of each pixel; fields broadcast to the pixel shape P.

    ``illumination`` R and ``response`` Y, complex ``(*P, 2, 2)``; ``residual`` E, ``constant``, the terms of the log
    likelihood that depend on no parameter, and ``count``, the number N of complex data, ``(*P)``.

    Where sigma is known, R and Y are divided by sigma, E by sigma^2, and the constant is
    ``sum(log weights) - N log(pi sigma^2) - E / sigma^2``. Where it is not, all are in the unit of the response and the
    constant is ``sum(log weights) - N log(pi)``.
    """

    illumination: Any
    response: Any
    residual: Any
    constant: Any
    count: Any


TRAILING = Statistics(2, 2, 0, 0, 0)  # axes behind the pixels


class Summary(NamedTuple):
    """:class:`Statistics`, and what else is to be known about each pixel (NumPy, shape P)."""

    statistics: Statistics
    states: np.ndarray
    rank: np.ndarray
    masked: np.ndarray
    non_finite: np.ndarray


class Factor(NamedTuple):
    """``illumination = root @ rows``: complex ``(..., 2, 2)`` and ``(..., 2, n)``, and the rank ``(...)``.

    The rows are orthonormal; a row without a direction of its own is 0, and so is its column of the root.
    """

    root: np.ndarray
    rows: np.ndarray
    rank: np.ndarray


def factor(illumination: np.ndarray) -> Factor:
    """Factorise weighted illuminations ``(..., 2, n)`` in float64.

    A single matrix by its singular value decomposition; many by Gram-Schmidt with pivoting, applied twice, element by
    element over the pixels.

    >>> found = factor(np.array([[[1, 1, 1], [1, 1j, -1]], [[0, 0, 0], [2, 2, 2]]]))
    >>> bool(np.allclose(found.root @ found.rows, [[[1, 1, 1], [1, 1j, -1]], [[0, 0, 0], [2, 2, 2]]]))
    True
    >>> found.rank.tolist()
    [2, 1]
    """
    lead, n = illumination.shape[:-2], illumination.shape[-1]
    flat = illumination.astype(np.complex128, copy=False).reshape(-1, 2, n)
    if len(flat) == 1:
        root, rows = _singular(flat[0])
        root, rows = root[None], rows[None]
    else:
        root, rows = (_pixels_first(x) for x in _orthonormalise(_pixels_last(flat)))
    size = np.sum(_square(root), axis=(-1, -2))
    area = np.abs(root[:, 0, 0] * root[:, 1, 1] - root[:, 0, 1] * root[:, 1, 0])  # product of the singular values
    largest = 0.5 * (size + np.sqrt(np.maximum(size**2 - 4 * area**2, 0)))  # square of the larger one
    rank = (largest > 0).astype(np.int64) + (area > 1e-12 * largest)
    return Factor(root.reshape(*lead, 2, 2), rows.reshape(*lead, 2, n), rank.reshape(lead))


def project(response: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``Y = V Q^H`` and ``E = |V - Y Q|^2`` of weighted responses ``(..., 2, n)``, in float64.

    ``rows`` is one matrix ``(2, n)`` for all pixels, or one for each. E is formed directly: a difference of sums would
    lose it at a high signal-to-noise ratio.

    >>> y, rest = project(np.array([[3.0, 4.0], [0.0, 1.0]]), np.array([[1.0, 0.0], [0.0, 0.0]]))
    >>> y.real.tolist(), float(rest)
    ([[3.0, 0.0], [0.0, 0.0]], 17.0)
    """
    response = response.astype(np.complex128, copy=False)
    n = response.shape[-1]
    if rows.ndim == 2:
        flat = response.reshape(-1, n)
        projected = flat @ rows.conj().T
        residual = np.sum(_square(flat - projected @ rows).reshape(*response.shape[:-2], 2 * n), axis=-1)
        return projected.reshape(*response.shape[:-1], 2), residual
    lead = np.broadcast_shapes(response.shape[:-2], rows.shape[:-2])
    v = _pixels_last(np.broadcast_to(response, (*lead, 2, n)).reshape(-1, 2, n))
    q = _pixels_last(np.broadcast_to(rows, (*lead, 2, n)).reshape(-1, 2, n))
    projected = np.sum(v[:, None] * q.conj()[None], axis=2)
    rest = v - projected[:, 0, None] * q[0] - projected[:, 1, None] * q[1]
    return _pixels_first(projected).reshape(*lead, 2, 2), np.sum(_square(rest), axis=(0, 1)).reshape(lead)


def _square(x: np.ndarray) -> np.ndarray:
    return np.asarray(x.real**2 + x.imag**2)


def _pixels_last(x: np.ndarray) -> np.ndarray:
    # loops over a short last axis are slow in NumPy
    return np.ascontiguousarray(np.moveaxis(x, 0, -1))


def _pixels_first(x: np.ndarray) -> np.ndarray:
    return np.moveaxis(x, -1, 0)


def _singular(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    left, values, right = np.linalg.svd(matrix, full_matrices=False)
    root, rows = np.zeros((2, 2), np.complex128), np.zeros(matrix.shape, np.complex128)
    kept = values.shape[-1]  # one state has one singular value
    root[:, :kept], rows[:kept] = left * values, right
    return root, rows


def _orthonormalise(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Root ``(2, 2, pixels)`` and rows ``(2, n, pixels)`` of illuminations ``(2, n, pixels)``."""
    norm = np.sqrt(np.sum(_square(u), axis=1))
    swap = norm[1] > norm[0]
    longer, shorter = np.where(swap, u[1], u[0]), np.where(swap, u[0], u[1])
    size, least = np.where(swap, norm[1], norm[0]), np.where(swap, norm[0], norm[1])
    first = longer / np.where(size > 0, size, 1)
    overlap = np.sum(shorter * first.conj(), axis=0)
    rest = shorter - overlap * first
    # once more: after the first pass a short remainder is not yet orthogonal
    again = np.sum(rest * first.conj(), axis=0)
    rest = rest - again * first
    overlap = overlap + again
    height = np.sqrt(np.sum(_square(rest), axis=0))
    height = np.where(height > PARALLEL * least, height, 0)
    second = np.where(height > 0, rest / np.where(height > 0, height, 1), 0)
    nothing = np.zeros_like(overlap)
    root = np.array(
        [
            [np.where(swap, overlap, size), np.where(swap, height, nothing)],
            [np.where(swap, size, overlap), np.where(swap, nothing, height)],
        ]
    )
    return root, np.array([first, second])


def _by_pixel(values: np.ndarray, shape: tuple[int, ...], trailing: int) -> np.ndarray:
    """Values with one leading axis: as long as there are pixels, or 1 where all pixels share them."""
    lead = values.ndim - trailing
    tail = values.shape[lead:]
    if values.size and all(n == 1 or step == 0 for n, step in zip(values.shape[:lead], values.strides, strict=False)):
        return values[(slice(0, 1),) * lead].reshape(1, *tail)
    return np.broadcast_to(values, shape + tail).reshape(-1, *tail)


def _part(values: np.ndarray, part: slice) -> np.ndarray:
    return values if len(values) == 1 else values[part]


def summarise(measurement: Measurement, sigma: np.ndarray | None) -> Summary:
    """Sufficient statistics of a measurement whose noise is ``sigma`` (broadcasts to P; None: unknown).

    Formed in float64, and rounded once to the precision of the response. Where all pixels share the illumination and
    the weights, these are factorised once.

    >>> m = Measurement(np.eye(2), np.eye(2), sigma=0.5)
    >>> summarise(m, m.sigma).statistics.residual.item()
    0.0
    """
    shape, n = measurement.shape, measurement.states
    pixels = int(np.prod(shape))
    complex_type = measurement.response.dtype
    real_type = np.zeros((), complex_type).real.dtype
    response = _by_pixel(measurement.response, shape, 2)
    weight = np.ones(n) if measurement.weight is None else measurement.weight.astype(np.float64)
    root_weight = _by_pixel(np.sqrt(weight), shape, 1)
    used = root_weight > 0
    scale = _by_pixel(np.ones(()) if sigma is None else sigma, shape, 0).astype(np.float64)
    states = used.sum(axis=-1)
    constant = 4 * np.sum(np.log(np.where(used, root_weight, 1.0)), axis=-1) - 2 * states * np.log(np.pi * scale**2)
    illumination = _by_pixel(measurement.illumination, shape, 2)
    one_factor = len(illumination) == 1 and len(root_weight) == 1
    shared = factor(illumination * root_weight[:, None, :]) if one_factor else None
    root = np.empty((0 if one_factor else pixels, 2, 2), complex_type)
    rank = np.empty(0 if one_factor else pixels, np.int64)
    projected = np.empty((pixels, 2, 2), complex_type)
    residual = np.empty(pixels)
    non_finite = np.zeros(pixels, bool)
    plain = bool(np.all(root_weight == 1))
    for begin in range(0, pixels, BLOCK):
        part = slice(begin, begin + BLOCK)
        v = _part(response, part).astype(np.complex128)
        size = _part(scale, part)
        if shared is not None:
            rows = shared.rows[0]
        else:
            found = factor(_part(illumination, part) * _part(root_weight, part)[:, None, :])
            root[part] = found.root / size[:, None, None]
            rows, rank[part] = found.rows, found.rank
        finite: np.ndarray = np.isfinite(v)
        if not (plain and finite.all()):
            lit = _part(used, part)
            finite = np.all(finite, axis=-2)
            non_finite[part] = (~finite & lit).any(axis=-1)
            v = np.where((finite & lit)[:, None, :], v, 0) * _part(root_weight, part)[:, None, :]
        y, rest = project(v, rows)
        projected[part] = y / size[:, None, None]
        residual[part] = rest / size**2
    if shared is not None:
        root, rank = shared.root / scale[:, None, None], shared.rank

    def frame(values: np.ndarray, tail: tuple[int, ...] = ()) -> np.ndarray:
        if len(values) == 1:
            return np.broadcast_to(values[0], shape + tail)
        return values.reshape(shape + tail)

    statistics = Statistics(
        frame(root.astype(complex_type, copy=False), (2, 2)),
        frame(projected, (2, 2)),
        frame(residual.astype(real_type, copy=False)),
        frame((constant if sigma is None else constant - residual).astype(real_type, copy=False)),
        frame((2.0 * states).astype(real_type)),
    )
    mask = np.ones((), bool) if measurement.mask is None else measurement.mask
    return Summary(statistics, frame(states), frame(rank), ~np.broadcast_to(mask, shape), frame(non_finite))


def least_squares_jones(statistics: Statistics) -> np.ndarray:
    """``Jhat = V U^+``, complex ``(*P, 2, 2)``, in float64; directions that were not illuminated are 0.

    >>> m = Measurement([[1, 1], [0, 0]], [[2, 2], [0, 0]], sigma=0.5)
    >>> least_squares_jones(summarise(m, m.sigma).statistics).real.round(9).tolist()
    [[2.0, 0.0], [0.0, 0.0]]
    """
    root = statistics.illumination.astype(np.complex128)
    adjoint = np.conj(np.swapaxes(root, -1, -2))
    size = np.sum(_square(root), axis=(-1, -2))
    determinant = root[..., 0, 0] * root[..., 1, 1] - root[..., 0, 1] * root[..., 1, 0]
    both = np.abs(determinant) > 1e-9 * size
    cofactors = np.stack([root[..., 1, 1], -root[..., 0, 1], -root[..., 1, 0], root[..., 0, 0]], axis=-1)
    inverse = cofactors.reshape(root.shape) / np.where(both, determinant, 1)[..., None, None]
    # a matrix of rank 1 has this pseudo-inverse
    inverse = np.where(both[..., None, None], inverse, adjoint / np.where(size > 0, size, 1)[..., None, None])
    return np.asarray(statistics.response.astype(np.complex128) @ inverse)
