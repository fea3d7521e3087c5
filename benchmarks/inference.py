"""Speed against error of inferring five parameters a pixel: ``fit``, the closed form, and SciPy from many starts.

972 pixels (the size of the paper's frame), three balanced states, unit gain, default priors. Error: root mean square
of ||J_found - J_true||_F in units of the Cramer-Rao bound of the same; and how many pixels end more than 0.1 nat below
the best posterior density that any method found; both on the first 240 pixels, which SciPy's time allows.
"""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

import polinfer
from acquisition import elliptical_states
from benchmarks.results import Results, median_seconds
from polinfer import Measurement, Model, Parameters, RetarderFirst

PIXELS, SUBSET, STARTS = 972, 240, 8


def _scene(rng: np.random.Generator) -> Parameters:
    return Parameters(
        rng.uniform(0.1, 0.6, PIXELS),
        rng.uniform(-1.5, 1.5, PIXELS),
        rng.uniform(0.4, 2.7, PIXELS),
        rng.uniform(0.2, 1.3, PIXELS),
        rng.uniform(-0.6, 0.6, PIXELS),
    )


def _bound(truth: Parameters, illumination: np.ndarray, sigma: float) -> np.ndarray:
    """E||dJ||_F^2 of an efficient estimator, (pixels,): trace of G (G^T G)^-1 G^T in the metric of the data."""

    def fields(vector: jax.Array) -> jax.Array:
        values = (RetarderFirst().jones(Parameters(*vector)) @ illumination).ravel()
        return jnp.concatenate([values.real, values.imag])

    def elements(vector: jax.Array) -> jax.Array:
        values = RetarderFirst().jones(Parameters(*vector)).ravel()
        return jnp.concatenate([values.real, values.imag])

    points = jnp.stack([jnp.asarray(x) for x in truth], -1)
    data, jones = (np.asarray(jax.vmap(jax.jacfwd(f))(points)) for f in (fields, elements))
    fisher = 2 / sigma**2 * data.swapaxes(-1, -2) @ data
    return np.einsum("nij,njk,nik->n", jones, np.linalg.inv(fisher), jones)


def _scipy(model: Model, data: Measurement, sigma: float, starts: np.ndarray) -> np.ndarray:
    """Best of several L-BFGS-B runs with exact gradients, pixel by pixel."""

    def objective(vector: jax.Array, response: jax.Array) -> jax.Array:
        parameters = Parameters(*vector)
        seen = RetarderFirst().jones(parameters) @ data.illumination
        return jnp.sum(jnp.abs(seen - response) ** 2) / sigma**2 - model.log_prior(parameters)

    function = jax.jit(jax.value_and_grad(objective))
    bounds = [(-1 + 1e-9, 1 - 1e-9), (None, None), (-np.pi, np.pi), (None, None), (None, None)]
    found = []
    for response in data.response[:SUBSET]:
        runs = [
            scipy.optimize.minimize(
                lambda v, r=response: tuple(np.asarray(x, float) for x in function(v, r)), s, jac=True, bounds=bounds
            )
            for s in starts
        ]
        found.append(min(runs, key=lambda run: run.fun).x)
    return np.array(found).T


def main() -> None:
    """Print the table."""
    results = Results("inference")
    rng = np.random.default_rng(1)
    truth, states, model = _scene(rng), elliptical_states(3), Model()
    starts = np.stack([rng.uniform(-0.9, 0.9, STARTS), *rng.uniform(-1.5, 1.5, (4, STARTS))], -1)
    true = np.asarray(RetarderFirst().jones(truth))
    for sigma in (0.02, 0.1, 0.4):
        data = polinfer.simulate(model, truth, states, sigma, rng=2)
        jones = data.response @ np.linalg.pinv(states)
        begin = time.perf_counter()
        fitted = polinfer.fit(model, data)
        first = time.perf_counter() - begin
        begin = time.perf_counter()
        peer = Parameters(*_scipy(model, data, sigma, starts))
        peer_seconds = (time.perf_counter() - begin) / SUBSET
        closed = polinfer.decompose(jones, RetarderFirst())
        found = {
            "fit": (fitted.parameters, median_seconds(lambda d=data: polinfer.fit(model, d)) / PIXELS),
            "decompose": (
                closed,
                median_seconds(lambda j=jones: polinfer.decompose(j, RetarderFirst())) / PIXELS,
            ),
            f"SciPy L-BFGS, {STARTS} starts": (peer, peer_seconds),
        }
        small = Measurement(states, data.response[:SUBSET], sigma)
        first_pixels = {k: Parameters(*(np.asarray(x)[:SUBSET] for x in p)) for k, (p, _) in found.items()}
        density = {k: np.asarray(model.log_posterior(p, small)) for k, p in first_pixels.items()}
        best = np.max(list(density.values()), axis=0)
        bound = _bound(truth, states, sigma)
        for name, (_, seconds) in found.items():
            error = np.abs(np.asarray(RetarderFirst().jones(first_pixels[name])) - true[:SUBSET]) ** 2
            results.add(
                method=name,
                sigma=sigma,
                microseconds_a_pixel=1e6 * seconds,
                error_over_bound=float(np.sqrt(error.sum((-1, -2)).mean() / bound[:SUBSET].mean())),
                below_best_percent=float(100 * np.mean(density[name] < best - 0.1)),
                compile_seconds=first if name.startswith("fit") else float("nan"),
            )
    results.save(results.lines("microseconds_a_pixel", "error_over_bound", "method"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
