"""Is ``log_evidence`` the logarithm of the integral? Against quadrature of the written-out posterior in plain NumPy.

Where all Cramer-Rao bounds are below 0.1: a product Gauss-Hermite rule of 7^5 nodes in the axes of the local Gaussian,
every copy of the parameter set counted by its own prior; 5^5 nodes say how exact that is, and where it is not (near an
edge of D or eta) scrambled Sobol points take over. Beyond that, unit gain and balanced states: four dimensions where
the density is, and the circularity by a Bessel function (:mod:`benchmarks.quadrature`).
"""

from __future__ import annotations

from functools import cache
from itertools import product
from math import log, pi, sqrt

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

import polinfer
from benchmarks import scenes
from benchmarks.oracle import Oracle
from benchmarks.quadrature import nested
from benchmarks.results import Results
from polinfer import ComplexGain, Model, Parameters, PhaseGain, PolariserFirst, RetarderFirst

PIXELS, FULL, WIDE = 40, 400, 16
BAR = 0.05  # nat
SIGMAS = (0.005, 0.02, 0.05)
NODES = (5, 7)
SOBOL, WIDER = 15, 1.5
GAINS = {"unit": None, "phase": PhaseGain(), "complex": ComplexGain(1.0)}
BROAD = (0.02, 0.1, 0.2, 0.4)


