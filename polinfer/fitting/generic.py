"""``fit`` for any ordering and any priors."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import gammaincc

from ..checks import one_of_types
from ..degeneracy import REFERENCE, nearest, reduce_ranges
from ..elements import multiply
from ..model import Model, as_device
from ..records import Fit, Measurement, Parameters, Status
from ..statistics import TRAILING, Statistics, Summary, summarise
from .charts import from_parameters, to_parameters
from .edges import integrate
from .local_gaussian import Local, describe, equivalent, log_density, uniform_std
from .newton import maximise
from .start import starts

__all__ = ["fit"]

CHUNK = 2048  # pixels whose starting points are in memory at once
ITERATIONS = 60
BAD_FIT_PROBABILITY = 1e-3


class _Best(NamedTuple):
    parameters: Parameters
    value: np.ndarray
    converged: np.ndarray


def _canonical(model: Model, parameters: Parameters, statistics: Statistics) -> Parameters:
    """Of the equivalent copies with the highest density, the one nearest to the reference."""
    copies = equivalent(model, parameters)
    prior = np.asarray(model.log_prior(copies))
    likelihood = np.asarray(log_density(model, copies, statistics)) - np.where(np.isfinite(prior), prior, 0)
    likelihood = np.where(np.isnan(likelihood), -np.inf, likelihood)
    # Likelihoods of copies differ by rounding only, eps times the signal-to-noise ratio, unless an ordering of the
    # user's own breaks the symmetry.
    strength = np.sqrt(np.sum(np.abs(np.asarray(statistics.illumination)) ** 2, axis=(-1, -2)))
    rounding = 30 * np.finfo(prior.dtype).eps * (1 + strength)
    highest = likelihood.max(axis=0)
    density = prior + np.where(likelihood >= highest - rounding, highest, likelihood)
    slack = 1e-6 if density.dtype == np.float64 else 1e-3
    allowed = density >= density.max(axis=0) - slack
    return nearest(copies, Parameters(*(np.asarray(x, density.dtype) for x in REFERENCE)), allowed)


def _search(model: Model, host: Statistics, statistics: Statistics, earlier: Parameters | None, count: int) -> _Best:
    """Most probable parameters of every pixel of a chunk."""
    dtype = np.asarray(statistics.residual).dtype
    points = starts(model, host, statistics, earlier, count).astype(dtype)
    pixels, number, free = points.shape
    index = np.repeat(np.arange(pixels), number)
    found, value, _ = maximise(model, statistics, index, points.reshape(-1, free), ITERATIONS)
    value = np.where(np.isnan(value), -np.inf, value).reshape(pixels, number)
    best = found.reshape(pixels, number, free)[np.arange(pixels), value.argmax(axis=1)]
    parameters = _canonical(model, _arrays(model, best), statistics)
    # another copy may have the better prior, and then its maximum is close by
    polished, top, converged = maximise(
        model, statistics, np.arange(pixels), from_parameters(model, parameters).astype(dtype), ITERATIONS
    )
    return _Best(_canonical(model, _arrays(model, polished), statistics), top, converged)


def _arrays(model: Model, coordinates: np.ndarray) -> Parameters:
    return reduce_ranges(model.complete(to_parameters(model, jnp.asarray(coordinates))))


@partial(jax.jit, static_argnums=0)
def _residual(model: Model, parameters: Parameters, statistics: Statistics) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Log posterior, chi-square at the most probable gain, and the mean gain."""
    seen, gain = multiply(model.jones(parameters), statistics.illumination), model.known_gain
    rest = gain.best(seen, statistics.response)[..., None, None] * seen - statistics.response
    chi_square = 2 * (jnp.sum(jnp.abs(rest) ** 2, axis=(-1, -2)) + statistics.residual)
    return model.log_density(parameters, statistics), chi_square, gain.mean(seen, statistics.response)


