"""The log evidence of one pixel without a sampler: nested quadrature for unit gain, importance sampling for any model.

Default priors, balanced states. With unit gain ``|J U|^2`` is n for every J, and the log likelihood is linear in the
retarder, ``q = (cos eta/2, sin eta/2 (cos 2t, sin 2t cos xi, sin 2t sin xi))``; with its prior the circularity gives a
Bessel function. Two of the symmetries leave D >= 0 and eta >= 0, and both signs of theta_eta are added. What is left
are two angles of the polariser and, for each of their nodes, two of the retarder, Gauss-Legendre nodes where the
density is within ``CUT`` nats of its top. Plain NumPy, from the matrices of :mod:`benchmarks.oracle`.

With a gain the log likelihood has no such form. There points from a mixture that resembles the density, in the
coordinates of :mod:`polinfer.sampling.charts`, are weighed: the log density is the package's, the route is not.
"""

from __future__ import annotations

from math import log, pi
from typing import Any

import jax
import numpy as np
from scipy.special import i0e

from benchmarks.oracle import Oracle
from polinfer import Fit, Measurement, Model, Parameters
from polinfer.fitting.generic import prepare
from polinfer.model import as_device
from polinfer.sampling.bridge import defended, fit_mixture
from polinfer.sampling.charts import Target, centre_of, into_chart
from polinfer.sampling.ensemble import _start, _temper

__all__ = ["importance", "nested"]

CUT = 34.0  # nats below the top, beyond which nothing is counted
ZOOM, ZOOMS = 48, 6
NODES = (40, 56, 32)  # delta, theta_D, and each of eta and theta_eta
UNITS = np.array([[[1, 0], [0, 1]], [[1j, 0], [0, -1j]], [[0, -1j], [-1j, 0]], [[0, -1], [1, 0]]])
POINTS, ROUNDS, BATCHES = 1 << 14, 10, 16


