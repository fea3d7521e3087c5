"""Would a mean-field variational posterior do at high noise? The best product of five densities against Gibbs draws.

Unit gain, balanced states, default priors. The log likelihood is linear in each of the unit vectors of the angles
``y = (delta/2, 2 theta_D, eta/2, 2 theta_eta, xi)``, so the factor of one angle, given the mean vectors of the others,
is ``exp(b cos y + c sin y)`` times its prior: computed here on a grid, exactly, one after the other until nothing
changes. The best of several starts (the maximum, and others at random) by its bound on the evidence. Truths from the
priors: do central intervals of functions that the equivalent sets share hold the truth as often as they say, how wide
are they beside those of the posterior, and how far is the bound from the evidence? ``Gibbs`` and the local Gaussian of
``fit`` beside it.
"""

from __future__ import annotations

import numpy as np

import polinfer
from benchmarks import scenes
from benchmarks.oracle import Oracle
from benchmarks.quadrature import UNITS, nested
from benchmarks.results import Results
from polinfer import Gibbs, Model, Parameters
from polinfer.sampling.invariants import invariants

SIGMAS = (0.05, 0.2, 0.4)
NODES, SWEEPS, STARTS, DRAWS = 512, 200, 4, 2000
STILL = 1e-4  # change of the mean vectors in a sweep
PIECES = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, -1], [-1, 0]]])


class Product:
    """Factors of the five angles on grids of midpoints, ``(5, pixels, NODES)``, and their bound on the evidence."""

    def __init__(self, response: np.ndarray, illumination: np.ndarray, sigma: float, start: np.ndarray) -> None:
        n = illumination.shape[-1]
        data = response @ illumination.conj().T
        pieces = PIECES[:, None] @ UNITS[None]
        self.linear = 2 / sigma**2 * np.einsum("abij,pij->pab", pieces.conj(), data).real
        self.constant = -2 * n * np.log(np.pi * sigma**2) - (np.sum(np.abs(response) ** 2, axis=(1, 2)) + n) / sigma**2
        reach = np.array([0.25, 1.0, 0.5, 1.0, 1.0]) * np.pi
        self.nodes = reach[:, None] * ((np.arange(NODES) + 0.5) / NODES * 2 - 1)
        self.step = 2 * reach / NODES
        oracle = Oracle("RetarderFirst", "unit")
        d, xi = np.sin(2 * self.nodes[0]), self.nodes[4]
        # densities in y: dD = 2 cos(delta) dy, dtheta = dy / 2, deta = 2 dy
        self.prior = np.zeros((5, NODES))
        self.prior[0] = oracle.log_prior((d, 0, 0, 0, np.pi / 2)) + np.log(2 * np.cos(2 * self.nodes[0])) - np.log(2)
        self.prior[4] = np.cos(xi)
        self.mean = np.stack([np.cos(start), np.sin(start)], axis=-1)  # (5, pixels, 2)
        self.log_density = np.zeros((5, len(response), NODES))
        self.sweeps = np.zeros(len(response))

    def run(self) -> np.ndarray:
        """Coordinate ascent; the bound on the log evidence, (pixels,), of the eight copies as if they were apart."""
        for _ in range(SWEEPS):
            before = self.mean.copy()
            for i in range(5):
                self._update(i)
            moving = np.max(np.abs(self.mean - before), axis=(0, 2)) > STILL
            self.sweeps += moving
            if not moving.any():
                break
        total = self.constant + np.einsum("pa,pab,pb->p", self._polariser(), self.linear, self._retarder())
        for i in range(5):
            density = np.exp(self.log_density[i])
            total = total + self.step[i] * np.sum(density * (self.prior[i] - self.log_density[i]), axis=1)
        # four copies have the circularity turned by pi, and the prior that is there
        return np.asarray(total + np.log(4) + np.log1p(np.exp(-2 * self.mean[4, :, 0])))

    def _polariser(self) -> np.ndarray:
        (c0, s0), (c1, s1) = (m.T for m in self.mean[:2])
        return np.stack([c0, s0 * c1, s0 * s1], axis=1)

    def _retarder(self) -> np.ndarray:
        (c2, s2), (c3, s3), (c4, s4) = (m.T for m in self.mean[2:])
        return np.stack([c2, s2 * c3, s2 * s3 * c4, s2 * s3 * s4], axis=1)

    def _update(self, i: int) -> None:
        slopes = []
        for unit in ((1.0, 0.0), (0.0, 1.0)):  # what multiplies cos y and sin y
            kept = self.mean[i].copy()
            self.mean[i] = unit
            slopes.append(np.einsum("pa,pab,pb->p", self._polariser(), self.linear, self._retarder()))
            self.mean[i] = 0.0
            slopes[-1] -= np.einsum("pa,pab,pb->p", self._polariser(), self.linear, self._retarder())
            self.mean[i] = kept
        wave = np.stack([np.cos(self.nodes[i]), np.sin(self.nodes[i])])
        logs = np.stack(slopes, axis=1) @ wave + self.prior[i]
        logs -= logs.max(axis=1, keepdims=True)
        density = np.exp(logs)
        size = density.sum(axis=1, keepdims=True) * self.step[i]
        self.log_density[i] = logs - np.log(size)
        self.mean[i] = (density / size * self.step[i]) @ wave.T

    def draw(self, rng: np.random.Generator, count: int) -> Parameters:
        """Draws ``(count, pixels)``."""
        found = []
        for i in range(5):
            steps = np.cumsum(np.exp(self.log_density[i]), axis=1)
            u = rng.uniform(size=(count, len(steps)))
            place = np.stack([np.searchsorted(s, v * s[-1]) for s, v in zip(steps, u.T, strict=True)], axis=1)
            found.append(self.nodes[i][np.minimum(place, NODES - 1)] + self.step[i] * rng.uniform(-0.5, 0.5, u.shape))
        return Parameters(np.sin(2 * found[0]), 0.5 * found[1], 2 * found[2], 0.5 * found[3], found[4])