def _on_bounds(model: Model, parameters: Parameters, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels lie on the lower and on the upper bound of a parameter."""
    value, (low, high) = np.asarray(getattr(parameters, name)), model.bounds[name]
    near = (1e-9 if value.dtype == np.float64 else 1e-5) * (high - low)
    return value <= low + near, value >= high - near


def _correct_edges(model: Model, parameters: Parameters, statistics: Statistics, local: Local) -> Local:
    """Replace the Gaussian where the maximum is on a bound, and its evidence also where a bound is near."""
    for name, (low, high) in model.bounds.items():
        k, value = model.free.index(name), np.asarray(getattr(parameters, name))
        with np.errstate(invalid="ignore"):
            reach = 3 * np.nan_to_num(np.sqrt(local.covariance[:, k, k]))
        on_low, on_high = _on_bounds(model, parameters, name)
        # a width comparable to the range says that no bound is special
        reach = np.where(reach < high - low, reach, 0)
        on_bound = on_low | on_high
        chosen = np.flatnonzero(on_bound | (value < low + reach) | (value > high - reach))
        if len(chosen) == 0:
            continue
        padded = np.concatenate([chosen, np.full((1 << (len(chosen) - 1).bit_length()) - len(chosen), chosen[0])])
        edge = integrate(
            model,
            name,
            (value > 0.5 * (low + high))[padded],
            Parameters(*(np.asarray(x)[padded] for x in parameters)),
            Statistics(*(np.asarray(x)[padded] for x in statistics)),
        )
        better = edge.log_evidence[: len(chosen)]
        local.log_evidence[chosen] = np.where(np.isfinite(better), better, local.log_evidence[chosen])
        replace = chosen[on_bound[chosen]]
        local.covariance[replace] = edge.moments[: len(chosen)][on_bound[chosen]]
        spread = np.sqrt(np.einsum("...ii->...i", local.covariance[replace]))
        local.unidentified[replace] = spread > 0.5 * np.array([uniform_std(other) for other in model.free])
    return local


def _flat(values: np.ndarray, shape: tuple[int, ...], trailing: int, chosen: np.ndarray) -> np.ndarray:
    tail = values.shape[values.ndim - trailing :] if trailing else ()
    return np.broadcast_to(values, shape + tail).reshape(-1, *tail)[chosen]


def fit(model: Model, measurement: Measurement, start: Fit | None = None, progress: bool = False) -> Fit:
    """The most probable parameters of every pixel, with a local Gaussian around them.

    Maximises ``log p(data | parameters) + log p(parameters)``, the density in D, theta_D, eta, theta_eta, xi (radians),
    with the gain integrated out; every pixel on its own, by Newton steps from several starts. Of the equivalent
    parameter sets with the highest density the canonical one is reported (:func:`polinfer.canonicalise`). Nothing is
    random. The precision is that of the measurement: complex64 data give float32 results; complex128 data give float64
    results where JAX has double precision enabled (``jax.config.update("jax_enable_x64", True)``), else float32.

    Parameters
    ----------
    model: the scene. measurement: the data, pixel shape P; it must know sigma.
    start: an earlier fit of the same pixel shape and similar data (a video): its parameters are tried first and fewer
        other starts are needed.
    progress: show a progress bar.

    Returns
    -------
    Fit, arrays of shape P. Masked pixels and those with a response that is not finite are NaN and flagged.

    Raises
    ------
    ValueError: no sigma, a start of another shape, nothing free to fit. TypeError: arguments of a wrong kind.

    Notes
    -----
    Standard deviations come from the curvature at the maximum. On a bound (``Status.AT_EDGE``) the density is not a
    Gaussian there.

    Source: Gordon et al., supplementary information, inference of polarimetric parameters; Laplace approximation.

    >>> import polinfer
    >>> truth = polinfer.Parameters(0.3, 0.5, 1.2, 0.4, 0.2)
    >>> states = np.array([[1, 1, 1], [1, 1j, -1]]) / 2**0.5
    >>> data = polinfer.simulate(polinfer.Model(), truth, states, sigma=0.01, rng=1)
    >>> result = polinfer.fit(polinfer.Model(), data)
    >>> int(result.status), bool(abs(result.parameters.retardance - 1.2) < 5 * result.std.retardance)
    (0, True)
    """
    one_of_types("model", model, (Model,), "pass Model(...).")
    one_of_types("measurement", measurement, (Measurement,), "pass a Measurement.")
    shape = measurement.shape
    if start is not None:
        one_of_types("start", start, (Fit,), "pass an earlier Fit or None.")
        if start.status.shape != shape:
            raise ValueError(f"start has pixel shape {start.status.shape} and measurement {shape}; they must agree.")
    if not model.free:
        raise ValueError("model has no free parameter to fit; fix fewer of them.")
    sigma = model.noise.sigma(measurement)
    summary = summarise(measurement, sigma)
    good = np.flatnonzero(~(summary.masked | summary.non_finite).reshape(-1))
    host = Statistics(*(_flat(x, shape, t, good) for x, t in zip(summary.statistics, TRAILING, strict=True)))
    earlier = None
    if start is not None:
        earlier = Parameters(*(_flat(np.asarray(x), shape, 0, good) for x in start.parameters))
    chunks = range(0, len(good), CHUNK)
    if progress:
        from tqdm import tqdm

        chunks = tqdm(chunks, desc="fit", unit="chunk")
    parts = []
    for begin in chunks:
        part = slice(begin, begin + CHUNK)
        known = None if earlier is None else Parameters(*(x[part] for x in earlier))
        parts.append(_fit_chunk(model, Statistics(*(x[part] for x in host)), measurement.response.dtype, known))
    return _assemble(model, measurement, summary, sigma, good, parts, start is not None)


class _Part(NamedTuple):
    values: dict[str, np.ndarray]
    covariance: np.ndarray
    status: np.ndarray


def _fit_chunk(model: Model, host: Statistics, dtype: np.dtype, earlier: Parameters | None) -> _Part:
    count = len(host.residual)
    # code is compiled for a shape: pad to a power of two, so that few shapes occur
    size = 1 << (count - 1).bit_length()
    fill = np.concatenate([np.arange(count), np.zeros(size - count, int)])
    host = Statistics(*(x[fill] for x in host))
    earlier = None if earlier is None else Parameters(*(x[fill] for x in earlier))
    statistics = as_device(host, dtype)
    best = _search(model, host, statistics, earlier, 2 if earlier is not None else 6)
    local = _correct_edges(model, best.parameters, statistics, describe(model, best.parameters, statistics))
    log_posterior, chi_square, gain = (np.asarray(x) for x in _residual(model, best.parameters, statistics))
    status = np.where(best.converged, 0, int(Status.NOT_CONVERGED))
    for name in model.bounds:
        low, high = _on_bounds(model, best.parameters, name)
        status = status | np.where(low | high, int(Status.AT_EDGE), 0)
    for i, name in enumerate(model.free):
        status = status | np.where(local.unidentified[:, i], int(Status.unidentified(name)), 0)
    real_type = chi_square.dtype
    covariance = np.zeros((size, 5, 5), real_type)
    places = np.array([Parameters._fields.index(name) for name in model.free])
    covariance[:, places[:, None], places] = local.covariance
    values: dict[str, np.ndarray] = {name: np.asarray(getattr(best.parameters, name)) for name in Parameters._fields}
    for name in model.dropped:
        values[name] = np.full(size, np.nan, real_type)
        status = status | int(Status.unidentified(name))
    values |= {"log_posterior": log_posterior, "chi_square": chi_square, "gain": gain}
    values["log_evidence"] = local.log_evidence.astype(real_type)
    return _Part({name: x[:count] for name, x in values.items()}, covariance[:count], status[:count])


def _assemble(
    model: Model,
    measurement: Measurement,
    summary: Summary,
    sigma: np.ndarray,
    good: np.ndarray,
    parts: list[_Part],
    started: bool,
) -> Fit:
    """Put the chunks back into the frame, and judge the residuals."""
    shape = measurement.shape
    real_type = parts[0].covariance.dtype if parts else np.dtype(float)

    def spread(values: list[np.ndarray], dtype: np.dtype | type, tail: tuple[int, ...] = ()) -> np.ndarray:
        frame = np.full((int(np.prod(shape)), *tail), np.nan, dtype)
        if values:
            frame[good] = np.concatenate(values)
        return frame.reshape((*shape, *tail))

    def value(name: str, dtype: np.dtype | type = real_type) -> np.ndarray:
        return spread([part.values[name] for part in parts], dtype)

    covariance = spread([part.covariance for part in parts], real_type, (5, 5))
    with np.errstate(invalid="ignore"):
        std = np.sqrt(np.einsum("...ii->...i", covariance))
    for name in model.dropped:
        std[..., Parameters._fields.index(name)] = np.nan
    status = np.zeros(int(np.prod(shape)), np.int32)
    if parts:
        status[good] = np.concatenate([part.status for part in parts])
    status = status.reshape(shape)
    status = np.where(summary.non_finite, int(Status.NON_FINITE), status)
    status = np.where(summary.masked, int(Status.MASKED), status).astype(np.int32)
    fitted = np.minimum(len(model.free) + model.known_gain.real_parameters, 4 * summary.rank)
    degrees = np.maximum(4 * summary.states - fitted, 0).astype(np.int32)
    chi_square = value("chi_square")
    with np.errstate(invalid="ignore"):
        bad = (degrees > 0) & (gammaincc(0.5 * np.maximum(degrees, 1), 0.5 * chi_square) < BAD_FIT_PROBABILITY)
    status = np.where(bad, status | int(Status.BAD_FIT), status).astype(np.int32)
    complex_type = np.result_type(real_type, np.complex64)
    return Fit(
        model=model,
        parameters=Parameters(*(value(name) for name in Parameters._fields)),
        std=Parameters(*(std[..., i] for i in range(5))),
        covariance=covariance,
        log_posterior=value("log_posterior"),
        log_evidence=value("log_evidence"),
        sigma=np.array(sigma, real_type),
        gain=None if model.gain is None else value("gain", complex_type),
        status=status,
        chi_square=chi_square,
        degrees_of_freedom=degrees,
        started_from_fit=started,
    )