@cache
def _product_rule(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Hermite nodes ``(5, count)`` and the logarithms of their weights over the Gaussian density."""
    x, w = np.polynomial.hermite_e.hermegauss(nodes)
    grid = np.array(np.meshgrid(*[x] * 5, indexing="ij")).reshape(5, -1)
    weight = np.array(np.meshgrid(*[np.log(w)] * 5, indexing="ij")).reshape(5, -1).sum(axis=0)
    return grid, weight + 0.5 * np.sum(grid**2, axis=0)


@cache
def _random_rule(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Scrambled Sobol points of a Gaussian half as wide again, and the logarithms of their weights."""
    points = WIDER * ndtri(qmc.Sobol(5, rng=np.random.default_rng(seed)).random_base2(SOBOL)).T
    return points, 0.5 * np.sum((points / WIDER) ** 2, axis=0) + 5 * log(WIDER * sqrt(2 * pi)) - SOBOL * log(2)


def _sum(
    oracle: Oracle,
    centre: np.ndarray,
    root: np.ndarray,
    rule: tuple[np.ndarray, np.ndarray],
    response: np.ndarray,
    illumination: np.ndarray,
    sigma: float,
) -> tuple[float, np.ndarray, np.ndarray]:
    """Log evidence, mean and covariance from nodes around a centre."""
    moved = centre[:, None] + root @ rule[0]
    point = np.concatenate([np.sin(moved[:1]), moved[1:]])
    cosine = np.cos(moved[0])
    inside = (np.abs(moved[0]) < pi / 2) & ((np.abs(point[2]) <= pi) | (oracle.gain != "unit"))
    # half of the eight copies have the circularity turned by pi
    opposite = np.concatenate([point[:4], point[4:] + pi])
    prior = log(4) + np.logaddexp(oracle.log_prior(point), oracle.log_prior(opposite))
    terms = oracle.log_likelihood(point, response, illumination, sigma) + prior + rule[1]
    terms = np.where(inside, terms + np.log(np.where(inside, cosine, 1)), -np.inf)
    top = terms.max()
    shares = np.exp(terms - top)
    total = shares.sum()
    mean = moved @ shares / total
    offset = moved - mean[:, None]
    return float(top + np.log(total) + np.log(np.diag(root)).sum()), mean, (offset * shares) @ offset.T / total


def local_quadrature(
    oracle: Oracle, maxima: Parameters, response: np.ndarray, illumination: np.ndarray, sigma: float
) -> np.ndarray:
    """Log evidence and its uncertainty ``(2, pixels)`` where the posterior is narrow: nodes around a maximum."""
    centres = np.stack([np.arcsin(maxima.diattenuation), *maxima[1:]])
    states = np.broadcast_to(illumination, (len(response), *illumination.shape))
    curvature = np.moveaxis(oracle._derivatives(centres, response, states, sigma)[1], -1, 0)
    found = []
    for centre, matrix, data in zip(centres.T, curvature, response, strict=True):
        values, axes = np.linalg.eigh(matrix)
        # on an edge of D the slope is not 0 and the curvature may be any
        root = np.linalg.cholesky((axes / np.maximum(np.abs(values), 1.0)) @ axes.T)
        few, more = (_sum(oracle, centre, root, _product_rule(n), data, illumination, sigma)[0] for n in NODES)
        uncertain = abs(more - few)
        if uncertain > BAR / 20:
            for k in (4, 5):  # towards the shape that the points themselves find
                _, centre, covariance = _sum(oracle, centre, root, _random_rule(k), data, illumination, sigma)
                root = np.linalg.cholesky(covariance)
            random = [_sum(oracle, centre, root, _random_rule(k), data, illumination, sigma)[0] for k in range(4)]
            more, uncertain = float(np.mean(random)), float(np.std(random, ddof=1) / 2)
        found.append((more, uncertain))
    return np.array(found).T


def narrow(results: Results, pixels: int) -> None:
    """Differences where all bounds are small."""
    rng, states = np.random.default_rng(2), scenes.balanced_states()
    for dtype in ("complex128", "complex64"):
        worst, exact = [], []
        for ordering, (gain, part), sigma in product((RetarderFirst(), PolariserFirst()), GAINS.items(), SIGMAS):
            model = Model(ordering, gain=part)
            truth = scenes.well_determined(model, pixels, states, sigma, rng)
            # at gain 1, where the bounds hold
            clean = scenes.measure(Model(ordering), truth, states, sigma, dtype, int(rng.integers(2**31)))
            found = polinfer.fit(model, clean).log_evidence
            oracle = Oracle(type(ordering).__name__, gain)
            seen, lit = clean.response.astype(complex), clean.illumination.astype(complex)
            # noise may have carried a pixel to where it is not well determined
            maxima = Parameters(*oracle.climb(np.array(truth), seen, lit, sigma)[0])
            small = np.max(polinfer.cramer_rao_bound(model, maxima, states, sigma), axis=0) < 0.1
            maxima = Parameters(*(x[small] for x in maxima))
            values, uncertain = local_quadrature(oracle, maxima, seen[small], lit, sigma)
            difference = np.abs(found[small] - values)
            results.add(dtype=dtype, ordering=type(ordering).__name__, gain=gain, sigma=sigma, pixels=len(values),
                        median=float(np.median(difference)), worst=float(difference.max()),
                        quadrature=float(uncertain.max()))  # fmt: skip
            worst.append(difference)
            exact.append(uncertain)
        every = np.concatenate(worst)
        print(f"  {dtype}: 99.9 % of pixels within {np.quantile(every, 0.999):.3g} nat")
        results.bar(f"{dtype}, all bounds < 0.1: log evidence off by at most", every.max(), BAR, "nat")
        results.bar("  the same of the quadrature", np.concatenate(exact).max(), BAR / 5, "nat")


def wide(results: Results, pixels: int) -> None:
    """Differences where some bounds are larger."""
    rng, states = np.random.default_rng(3), scenes.balanced_states()
    for sigma, ordering in product(BROAD, (RetarderFirst(), PolariserFirst())):
        model = Model(ordering)
        truth = scenes.from_priors(model, pixels, rng)
        data = scenes.measure(model, truth, states, sigma, rng=int(rng.integers(2**31)))
        result = polinfer.fit(model, data)
        oracle = Oracle(type(ordering).__name__, "unit")
        whole = np.array([nested(oracle, v, states, sigma) for v in data.response])
        coarse = [nested(oracle, v, states, sigma, 0.8) for v in data.response[:4]]
        difference = result.log_evidence - whole
        largest = np.max(polinfer.cramer_rao_bound(model, truth, states, sigma), axis=0)
        for low, high in ((0, 0.1), (0.1, 0.3), (0.3, 1), (1, np.inf)):
            own = difference[(largest >= low) & (largest < high)]
            if len(own):
                results.add(sigma=sigma, ordering=type(ordering).__name__, largest_bound=f"{low:g} to {high:g}",
                            pixels=len(own), median=float(np.median(own)), worst=float(np.abs(own).max()),
                            coarser_grid=float(np.abs(coarse - whole[:4]).max()))  # fmt: skip


def main(size: int | None = None, full: bool = False) -> None:
    """Print the table."""
    from matplotlib.figure import Figure

    results = Results("evidence")
    narrow(results, size or (FULL if full else PIXELS))
    wide(results, min(size or WIDE, WIDE) if not full else 4 * WIDE)
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    rows = [row for row in results.rows if "largest_bound" in row]
    groups = list(dict.fromkeys(row["largest_bound"] for row in rows))
    for sigma in BROAD:
        own = [row for row in rows if row["sigma"] == sigma and row["ordering"] == "RetarderFirst"]
        axes.semilogy([groups.index(row["largest_bound"]) for row in own], [row["worst"] for row in own], "o-",
                      label=f"sigma {sigma}")  # fmt: skip
    axes.axhline(BAR, color="k", lw=0.8)
    axes.set_xticks(range(len(groups)), groups)
    axes.set(xlabel="largest Cramer-Rao bound of a pixel (rad; D: 1)", ylabel="worst error of log evidence (nat)")
    axes.legend(fontsize=8)
    results.save(figure)


if __name__ == "__main__":
    main()
