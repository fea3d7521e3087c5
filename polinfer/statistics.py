"""Sufficient statistics of complex Gaussian data: any number of states becomes two.

With the singular value decomposition ``U = W s Q`` of the weighted illumination, the residual splits exactly,
``|g J U - V|^2 = |g J R - Y|^2 + E`` with ``R = W s``, ``Y = V Q^H`` (both 2 x 2) and ``E = |V - Y Q|^2``. In terms of
``S = U U^H = R R^H`` and the least-squares matrix ``Jhat = V U^+`` the first term is
``tr[(g J - Jhat) S (g J - Jhat)^H]``; in this form neither an inverse nor the square of the condition number appears, a
single state is no special case, and single precision loses nothing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .records import Measurement

__all__ = ["Statistics", "least_squares_jones", "summarise"]


class Statistics(NamedTuple):
    """What the likelihood needs of the data of each pixel, in units of sigma.

    ``illumination`` R and ``response`` Y, complex ``(*P, 2, 2)`` and divided by sigma; ``residual`` E / sigma^2 and
    ``constant``, the terms of the log likelihood that depend on no parameter, ``(*P)``.
    """

    illumination: Any
    response: Any
    residual: Any
    constant: Any


class Summary(NamedTuple):
    """:class:`Statistics`, and what else is to be known about each pixel (NumPy, shape P)."""

    statistics: Statistics
    states: np.ndarray
    rank: np.ndarray
    masked: np.ndarray
    non_finite: np.ndarray


def _factor(illumination: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``R = W s``, ``Q`` and the rank; each distinct matrix is factorised once."""
    lead, (rows, states) = illumination.shape[:-2], illumination.shape[-2:]
    flat = illumination.reshape(-1, rows * states)
    distinct, where = np.unique(flat, axis=0, return_inverse=True) if len(flat) > 1 else (flat, np.zeros(1, int))
    left, values, right = np.linalg.svd(distinct.reshape(-1, rows, states), full_matrices=False)
    root = np.zeros((len(distinct), 2, 2), np.complex128)
    unitary = np.zeros((len(distinct), 2, states), np.complex128)
    kept = values.shape[-1]  # one state has one singular value; the second row of Q stays 0
    root[..., :kept], unitary[:, :kept] = left * values[:, None, :], right
    rank = np.sum(values > 1e-12 * np.max(values, axis=-1, keepdims=True), axis=-1)
    where = where.reshape(-1)
    return root[where].reshape(*lead, 2, 2), unitary[where].reshape(*lead, 2, states), rank[where].reshape(lead)


def summarise(measurement: Measurement, sigma: np.ndarray) -> Summary:
    """Sufficient statistics of a measurement whose noise is ``sigma`` (broadcasts to P), formed in float64.

    >>> m = Measurement(np.eye(2), np.eye(2), sigma=0.5)
    >>> summarise(m, m.sigma).statistics.residual.item()
    0.0
    """
    shape, n = measurement.shape, measurement.states
    response: np.ndarray = measurement.response.astype(np.complex128)
    finite: np.ndarray = np.isfinite(response).all(axis=-2)
    sigma = np.broadcast_to(np.asarray(sigma, np.float64), shape)
    weight = np.ones(n) if measurement.weight is None else measurement.weight
    root_weight: np.ndarray = np.sqrt(weight.astype(np.float64))
    used = root_weight > 0
    non_finite = np.broadcast_to((~finite & used).any(axis=-1), shape)
    response = np.where(finite[..., None, :] & used[..., None, :], response, 0) * root_weight[..., None, :]
    root, unitary, rank = _factor(measurement.illumination.astype(np.complex128) * root_weight[..., None, :])
    projected = response @ np.conj(np.swapaxes(unitary, -1, -2))
    residual = np.sum(np.abs(response - projected @ unitary) ** 2, axis=(-1, -2))
    states = np.broadcast_to(used.sum(axis=-1), shape)
    log_weight = np.sum(np.log(np.where(used, root_weight, 1.0)), axis=-1)
    constant = 4 * np.broadcast_to(log_weight, shape) - 2 * states * np.log(np.pi * sigma**2)
    scale = sigma[..., None, None]
    statistics = Statistics(root / scale, projected / scale, residual / sigma**2, constant - residual / sigma**2)
    mask = np.ones((), bool) if measurement.mask is None else measurement.mask
    return Summary(statistics, states, np.broadcast_to(rank, shape), ~np.broadcast_to(mask, shape), non_finite)


def least_squares_jones(statistics: Statistics) -> np.ndarray:
    """``Jhat = V U^+``, complex ``(*P, 2, 2)``; directions that were not illuminated are 0."""
    return statistics.response @ np.linalg.pinv(statistics.illumination, rcond=1e-9)
