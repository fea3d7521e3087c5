"""The ordering in closed form: no fit, no prior, only the matrices that least squares give."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from ..checks import one_of_types
from ..records import Measurement
from ..statistics import least_squares_jones, summarise
from .judgement import OUTSTANDING, UNDECIDED

__all__ = ["OrderingScreen", "ordering_screen"]

NAMES = ("retarder_first", "polariser_first")
# Im(conj(x0) x1) as a Hermitian form x^H FORM x
FORM = np.array([[0, -0.5j], [0.5j, 0]])


@dataclass(frozen=True, eq=False)
class OrderingScreen:
    """A test of both orderings in closed form, see :func:`ordering_screen`.

    models: ``("retarder_first", "polariser_first")``. statistic: ``(2, *P)``, what the ordering says is 0, in the unit
    of ``|response / illumination|^2``. z_score: ``(2, *P)``, over its standard deviation; NaN where it is not known.
    pixels: how many count. excess: ``(2,)``, by how much the mean square of the statistic exceeds its noise, over its
    noise: 0 where the ordering holds; excess_error: its standard error by the spread between the pixels.
    probability: ``(2,)``, that the excess is as large by chance. lead: half the number of pixels times the difference
    of the two, positive for retarder_first, about a log Bayes factor (nats); scatter: its standard deviation by the
    spread between the pixels. verdict: the ordering whose lead is at least 1.96 times the scatter, or "undecided".
    """

    models: tuple[str, str]
    statistic: np.ndarray
    z_score: np.ndarray
    pixels: int
    excess: np.ndarray
    excess_error: np.ndarray
    probability: np.ndarray
    lead: float
    scatter: float
    verdict: str


def ordering_screen(measurement: Measurement) -> OrderingScreen:
    """Which ordering the matrices allow: ``Im (J J^H)_01 = 0``, retarder first, or ``Im (J^H J)_01 = 0``, the reverse.

    With the least-squares matrix ``Jhat = V U^+`` and ``S = U U^H`` (weighted), the first is free of bias and from the
    second ``2 sigma^2 Im (S^-1)_01`` is subtracted. Both are Hermitian forms ``x^H H x`` of ``x = vec Jhat`` with noise
    of covariance C; their variance is estimated as ``2 x^H H C H x - tr(H C H C)``, free of bias; in z-scores it is at
    least ``tr(H C H C)``, what is left without a signal. A gain does no harm; at D = 0 both orderings hold.

    A tilt of the illumination turns the off-diagonal elements and must be taken out first.

    Parameters
    ----------
    measurement: with sigma; pixels need two independent states.

    Raises
    ------
    ValueError: no sigma. TypeError: not a measurement.

    >>> import polinfer
    >>> truth = polinfer.Parameters(np.full(200, 0.3), 0.4, 1.2, 0.5, 0.2)
    >>> model = polinfer.Model(polinfer.PolariserFirst())
    >>> ordering_screen(polinfer.simulate(model, truth, np.eye(2), sigma=0.05, rng=1)).verdict
    'polariser_first'
    """
    one_of_types("measurement", measurement, (Measurement,), "pass a Measurement.")
    if measurement.sigma is None:
        raise ValueError("measurement has sigma None, but the screen needs it; fit with InferredNoise finds one.")
    summary = summarise(measurement, np.broadcast_to(measurement.sigma, measurement.shape))
    usable = ~(summary.masked | summary.non_finite) & (summary.rank == 2)
    root = np.where(usable[..., None, None], summary.statistics.illumination, np.eye(2))
    jones = np.where(usable[..., None, None], least_squares_jones(summary.statistics), 0)
    # statistics are in units of sigma: the noise of a row (as a column) has the covariance conj(S)^-1
    cover = np.linalg.inv(np.conj(root @ np.conj(np.swapaxes(root, -1, -2))))
    across, along = _between_rows(jones, cover), _between_columns(jones, cover)
    values, variances = (np.stack(x) for x in zip(across, along, strict=True))
    values, variances = (np.where(usable, x, np.nan) for x in (values, variances))
    least = np.stack([2 * _square(FORM @ cover), 0.5 * _square(cover)])[::-1]
    with np.errstate(invalid="ignore", divide="ignore"):
        score = values / np.sqrt(np.maximum(variances, least))
    # an average of z-scores would be biased: the estimated variance depends on the noise of the statistic
    weight = 1 / np.einsum("...ii->...", cover).real[usable]
    noise = weight * variances[:, usable]
    square = weight * values[:, usable] ** 2
    count = square.shape[1]
    with np.errstate(invalid="ignore", divide="ignore"):
        terms = (square - noise) / (noise.sum(axis=1, keepdims=True) / max(count, 1))
    lead, scatter = _sum(0.5 * (terms[1] - terms[0]))
    excess, error = (np.array(x) / max(count, 1) for x in zip(*(_sum(x) for x in terms), strict=True))
    found = count > 1 and abs(lead) >= OUTSTANDING * scatter and lead != 0
    return OrderingScreen(
        models=NAMES,
        statistic=values,
        z_score=score,
        pixels=count,
        excess=excess,
        excess_error=error,
        probability=ndtr(-excess / error),
        lead=lead,
        scatter=scatter,
        verdict=NAMES[int(lead < 0)] if found else UNDECIDED,
    )


def _sum(terms: np.ndarray) -> tuple[float, float]:
    """Sum of independent terms, and its standard deviation by their spread; NaN with one term."""
    count = len(terms)
    return float(terms.sum()), float(np.std(terms, ddof=1) * count**0.5) if count > 1 else float("nan")


def _square(matrix: np.ndarray) -> np.ndarray:
    """``tr(A A)``."""
    return np.asarray(np.einsum("...ij,...ji->...", matrix, matrix).real)


def _form(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """``Re x^H y`` over the last axis."""
    return np.asarray(np.sum(np.conj(x) * y, axis=-1).real)


def _between_columns(jones: np.ndarray, cover: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``Im (J^H J)_01`` without its bias, and its variance: the two rows are alike and independent."""
    moved = np.einsum("...ia,ba->...ib", jones, FORM)
    middle = FORM @ cover @ FORM
    value = _form(jones, moved).sum(axis=-1) - 2 * np.einsum("ij,...ji->...", FORM, cover).real
    square = _square(FORM @ cover)
    first = 2 * sum(_form(jones[..., i, :], np.einsum("...ab,...b->...a", middle, jones[..., i, :])) for i in range(2))
    return value, first - 2 * square


def _between_rows(jones: np.ndarray, cover: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``Im (J J^H)_01``, free of bias, and its variance."""
    value = np.sum(jones[..., 0, :] * np.conj(jones[..., 1, :]), axis=-1).imag
    first = 0.5 * sum(_form(jones[..., i, :], np.einsum("...ab,...b->...a", cover, jones[..., i, :])) for i in range(2))
    return value, first - 0.5 * _square(cover)
