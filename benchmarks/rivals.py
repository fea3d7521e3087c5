"""Everybody who can infer five parameters a pixel, made to answer the same question for :mod:`benchmarks.peers`.

The scene: three balanced states, unit gain, default priors. Each contestant takes the data and gives parameters,
matrices and times. Optimisers of others start from 8 random points, in angles in which the matrix is smooth, with exact
Jacobians. Samplers answer with the posterior mean of J, and with their densest draw where parameters are asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from threadpoolctl import threadpool_limits

import polinfer
from benchmarks import scenes
from benchmarks.oracle import Oracle
from benchmarks.results import seconds
from polinfer import Measurement, Model, Parameters

PIXELS, SIZES, CHECKED = 64, (64, 972, 1_000_000), 20_000
STARTS = 8
REPEATS, SLOW_REPEATS = 5, 2
WALKERS, STEPS = 32, 1000
WARMUP, DRAWS, DEPTH = 300, 500, 7
MODEL = Model()
REACH = np.array([np.pi / 2, np.inf, np.pi, np.inf, np.inf])  # of delta (D = sin delta), ..., eta, ...


@dataclass(frozen=True)
class Scene:
    """Data of one noise level, and random starts ``(STARTS, 5)`` in delta, theta_D, eta, theta_eta, xi."""

    truth: Parameters
    data: Measurement
    sigma: float
    starts: np.ndarray

    def first(self, count: int = PIXELS) -> Measurement:
        """The data of the first pixels, by default of those that everybody is judged on."""
        return Measurement(self.data.illumination, self.data.response[:count], self.data.sigma)


@dataclass(frozen=True)
class Answer:
    """Parameters ``(5, checked)``, their matrices ``(checked, 2, 2)``, and seconds a pixel of every call."""

    pixels: int
    points: np.ndarray
    jones: np.ndarray
    times: np.ndarray
    compiling: float = np.nan
    effective: float = np.nan  # sample size of the first element of J, median over pixels


def _answer(pixels: int, points: Any, times: Any, compiling: float = np.nan) -> Answer:
    points = np.array([np.asarray(x, float).reshape(-1)[:CHECKED] for x in points])
    return Answer(pixels, points, scenes.jones(MODEL, Parameters(*points)), np.atleast_1d(times), compiling)


# --- the posterior as others are given it


def _matrix(angles: jax.Array) -> jax.Array:
    """J of delta, theta_D, eta, theta_eta, xi: a product of two matrices without any square root."""
    delta, td, eta, te, xi = angles
    c, s = jnp.cos(delta / 2), jnp.sin(delta / 2)
    cosine, sine = s * jnp.cos(2 * td), s * jnp.sin(2 * td)
    polariser = jnp.array([[c + cosine, -sine], [-sine, c - cosine]])
    c, s = jnp.cos(eta / 2), 1j * jnp.sin(eta / 2)
    along, across = s * jnp.cos(2 * te), -s * jnp.sin(2 * te)
    retarder = jnp.array([[c + along, across * jnp.exp(-1j * xi)], [across * jnp.exp(1j * xi), c - along]])
    return polariser @ retarder


def _residuals(angles: jax.Array, response: jax.Array, sigma: Any) -> jax.Array:
    """Of which half the sum of squares is minus the log posterior and a constant: data, priors of D and of xi."""
    off = ((_matrix(angles) @ scenes.balanced_states() - response) * jnp.sqrt(2) / sigma).ravel()
    priors = jnp.array([2 * jnp.sin(angles[0]), 2 * jnp.sin(angles[4] / 2)])
    return jnp.concatenate([off.real, off.imag, priors])


def _fold(free: Any, module: Any = np) -> Any:
    """Angles of unbounded ones: ``x = c sin u`` where x is bounded."""
    bounded = np.isfinite(REACH)
    return module.where(bounded, np.where(bounded, REACH, 1) * module.sin(free), free)


def _unfold(angles: np.ndarray) -> np.ndarray:
    bounded = np.isfinite(REACH)
    return np.where(bounded, np.arcsin(np.where(bounded, angles / REACH, 0)), angles)


def _folded_residuals(free: jax.Array, response: jax.Array, sigma: Any) -> jax.Array:
    return _residuals(_fold(free, jnp), response, sigma)


def _points(angles: Any) -> np.ndarray:
    """Parameters ``(5, pixels)`` of angles ``(pixels, 5)``."""
    angles = np.asarray(angles).T
    return np.concatenate([np.sin(angles[:1]), angles[1:]])


# --- the contestants: each takes a scene and gives its answers, one for each number of pixels


def fit(scene: Scene) -> list[Answer]:
    """polinfer.fit: maximum, covariance and evidence."""
    return _polinfer(scene, lambda data: polinfer.fit(MODEL, data).parameters)


def decompose(scene: Scene) -> list[Answer]:
    """polinfer.decompose of the data times the pseudo-inverse of the states."""
    inverse = np.linalg.pinv(scene.data.illumination)
    answers = _polinfer(scene, lambda data: polinfer.decompose(data.response @ inverse, MODEL.ordering))
    # the closed form leaves the phase open, and with it the sign of J
    return [replace(answer, jones=_signed(answer.jones, scene.data.response @ inverse)) for answer in answers]


def _signed(jones: np.ndarray, like: np.ndarray) -> np.ndarray:
    overlap = np.sum((jones.conj() * like[: len(jones)]).real, axis=(-1, -2))
    return jones * np.sign(overlap)[:, None, None]


def _polinfer(scene: Scene, call: Callable[[Measurement], Parameters]) -> list[Answer]:
    found = []
    for pixels in (size for size in SIZES if size <= len(scene.data.response)):
        data = scene.first(pixels)
        kept: list[Parameters] = []
        times = np.array([seconds(lambda d=data, k=kept: k.append(call(d))) for _ in range(1 + REPEATS)])
        found.append(_answer(pixels, kept[-1], times[1:] / pixels, max(0, times[0] - np.median(times[1:]))))
    return found


def scipy_lm(scene: Scene) -> list[Answer]:
    """scipy.optimize.least_squares, Levenberg-Marquardt of MINPACK."""
    return _least_squares(scene, _folded_residuals, _fold, _unfold(scene.starts), method="lm")


def scipy_trf(scene: Scene) -> list[Answer]:
    """scipy.optimize.least_squares, trust region reflective, with bounds."""
    return _least_squares(scene, _residuals, np.asarray, scene.starts, method="trf", bounds=(-REACH, REACH))


def _least_squares(scene: Scene, residuals: Any, angles: Any, starts: np.ndarray, **options: Any) -> list[Answer]:
    function, jacobian = jax.jit(residuals), jax.jit(jax.jacfwd(residuals))

    def pixel(response: np.ndarray) -> np.ndarray:
        given = (response, scene.sigma)
        runs = [
            scipy.optimize.least_squares(
                lambda x: np.asarray(function(x, *given)), x, lambda x: np.asarray(jacobian(x, *given)), **options
            )
            for x in starts
        ]
        return angles(min(runs, key=lambda run: run.cost).x)

    return [_one_by_one(scene, pixel)]


def scipy_lbfgs(scene: Scene) -> list[Answer]:
    """scipy.optimize.minimize, L-BFGS-B, with bounds."""
    function = jax.jit(jax.value_and_grad(lambda x, *given: 0.5 * jnp.sum(_residuals(x, *given) ** 2)))

    def pixel(response: np.ndarray) -> np.ndarray:
        def value_and_slope(x: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = function(x, response, scene.sigma)
            return float(value), np.asarray(slope)

        bounds = list(zip(-REACH, REACH, strict=True))
        runs = [
            scipy.optimize.minimize(value_and_slope, x, jac=True, method="L-BFGS-B", bounds=bounds)
            for x in scene.starts
        ]
        return min(runs, key=lambda run: run.fun).x

    return [_one_by_one(scene, pixel)]


def _one_by_one(scene: Scene, pixel: Callable[[np.ndarray], np.ndarray]) -> Answer:
    responses = scene.first().response
    compiling = seconds(lambda: pixel(responses[0]))
    found: list[np.ndarray] = []
    with threadpool_limits(1):  # threads that wait for each other slow down five unknowns
        times = np.array([seconds(lambda r=response: found.append(pixel(r))) for response in responses])
    return _answer(len(responses), _points(found), times, max(0, compiling - times[0]))


def optimistix(scene: Scene) -> list[Answer]:
    """optimistix.least_squares, Levenberg-Marquardt: one call, starts vmapped, a loop over pixels.

    With the pixels vmapped as well all of them wait for the slowest one, which takes longer.
    """
    import optimistix as optx

    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)  # the tolerances of SciPy's
    starts = jnp.asarray(_unfold(scene.starts))

    def one(start: jax.Array, response: jax.Array, sigma: jax.Array) -> tuple[jax.Array, jax.Array]:
        solution = optx.least_squares(
            lambda x, given: _folded_residuals(x, *given), solver, start, (response, sigma), throw=False, max_steps=256
        )
        return solution.value, jnp.sum(_folded_residuals(solution.value, response, sigma) ** 2)

    def pixel(response: jax.Array, sigma: jax.Array) -> jax.Array:
        values, costs = jax.vmap(one, (0, None, None))(starts, response, sigma)
        return _fold(values[jnp.nanargmin(costs)], jnp)

    answers = []
    for pixels in (size for size in SIZES[:2] if size <= len(scene.data.response)):
        responses = jnp.asarray(scene.first(pixels).response)
        function, compiling = _compiled(lambda r, s: jax.lax.map(lambda x: pixel(x, s), r), responses, scene.sigma)
        kept: list[Any] = []
        times = np.array([seconds(lambda f=function, k=kept: k.append(f())) for _ in range(1 + SLOW_REPEATS)])
        answers.append(_answer(pixels, _points(kept[-1]), times[1:] / pixels, compiling))
    return answers


def _compiled(function: Any, *arguments: Any) -> tuple[Callable[[], Any], float]:
    """The call of a function with arguments, until its result is there, and how long its compiling took."""
    jitted, kept = jax.jit(function), []
    compiling = seconds(lambda: kept.append(jitted.lower(*arguments).compile()))
    return lambda: jax.block_until_ready(kept[0](*arguments)), compiling


def numpyro_nuts(scene: Scene) -> list[Answer]:
    """NumPyro's no-U-turn sampler, one chain a pixel, all pixels in one vmap; angles without bounds on the line."""
    import numpyro
    from numpyro import distributions as dist
    from numpyro.infer import MCMC, NUTS

    line = dist.ImproperUniform(dist.constraints.real, (), ())

    def probability(response: jax.Array, sigma: jax.Array) -> None:
        d = numpyro.sample("d", dist.Uniform(-1, 1))
        eta = numpyro.sample("eta", dist.Uniform(-jnp.pi, jnp.pi))
        td, te, xi = (numpyro.sample(name, line) for name in ("td", "te", "xi"))
        angles = jnp.stack([jnp.arcsin(d), td, eta, te, xi])
        numpyro.deterministic("angles", angles)
        numpyro.factor("density", -0.5 * jnp.sum(_residuals(angles, response, sigma) ** 2))

    def chain(key: jax.Array, response: jax.Array, sigma: jax.Array) -> jax.Array:
        sampler = NUTS(probability, max_tree_depth=DEPTH)
        run = MCMC(sampler, num_warmup=WARMUP, num_samples=DRAWS, progress_bar=False)
        run.run(key, response, sigma)
        return run.get_samples()["angles"]

    responses = jnp.asarray(scene.first().response)
    keys = jax.random.split(jax.random.key(1), len(responses))
    function, compiling = _compiled(jax.vmap(chain, (0, 0, None)), keys, responses, scene.sigma)
    kept: list[Any] = []
    time = seconds(lambda: kept.append(function()))
    draws = _points(np.moveaxis(np.asarray(kept[0]), 0, 1).reshape(-1, 5)).reshape(5, DRAWS, 1, -1)
    return [_of_draws(scene, draws, time / len(responses), compiling)]


