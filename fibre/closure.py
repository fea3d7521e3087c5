"""How wrong the retrieved fields are, from the data alone: the closure of the illumination states.

In: fields of the same scene in n known states, with the variance that the image noise explains. Out: two numbers that
turn that variance into the one the closure errors show. Called by ``retrieve_fields``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.optimize

from polinfer.checks import complex_array, real_array

__all__ = ["NoiseScale", "closure_errors", "closure_phases", "noise_scale"]


@dataclass(frozen=True)
class NoiseScale:
    """True variance = inflation x stated variance + relative_error^2 x |field|^2; inflation >= 1."""

    inflation: float = 1.0
    relative_error: float = 0.0

    def variance(self, fields: np.ndarray, stated: np.ndarray) -> np.ndarray:
        """Variance of ``fields`` whose image noise alone gives ``stated``."""
        return self.inflation * stated + self.relative_error**2 * np.abs(fields) ** 2


def closure_errors(fields: np.ndarray, variance: np.ndarray, states: np.ndarray) -> np.ndarray:
    r"""Squared closure errors, their stated variance and the power they stem from, real (3, n - 2, ...).

    n fields that depend linearly on states U (2, n) obey :math:`\sum_k c_k y_k = 0` for every c with U c = 0; there
    are n - 2 of unit length. Returns :math:`|\sum c_k y_k|^2`, :math:`\sum |c_k|^2 \mathrm{var}_k` and
    :math:`\sum |c_k|^2 |y_k|^2`. ``fields`` complex, ``variance`` real: (n, ...).

    >>> states = np.array([[1, 1, 1], [1, 1j, -1]])
    >>> fields = np.einsum("an,a->n", states, [0.3, 2j])[:, None]
    >>> bool(closure_errors(fields, np.ones((3, 1)), states)[0].max() < 1e-25)
    True
    """
    states = complex_array("states", states, shape=(2, None), finite=True)
    fields = complex_array("fields", fields)
    variance = real_array("variance", variance)
    null = scipy.linalg.null_space(states)
    share = np.abs(null) ** 2
    return np.stack([
        np.abs(np.einsum("kc,k...->c...", null, fields)) ** 2,
        np.einsum("kc,k...->c...", share, variance),
        np.einsum("kc,k...->c...", share, np.abs(fields) ** 2),
    ])  # fmt: skip


def closure_phases(fields: np.ndarray, variance: np.ndarray, states: np.ndarray, iterations: int = 200) -> np.ndarray:
    r"""Phases by which n captures should be turned so that their states close best, (n,) radians of mean 0.

    Minimises :math:`\sum_c \sum |\sum_k c_k e^{i \phi_k} y_k|^2 / \mathrm{var}` over the phases, one after the other
    (each has a closed form) from 0. Thousands of amplitudes have a say, where a reference spot has a few. With fewer
    than three states nothing can be told and all phases are 0. Shapes as in :func:`closure_errors`.

    >>> states = np.array([[1, 1, 1], [1, 1j, -1]])
    >>> turned = np.exp(1j * np.array([[0.1], [-0.2], [0.1]]))
    >>> fields = turned * np.einsum("an,ax->nx", states, [[0.3, 1.0], [2j, -1.0]])
    >>> closure_phases(fields, np.ones((3, 2)), states).round(6).tolist()
    [-0.1, 0.2, -0.1]
    """
    states = complex_array("states", states, shape=(2, None), finite=True)
    count = states.shape[1]
    if count < 3:
        return np.zeros(count)
    null = scipy.linalg.null_space(states)
    flat = complex_array("fields", fields).reshape(count, -1)
    weight = 1 / real_array("variance", variance).reshape(count, -1).mean(0)
    gram = (flat.conj() * weight) @ flat.T
    matrix = gram * (null.conj() @ null.T)
    np.fill_diagonal(matrix, 0)
    turn = np.ones(count, complex)
    for _ in range(iterations):
        for k in range(count):
            pull = matrix[k] @ turn
            turn[k] = -pull / abs(pull) if pull != 0 else turn[k]
    phases = np.angle(turn / turn[0])
    # only differences of phase are seen: keep the captures, on average, where the reference put them
    return phases - phases.mean()


def noise_scale(errors: np.ndarray) -> NoiseScale:
    """The noise that makes squared closure errors (3, count) as large as expected, each being exponential.

    Phase retrieval errs in two ways: by the image noise, alike everywhere, and by a phase that wanders over the frame,
    in proportion to the field. Non-negative least squares in units of the expectation (reweighted; the maximum
    likelihood of exponential variables), the first factor never below 1. Without data (fewer than three states)
    nothing is changed.
    """
    squared, stated, power = errors.reshape(3, -1)
    if squared.size == 0:
        return NoiseScale()
    excess, relative = 0.0, float(np.sum(np.maximum(squared - stated, 0)) / max(np.sum(power), 1e-300))
    for _ in range(30):
        expected = (1 + excess) * stated + relative * power
        design = np.stack([stated, power], 1) / expected[:, None]
        (excess, relative), _ = scipy.optimize.nnls(design, (squared - stated) / expected)
    return NoiseScale(1 + float(excess), float(np.sqrt(relative)))
