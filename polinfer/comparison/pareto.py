"""Pareto-smoothed importance sampling, for many sets of weights at once (NumPy)."""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp

__all__ = ["fit_generalised_pareto", "smoothed_log_weights"]

PRIOR_SHAPE, PRIOR_COUNT = 0.5, 10.0  # k is drawn towards 0.5 as if by ten tail draws


def fit_generalised_pareto(excess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shape k and scale of generalised Pareto distributions of sorted excesses ``(..., n)`` >= 0.

    An average over a grid of the profile likelihood, with a weak prior of k about 0.5. NaN where all are alike.

    Source: J. Zhang and M. A. Stephens, Technometrics 51, 316 (2009); Vehtari et al., JMLR 25(72) (2024), appendix.

    >>> k, scale = fit_generalised_pareto(-np.log1p(-(np.arange(500) + 0.5) / 500))  # an exponential: k = 0
    >>> bool(abs(k) < 0.1), bool(abs(scale - 1) < 0.1)
    (True, True)
    """
    n = excess.shape[-1]
    count = 30 + int(n**0.5)
    quartile, largest = excess[..., int(n / 4 + 0.5) - 1], excess[..., -1]
    with np.errstate(divide="ignore", invalid="ignore"):
        grid = 1 - np.sqrt(count / (np.arange(1, count + 1) - 0.5))
        b = grid / (3 * quartile[..., None]) + 1 / largest[..., None]
        k = np.stack([np.mean(np.log1p(-b[..., i, None] * excess), axis=-1) for i in range(count)], axis=-1)
        profile = n * (np.log(-b / k) - k - 1)
        weight = np.exp(profile - logsumexp(profile, axis=-1, keepdims=True))
        weight = np.where(weight >= 10 * np.finfo(float).eps, weight, 0)
        middle = np.sum(weight * b, axis=-1) / np.sum(weight, axis=-1)
        shape = np.mean(np.log1p(-middle[..., None] * excess), axis=-1)
        scale = -shape / middle
    return (n * shape + PRIOR_COUNT * PRIOR_SHAPE) / (n + PRIOR_COUNT), scale


def smoothed_log_weights(log_ratios: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normalised log weights ``(..., draws)`` of log importance ratios, and the Pareto shape k of each tail ``(...)``.

    The ``min(S / 5, 3 sqrt S)`` largest of S ratios are replaced by quantiles of the Pareto distribution that fits
    them, and cut at the largest of them. k above 0.7 says that the weights cannot be trusted; it is -inf where all
    ratios of the tail are alike. Draws are taken to be independent.

    Source: A. Vehtari, A. Gelman and J. Gabry, Statistics and Computing 27, 1413 (2017).

    >>> weights, k = smoothed_log_weights(np.random.default_rng(1).normal(size=1000))
    >>> bool(abs(np.exp(weights).sum() - 1) < 1e-9), bool(k < 0.7)
    (True, True)
    """
    ratios = log_ratios - np.max(log_ratios, axis=-1, keepdims=True)
    draws = ratios.shape[-1]
    tail = int(np.ceil(min(draws / 5, 3 * draws**0.5)))
    if tail <= 4:
        return ratios - logsumexp(ratios, axis=-1, keepdims=True), np.full(ratios.shape[:-1], np.inf)
    order = np.argsort(ratios, axis=-1)
    ordered = np.take_along_axis(ratios, order, axis=-1)
    cut = np.exp(np.maximum(ordered[..., -tail - 1], np.log(np.finfo(float).tiny)))
    excess = np.maximum(np.exp(ordered[..., -tail:]) - cut[..., None], 0)
    k, scale = fit_generalised_pareto(excess)
    share = -np.log1p(-(np.arange(tail) + 0.5) / tail)  # of an exponential distribution, k = 0
    shape, size = k[..., None], scale[..., None]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        quantile = np.where(np.abs(shape) < 1e-12, size * share, size * np.expm1(shape * share) / shape)
        smooth = np.minimum(np.log(quantile + cut[..., None]), 0)
    fitted = np.isfinite(k)[..., None] & np.isfinite(smooth)
    ordered[..., -tail:] = np.where(fitted, smooth, ordered[..., -tail:])
    weights = np.empty_like(ratios)
    np.put_along_axis(weights, order, ordered, axis=-1)
    k = np.where(np.isfinite(k), k, np.where(excess[..., -1] > 0, np.inf, -np.inf))
    return weights - logsumexp(weights, axis=-1, keepdims=True), k