def emcee_ensemble(scene: Scene) -> list[Answer]:
    """emcee, pixel by pixel, walkers started around the densest of 2000 draws from the prior, in one NumPy call."""
    import emcee

    oracle, responses, rng = Oracle("RetarderFirst", "unit"), scene.first().response, np.random.default_rng(6)
    prior = np.array(scenes.from_priors(MODEL, 2000, rng)).T
    high = np.array([1, np.inf, np.pi, np.inf, np.inf])

    def pixel(response: np.ndarray) -> np.ndarray:
        def density(points: np.ndarray) -> np.ndarray:
            inside = np.all(np.abs(points) <= high, axis=-1)
            return np.where(
                inside, oracle.log_posterior(points.T, response, scene.data.illumination, scene.sigma), -np.inf
            )

        best = prior[np.argmax(density(prior))]
        start = np.clip(best + scene.sigma * rng.normal(size=(WALKERS, 5)), -0.999 * high, 0.999 * high)
        sampler = emcee.EnsembleSampler(WALKERS, 5, density, vectorize=True)
        sampler.random_state = np.random.RandomState(7).get_state()
        sampler.run_mcmc(start, STEPS)
        return sampler.get_chain(discard=STEPS // 2)

    kept: list[np.ndarray] = []
    times = np.array([seconds(lambda r=response: kept.append(pixel(r))) for response in responses])
    return [_of_draws(scene, np.moveaxis(np.array(kept), (3, 0), (0, 3)), times)]


def _of_draws(scene: Scene, draws: np.ndarray, times: Any, compiling: float = np.nan) -> Answer:
    """The mean matrix and the densest of draws ``(5, steps, walkers, pixels)``."""
    from emcee.autocorr import integrated_time

    matrices = scenes.jones(MODEL, Parameters(*draws))
    flat = draws.reshape(5, -1, draws.shape[-1])
    best = np.argmax(density(scene, flat), axis=0)
    steps = draws.shape[1] * draws.shape[2]
    first = matrices[..., 0, 0].real
    with np.errstate(invalid="ignore"):  # a walker that never moved
        size = [steps / integrated_time(first[..., i], quiet=True, tol=0)[0] for i in range(first.shape[-1])]
    points = flat[:, best, np.arange(flat.shape[-1])]
    mean = matrices.mean(axis=(0, 1))
    return Answer(len(mean), points, mean, np.atleast_1d(times), compiling, float(np.nanmedian(size)))


def density(scene: Scene, points: np.ndarray) -> np.ndarray:
    """The oracle's log posterior of parameters ``(5, ..., pixels)``."""
    data = scene.first()
    with np.errstate(invalid="ignore"):
        return Oracle("RetarderFirst", "unit").log_posterior(points, data.response, data.illumination, scene.sigma)


CONTESTANTS: dict[str, Callable[[Scene], list[Answer]]] = {
    "fit": fit,
    "decompose": decompose,
    "optimistix LM": optimistix,
    "SciPy LM": scipy_lm,
    "SciPy TRF": scipy_trf,
    "SciPy L-BFGS-B": scipy_lbfgs,
    "NumPyro NUTS": numpyro_nuts,
    "emcee": emcee_ensemble,
}