def best_product(
    response: np.ndarray, states: np.ndarray, sigma: float, fit: polinfer.Fit, rng: np.random.Generator
) -> tuple[Parameters, np.ndarray, np.ndarray]:
    """Draws from the best of several starts, its bound, and the sweeps that the first start took."""
    p = fit.parameters
    angles = np.stack([0.5 * np.arcsin(p.diattenuation), 2 * p.diattenuation_angle, 0.5 * p.retardance,
                       2 * p.retardance_angle, p.circularity])  # fmt: skip
    bound, kept, sweeps = np.full(len(response), -np.inf), np.zeros((5, DRAWS, len(response))), np.zeros(0)
    for number in range(STARTS):
        start = angles if number == 0 else rng.uniform(-1, 1, angles.shape) * np.array([[0.8, 3, 1.5, 3, 3]]).T
        product = Product(response, states, sigma, start)
        value, draws = product.run(), np.stack(product.draw(rng, DRAWS))
        sweeps = product.sweeps if number == 0 else sweeps
        better = value > bound
        bound[better], kept[..., better] = value[better], draws[..., better]
    return Parameters(*kept), bound, sweeps


def main(size: int | None = None) -> None:
    """Print the table; ``size`` is the number of pixels."""
    results, states, pixels, model = Results("variational"), scenes.balanced_states(), size or 300, Model()
    for number, sigma in enumerate(SIGMAS):
        rng = np.random.default_rng(number)
        truth = scenes.from_priors(model, pixels, rng)
        data = scenes.measure(model, truth, states, sigma, rng=number)
        fit = polinfer.fit(model, data)
        product, bound, sweeps = best_product(data.response, states, sigma, fit, rng)
        gibbs = polinfer.sample(model, data, Gibbs(evidence=False), draws=DRAWS // 4, rng=3).parameters
        gaussian = np.moveaxis(np.array(fit.parameters), 0, -1)[None] + np.einsum(
            "pij,npj->npi", _root(fit.covariance), rng.normal(size=(DRAWS, pixels, 5))
        )
        several = {
            "Gibbs": Parameters(*(np.asarray(x).reshape(-1, pixels) for x in gibbs)),
            "best product": product,
            "fit's Gaussian": Parameters(np.clip(gaussian[..., 0], -1, 1), *np.moveaxis(gaussian[..., 1:], -1, 0)),
        }
        true = np.stack([np.asarray(x) for x in invariants(model, truth).values()])
        oracle = Oracle("RetarderFirst", "unit")
        exact = np.array([nested(oracle, v, states, sigma) for v in data.response[:40]])
        low = {"best product": exact - bound[:40], "fit's Gaussian": exact - fit.log_evidence[:40]}
        widths = {}
        for name, draws in several.items():
            values = np.stack([np.asarray(x) for x in invariants(model, draws).values()])
            rank = np.mean(values < true[:, None], axis=1)
            widths[name] = values.std(axis=1)
            ratio = widths[name] / widths["Gibbs"]
            gap = low.get(name, np.zeros(1))
            results.add(
                sigma=sigma, posterior=name, pixels=pixels,
                **{f"inside_{100 * k:.0f}": float(np.mean(np.abs(rank - 0.5) < 0.5 * k)) for k in (0.68, 0.95)},
                width_median=float(np.median(ratio)), width_lowest_tenth=float(np.quantile(ratio, 0.1)),
                evidence_low_median=float(np.median(gap)), evidence_low_worst=float(gap[np.argmax(np.abs(gap))]),
            )  # fmt: skip
        print(f"  sweeps from the maximum: median {np.median(sweeps):.0f}, worst tenth {np.quantile(sweeps, 0.9):.0f}")
    results.save()


def _root(covariance: np.ndarray) -> np.ndarray:
    """Square roots of matrices that may have no full rank."""
    values, axes = np.linalg.eigh(np.nan_to_num(covariance))
    return np.asarray(axes * np.sqrt(np.maximum(values, 0))[..., None, :])


if __name__ == "__main__":
    main()
