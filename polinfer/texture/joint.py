"""Joint distributions of several angles, fitted in closed form by score matching."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np

__all__ = ["Joint", "MultivariateVonMises", "Terms", "TorusGraph", "score_matching", "terms"]

Frequency = tuple[int, ...]
Statistic = dict[Frequency, complex]


class Joint(ABC):
    """An exponential family ``p(x) ~ e^{sum of parameters times statistics}`` of d angles; a frozen dataclass.

    Statistics are real trigonometric polynomials, of degree 1 in every angle, written as Fourier series: frequency k
    to the coefficient of ``e^{i k.x}``. They refer to angles from which the mean directions were subtracted.

    ``singular`` is what the parameters are where the pixels do not determine them: infinite if that happens only where
    they lie on a line, so that the density has no bound, NaN if it may happen elsewhere.
    """

    singular: float = np.nan

    @abstractmethod
    def statistics(self, angles: int) -> list[Statistic]:
        """The statistics of so many angles."""

    @abstractmethod
    def degrees(self, angles: int) -> int:
        """Number of fitted parameters, the mean directions included where the statistics do not cover them."""


def _cosine(*frequency: int) -> Statistic:
    return {frequency: 0.5, tuple(-k for k in frequency): 0.5}


def _sine(*frequency: int) -> Statistic:
    return {frequency: -0.5j, tuple(-k for k in frequency): 0.5j}


def _unit(angles: int, places: dict[int, int]) -> Frequency:
    return tuple(places.get(j, 0) for j in range(angles))


@dataclass(frozen=True)
class MultivariateVonMises(Joint):
    r"""The sine model: every angle is von Mises distributed given the others.

    .. math:: p(x) \propto \exp\Big(\sum_j \kappa_j \cos(x_j - \mu_j)
              + \sum_{j<k} \lambda_{jk} \sin(x_j - \mu_j) \sin(x_k - \mu_k)\Big)

    Concentrated, it is the Gaussian with precision matrix :math:`(\kappa_j, -\lambda_{jk})`. Source: Mardia, Hughes,
    Taylor and Singh, Canadian Journal of Statistics 36, 2008.
    """

    singular = np.inf

    def statistics(self, angles: int) -> list[Statistic]:
        single = [_cosine(*_unit(angles, {j: 1})) for j in range(angles)]
        pairs = []
        for j, k in combinations(range(angles), 2):
            apart, together = _unit(angles, {j: 1, k: -1}), _unit(angles, {j: 1, k: 1})
            pairs.append(
                {f: 0.5 * c for f, c in _cosine(*apart).items()} | {f: -0.5 * c for f, c in _cosine(*together).items()}
            )
        return single + pairs

    def degrees(self, angles: int) -> int:
        return 2 * angles + angles * (angles - 1) // 2


@dataclass(frozen=True)
class TorusGraph(Joint):
    r"""All cosines and sines of the angles, their differences and their sums.

    .. math:: p(x) \propto \exp\Big(\sum_j a_j^T s(x_j) + \sum_{j<k} b_{jk}^T s(x_j - x_k) + c_{jk}^T s(x_j + x_k)\Big),
              \quad s(x) = (\cos x, \sin x)

    It describes what the sine model cannot: angles that are uniform each but differ by a constant, for instance. It has
    many parameters, 8 for two angles and 18 for three. Where angles are concentrated they are hardly determined, and
    the entropy is far too small in windows of few pixels, or NaN; take the sine model there. Source: Klein et al.,
    Annals of Applied Statistics 14, 2020.
    """

    def statistics(self, angles: int) -> list[Statistic]:
        frequencies = [_unit(angles, {j: 1}) for j in range(angles)]
        for j, k in combinations(range(angles), 2):
            frequencies += [_unit(angles, {j: 1, k: -1}), _unit(angles, {j: 1, k: 1})]
        return [part(*f) for f in frequencies for part in (_cosine, _sine)]

    def degrees(self, angles: int) -> int:
        return 2 * angles**2


@dataclass(frozen=True)
class Terms:
    """What score matching needs of the window: means of ``e^{i k.x}`` at these frequencies, and what to make of them.

    ``quadratic`` holds (a, b, place, conjugate, coefficient) of every part of the matrix, ``linear`` (a, place,
    conjugate, coefficient) of the right-hand side.
    """

    frequencies: tuple[Frequency, ...]
    quadratic: tuple[tuple[int, int, int, bool, complex], ...]
    linear: tuple[tuple[int, int, bool, complex], ...]
    size: int


@lru_cache
def terms(model: Joint, angles: int) -> Terms:
    """Terms of a model of so many angles."""
    statistics = model.statistics(angles)
    places: dict[Frequency, int] = {}

    def place(frequency: Frequency) -> tuple[int, bool]:
        # half of the frequencies are enough: the mean at -k is the conjugate of that at k
        first = next((k for k in frequency if k), 0)
        conjugate = first < 0
        key = tuple(-k for k in frequency) if conjugate else frequency
        return places.setdefault(key, len(places)), conjugate

    for j in range(angles):
        place(_unit(angles, {j: 1}))  # the mean directions
    linear = [
        (a, *place(k), c * sum(n * n for n in k))
        for a, statistic in enumerate(statistics)
        for k, c in statistic.items()
    ]
    sums: dict[tuple[int, int, Frequency], complex] = {}
    for a, first in enumerate(statistics):
        for b in range(a, len(statistics)):
            for k, c in first.items():
                for n, e in statistics[b].items():
                    key = (a, b, tuple(x + y for x, y in zip(k, n, strict=True)))
                    sums[key] = sums.get(key, 0) - c * e * sum(x * y for x, y in zip(k, n, strict=True))
    quadratic = [(a, b, *place(k), c) for (a, b, k), c in sums.items() if c != 0]
    return Terms(tuple(places), tuple(quadratic), tuple(linear), len(statistics))


def score_matching(found: Terms, means: np.ndarray, noisy: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    r"""Parameters that minimise the mean of ``|grad log p|^2 / 2 + laplace log p`` over the pixels of each window.

    That needs no normaliser and is linear: ``G p = h`` with ``G_ab`` the mean of ``grad s_a . grad s_b`` and ``h_a``
    minus that of ``laplace s_a`` (Hyvarinen 2005).

    Parameters
    ----------
    means: complex (frequencies, pixels), means of ``e^{i k.x}``. noisy: whether noise was taken out of them, so that G
        may have negative eigenvalues.

    Returns
    -------
    parameters: (pixels, parameters). point: (pixels,), where an angle is constant, or noise explains all of it.
    singular: (pixels,), where G has no inverse.
    """
    pixels = means.shape[1]
    matrix, right = np.zeros((pixels, found.size, found.size)), np.zeros((pixels, found.size))

    def part(place: int, conjugate: bool, factor: complex) -> np.ndarray:
        mean = means[place]
        return factor.real * mean.real - factor.imag * (-mean.imag if conjugate else mean.imag)

    for a, b, place, conjugate, factor in found.quadratic:
        matrix[:, a, b] += part(place, conjugate, complex(factor))
    for a, place, conjugate, factor in found.linear:
        right[:, a] += part(place, conjugate, complex(factor))
    diagonal = np.einsum("paa->pa", matrix)
    scale = np.sqrt(np.maximum(diagonal, 1e-300))
    matrix /= scale[:, :, None] * scale[:, None, :]
    lower = np.arange(found.size)[:, None] > np.arange(found.size)
    matrix = np.where(lower, np.swapaxes(matrix, 1, 2), matrix)
    flat = ~np.isfinite(matrix).all(axis=(1, 2)) | (diagonal <= 1e-13).any(axis=1)
    matrix[flat] = np.eye(found.size)
    singular = np.linalg.eigvalsh(matrix)[:, 0] < 1e-10 if noisy else np.linalg.det(matrix) < 1e-13
    matrix[singular] = np.eye(found.size)
    return np.linalg.solve(matrix, (right / scale)[..., None])[..., 0] / scale, flat, singular
