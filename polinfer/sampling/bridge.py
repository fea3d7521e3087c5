"""Evidence by bridge sampling: from draws of a density, and from a mixture that resembles it.

With draws x of a density f of unknown integral Z, and draws y of a normalised density q, the optimal bridge of Meng and
Wong (Statistica Sinica 6, 831, 1996) solves

    Z = mean_y [f / (s_1 f + s_2 Z q)] / mean_x [q / (s_1 f + s_2 Z q)],

s_1 and s_2 the shares of the two samples. Its relative variance is the sum of those of the two means; that of
the draws counts their autocorrelation (Fruehwirth-Schnatter, Econometrics Journal 7, 143, 2004).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import lgamma, log, pi
from typing import NamedTuple

import numpy as np

from .charts import Target, draw_prior

__all__ = [
    "DEFENCE",
    "Bridge",
    "Proposal",
    "autocorrelation_time",
    "bridge",
    "defended",
    "fit_mixture",
    "halves_bridged",
]

FREEDOM = 6.0  # degrees of freedom of the components: heavier tails than a Gaussian's
ROUNDS, EM_ROUNDS = 200, 40
DEFENCE = 0.1  # share of the prior in a mixture


@dataclass(frozen=True, eq=False)
class Proposal:
    """A mixture of Student distributions, and with probability ``defence`` a draw from the prior.

    ``shares`` (components), ``means`` (components, k), ``roots`` (components, k, k): lower triangular, of the scale
    matrices. ``draw_prior(rng, count)`` and ``log_prior(points)`` are the prior's.
    """

    shares: np.ndarray
    means: np.ndarray
    roots: np.ndarray
    defence: float
    draw_prior: Callable[[np.random.Generator, int], np.ndarray]
    log_prior: Callable[[np.ndarray], np.ndarray]

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Points ``(count, k)``."""
        k = self.means.shape[1]
        chosen = rng.choice(len(self.shares), size=count, p=self.shares)
        heavy = np.sqrt(FREEDOM / rng.chisquare(FREEDOM, size=count))
        steps = np.einsum("nij,nj->ni", self.roots[chosen], rng.normal(size=(count, k)))
        points = self.means[chosen] + heavy[:, None] * steps
        defended = rng.uniform(size=count) < self.defence
        if defended.any():
            points[defended] = self.draw_prior(rng, int(np.count_nonzero(defended)))
        return points

    def log_density(self, points: np.ndarray, prior: np.ndarray | None = None) -> np.ndarray:
        """Normalised log density ``(n,)`` of points ``(n, k)``; ``prior`` is ``log_prior`` there if it is known."""
        defence = log(self.defence) + (self.log_prior(points) if prior is None else prior)
        terms = np.log((1 - self.defence) * self.shares)[:, None] + _log_students(points, self.means, self.roots)
        return np.asarray(np.logaddexp.reduce(np.concatenate([defence[None], terms]), axis=0))


def defended(target: Target, mixture: tuple[np.ndarray, np.ndarray, np.ndarray], defence: float) -> Proposal:
    """A mixture, and with a small probability the prior of the target."""

    def draw(rng: np.random.Generator, count: int) -> np.ndarray:
        return draw_prior(target.model, target.centre, rng, count)

    return Proposal(*mixture, defence, draw, lambda points: target.evaluate(points)[1])


def _log_students(points: np.ndarray, means: np.ndarray, roots: np.ndarray) -> np.ndarray:
    """Log densities ``(components, n)`` of the components at points ``(n, k)``."""
    k = means.shape[1]
    rest, square = points.T - means[:, :, None], np.zeros((len(means), len(points)))
    whitened: list[np.ndarray] = []
    for i in range(k):  # by substitution; a library would start threads for so small matrices
        column = rest[:, i]
        for j in range(i):
            column -= roots[:, i, j, None] * whitened[j]
        column /= roots[:, i, i, None]
        whitened.append(column)
        square += column**2
    constant = lgamma(0.5 * (FREEDOM + k)) - lgamma(0.5 * FREEDOM) - 0.5 * k * log(pi * FREEDOM)
    constants = constant - np.log(np.einsum("cii->ci", roots)).sum(axis=1)
    return np.asarray(constants[:, None] - 0.5 * (FREEDOM + k) * np.log1p(square / FREEDOM))