def nested(oracle: Oracle, response: np.ndarray, illumination: np.ndarray, sigma: float, finer: float = 1.0) -> float:
    """Log evidence of one pixel with unit gain, ``response`` (2, n); ``finer`` multiplies the numbers of nodes."""
    outer, inner = ([round(finer * k) for k in part] for part in (NODES[:2], NODES[2:]))
    data = response @ illumination.conj().T

    def slopes(delta: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nothing = np.zeros_like(delta)
        polariser = np.moveaxis(oracle.jones((np.sin(delta), angle, nothing, nothing, nothing)), -1, 0)
        pairs = (polariser[:, None] @ UNITS) if oracle.ordering == "RetarderFirst" else (UNITS @ polariser[:, None])
        found = 2 / sigma**2 * np.einsum("pkij,ij->pk", pairs.conj(), data).real
        weight = oracle.log_prior((np.sin(delta), 0.0, 0.0, 0.0, pi / 2)) + np.log(np.maximum(np.cos(delta), 1e-300))
        return found, weight

    # where it lies in the plane of the polariser: grids that close in on it
    low, high = np.array([0.0, 0.0]), np.array([0.5 * pi, pi])
    for _ in range(ZOOMS):
        axes = [a + (b - a) * (np.arange(ZOOM) + 0.5) / ZOOM for a, b in zip(low, high, strict=True)]
        delta, angle = (y.ravel() for y in np.meshgrid(*axes, indexing="ij"))
        slope, weight = slopes(delta, angle)
        size = _top(slope) + weight
        kept = size > size.max() - 1.3 * CUT
        step = (high - low) / ZOOM
        spread = high[1] - low[1]
        first, last = axes[0][np.flatnonzero(kept.reshape(ZOOM, ZOOM).any(axis=1))[[0, -1]]]
        low[0], high[0] = max(first - step[0], 0.0), min(last + step[0], 0.5 * pi)
        around = angle[np.argmax(size)]
        off = np.remainder(angle - around + 0.5 * pi, pi) - 0.5 * pi
        reach = off[kept].min() - step[1], off[kept].max() + step[1]
        if reach[1] - reach[0] < min(spread, pi):
            low[1], high[1] = around + reach[0], around + reach[1]

    nodes = [np.polynomial.legendre.leggauss(n) for n in outer]
    axes = [a + 0.5 * (b - a) * (1 + x) for a, b, (x, _) in zip(low, high, nodes, strict=True)]
    widths = [np.log(0.5 * (b - a) * w) for a, b, (_, w) in zip(low, high, nodes, strict=True)]
    if high[1] - low[1] > 0.999 * pi:  # the whole circle: even steps
        axes[1], widths[1] = pi * np.arange(outer[1]) / outer[1], np.full(outer[1], log(pi / outer[1]))
    delta, angle = (y.ravel() for y in np.meshgrid(*axes, indexing="ij"))
    slope, weight = slopes(delta, angle)
    weight = weight + np.add.outer(*widths).ravel()
    size = _top(slope) + weight
    kept = np.flatnonzero(size > size.max() - 1.3 * CUT)
    parts = np.array_split(kept, max(len(kept) * inner[0] ** 2 // 400_000, 1))
    terms = np.concatenate([_retarder(slope[k], inner[0]) + weight[k] for k in parts])
    n = illumination.shape[-1]
    constant = -2 * n * log(pi * sigma**2) - (np.sum(np.abs(response) ** 2) + n) / sigma**2
    return float(constant + log(4) + np.logaddexp.reduce(terms))


def _top(slope: np.ndarray) -> np.ndarray:
    """Largest value of ``slope . q`` for ``q_0 >= 0``."""
    return np.where(slope[:, 0] >= 0, np.linalg.norm(slope, axis=1), np.linalg.norm(slope[:, 1:], axis=1))


def _retarder(slope: np.ndarray, count: int) -> np.ndarray:
    """Log of the integral over eta >= 0, theta_eta and xi of ``exp(slope . q + cos xi)``, slopes (points, 4)."""
    x, w = np.polynomial.legendre.leggauss(count)
    across = np.linalg.norm(slope[:, 1:], axis=1)
    whole = np.maximum(np.hypot(slope[:, 0], across), 1e-300)
    mode = np.arctan2(across, slope[:, 0])
    top = np.cos(np.minimum(mode, 0.5 * pi) - mode)
    reach = np.arccos(np.maximum(top - CUT / whole, -1))
    half, low = _interval(mode, reach, 0.5 * pi)
    y = low[:, None] + half[:, None] * (1 + x)
    c, s = np.cos(y), np.sin(y)
    axis = np.arctan2(np.hypot(slope[:, 2], slope[:, 3]), slope[:, 1])
    along = np.maximum(across[:, None] * s, 1e-300)
    half2, low2 = _interval(axis[:, None], np.arccos(np.maximum(1 - CUT / along, -1)), pi)
    z = low2[..., None] + half2[..., None] * (1 + x)
    a, b = s[..., None] * np.cos(z), s[..., None] * np.sin(z)
    both = []
    for sign in (1, -1):  # of theta_eta
        length = np.hypot(sign * slope[:, 2, None, None] * b + 1, slope[:, 3, None, None] * b)
        both.append(length + np.log(2 * pi * i0e(length)))
    terms = c[..., None] * slope[:, 0, None, None] + a * slope[:, 1, None, None] + np.logaddexp(*both)
    # d eta d theta_eta = dy dz
    terms = terms + np.log(w) + (np.log(w) + np.log(half2) + np.log(half)[:, None])[..., None]
    top = terms.max(axis=(1, 2))
    return np.asarray(top + np.log(np.sum(np.exp(terms - top[:, None, None]), axis=(1, 2))))


def _interval(mode: np.ndarray, reach: np.ndarray, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Half width and lower end of what is within ``reach`` of the mode and in [0, end]."""
    low, high = np.maximum(mode - reach, 0), np.minimum(mode + reach, end)
    return np.maximum(0.5 * (high - low), 1e-300), low


def importance(
    model: Model, data: Measurement, found: Fit, pixel: int, seed: int, draws: Parameters | None = None
) -> tuple[float, float]:
    """Log evidence of one pixel and its standard error.

    ``found``, and of ``draws`` (n,) those that are given, are where the search for the mixture begins. That does not
    bias the answer: whatever the mixture, the mean weight of its points is the integral. A part that no point reaches
    makes it too small, unseen by its error; long ridges have such parts, unless draws show the way.
    """
    prepared = prepare(model, data, model.noise.integrated)
    statistics = as_device(jax.tree.map(lambda x: x[0], prepared.pooled.take(np.array([pixel]))), np.complex128)
    centre, covariance = _start(model, found, pixel)
    target, rng = Target(model, statistics, centre, 16), np.random.default_rng([seed, pixel])
    root = np.linalg.cholesky(covariance)
    mixture: Any = (np.full(2, 0.5), np.stack([centre] * 2), np.stack([root, 2 * root]))
    every: list[np.ndarray] = []
    if draws is not None:
        every = [into_chart(model, centre, centre_of(model, draws)[:: max(len(draws.diattenuation) // POINTS, 1)], rng)]
        mixture = fit_mixture(every[0], 12, rng)
    for _ in range(ROUNDS):
        proposal = defended(target, mixture, 0.1)
        points, logs = _weighed(target, proposal, rng)
        # levelled weights: a few heavy points must not pull the mixture to themselves
        weight = np.exp(_temper(logs) - _temper(logs).max())
        every.append(points[rng.choice(len(points), size=len(points) // 8, p=weight / weight.sum())])
        # draws stay: a ridge's far end must not be forgotten because no point met it
        kept = every[-3:] if draws is None else [every[0], *every[1:][-2:]]
        mixture = fit_mixture(np.concatenate(kept), 12, rng)
    proposal = defended(target, mixture, 0.1)
    logs = np.concatenate([_weighed(target, proposal, rng)[1]
                           for _ in range(BATCHES)])  # fmt: skip
    top = logs.max()
    mean = np.exp(logs - top)
    return float(top + np.log(mean.mean())), float(mean.std() / (mean.mean() * len(mean) ** 0.5))


def _weighed(target: Target, proposal: Any, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points, and the logarithm of the density over that of the proposal."""
    points = proposal.draw(rng, POINTS)
    values, prior = target.evaluate(points)
    return points, values - proposal.log_density(points, prior)