def fit_mixture(
    points: np.ndarray, components: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shares, means and lower roots of a mixture that resembles ``points`` (n, k), by expectation maximisation."""
    n, k = points.shape
    scale = np.maximum(points.std(axis=0), 1e-12)
    centre = points.mean(axis=0)
    z = (points - centre) / scale
    components = max(min(components, n // (4 * k)), 1)
    means = z[rng.choice(n, size=components, replace=False)]
    shares = np.full(components, 1 / components)
    # a ridge keeps components that have found few points from collapsing
    ridge = 1e-3 * np.eye(k)
    covariances = np.broadcast_to(np.cov(z.T).reshape(k, k) + ridge, (components, k, k)).copy()
    for _ in range(EM_ROUNDS if components > 1 else 1):
        roots = np.linalg.cholesky(covariances)
        logs = np.log(shares)[:, None] + _log_students(z, means, roots)
        weights = np.exp(logs - np.logaddexp.reduce(logs, axis=0))
        total = weights.sum(axis=1) + 1e-9
        shares = np.maximum(total / n, 1e-3)
        shares /= shares.sum()
        means = weights @ z / total[:, None]
        offset = z[None] - means[:, None]
        # few points say little about a matrix: the prior's weight is that of k + 1 points
        shrunk = np.swapaxes(weights[..., None] * offset, 1, 2) @ offset + (k + 1) * ridge
        covariances = shrunk / (total + k + 1)[:, None, None] + 1e-9 * np.eye(k)
    roots = np.linalg.cholesky(covariances)
    return shares, centre + scale * means, scale[:, None] * roots


def autocorrelation_time(series: np.ndarray) -> float:
    """Integrated autocorrelation time, >= 1, of ``(chain, time, walker)`` along time, about the common mean.

    The autocorrelation is the mean over chains and walkers, summed up to the first pair of lags that is not positive
    (Geyer, Statistical Science 7, 473, 1992).

    >>> autocorrelation_time(np.random.default_rng(0).normal(size=(4, 500, 8))) < 1.2
    True
    """
    length = series.shape[1]
    offset = series - series.mean()
    variance = np.mean(offset**2)
    if length < 4 or not variance > 0:
        return 1.0
    spectrum = np.fft.rfft(offset, n=2 * length, axis=1)
    lags = np.fft.irfft(np.abs(spectrum) ** 2, axis=1)[:, :length].mean(axis=(0, 2)) / length / variance
    pairs = lags[: length // 2 * 2].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0)
    kept = pairs[: negative[0]] if len(negative) else pairs
    return float(max(2 * np.sum(np.minimum.accumulate(kept)) - 1, 1.0)) if len(kept) else 1.0


class Bridge(NamedTuple):
    """Log evidence and its standard error (nats)."""

    log_evidence: float
    error: float


def bridge(target: Target, draws: np.ndarray, values: np.ndarray, proposal: Proposal, rng: np.random.Generator,
           points: int = 1) -> Bridge:  # fmt: skip
    """Evidence of ``target`` from draws ``(chain, time, walker, k)`` and its logarithm ``values`` there.

    The proposal must not be made of the same draws; ``points`` times as many points are drawn from it.
    """
    shape = values.shape
    flat = draws.reshape(-1, draws.shape[-1])
    other = proposal.draw(rng, points * len(flat))
    first = values.reshape(-1) - proposal.log_density(flat)
    density, prior = target.evaluate(other)
    second = density - proposal.log_density(other, prior)
    effective = len(flat) / autocorrelation_time(values)
    share = effective / (effective + len(other))
    guess = float(np.logaddexp.reduce(second) - log(len(other)))
    if not np.isfinite(guess):
        guess = float(np.median(first))
    for _ in range(ROUNDS):
        log_other = np.logaddexp(log(share) + second, log(1 - share) + guess)
        log_own = np.logaddexp(log(share) + first, log(1 - share) + guess)
        top = np.logaddexp.reduce(second - log_other) - log(len(other))
        bottom = np.logaddexp.reduce(-log_own) - log(len(flat))
        step = float(top - bottom) - guess
        guess += step
        if not np.isfinite(guess) or abs(step) < 1e-9:
            break
    if not np.isfinite(guess):
        return Bridge(float("nan"), float("nan"))
    numerator = np.exp(second - guess - np.logaddexp(log(share) + second - guess, log(1 - share)))
    denominator = np.exp(-np.logaddexp(log(share) + first - guess, log(1 - share)))
    variance = np.var(numerator) / np.mean(numerator) ** 2 / len(other)
    time = autocorrelation_time(denominator.reshape(shape))
    relative = np.var(denominator) / np.mean(denominator) ** 2
    # ensembles that disagree say more than the autocorrelation within them
    between = 0.0
    if shape[0] > 1:
        means = denominator.reshape(shape[0], -1).mean(axis=1) / np.mean(denominator)
        between = float(np.var(means, ddof=1) / shape[0])
    return Bridge(guess, float(np.sqrt(variance + max(relative * time / len(flat), between))))


def halves_bridged(
    target: Target, places: np.ndarray, values: np.ndarray, stream: np.random.SeedSequence, components: int,
    points: int = 1,
) -> Bridge:  # fmt: skip
    """Mean of two bridges: the mixture is fitted to one half of the chains, the bridge built to the other one.

    A mixture that knows the draws it is compared with would give too little. A single chain is halved in time.
    ``places`` ``(chain, time, walker, k)`` and the log densities ``values`` there.
    """
    rng, k = np.random.default_rng(stream), places.shape[-1]
    if len(places) == 1:
        length = values.shape[1] // 2 * 2
        places, values = (x[:, :length].reshape(2, length // 2, *x.shape[2:]) for x in (places, values))
    halves = np.array_split(np.arange(len(places)), 2)
    found = []
    for own, other in (halves, halves[::-1]):
        mixture = fit_mixture(places[other].reshape(-1, k), components, rng)
        found.append(bridge(target, places[own], values[own], defended(target, mixture, DEFENCE), rng, points))
    logs, errors = np.array(found).T
    error = 0.5 * max(float(np.sqrt(np.sum(errors**2))), abs(float(logs[0] - logs[1])))
    return Bridge(float(np.mean(logs)), error)
