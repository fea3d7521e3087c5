"""``fit`` for any ordering and any priors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..checks import one_of_types
from ..degeneracy import REFERENCE, nearest, reduce_ranges
from ..model import Model, as_device
from ..neighbours import Pooled, Windowed
from ..noise import InferredNoise, KnownNoise
from ..records import Fit, Measurement, Parameters, Status
from ..statistics import Statistics, Summary, least_squares_jones, summarise
from .charts import from_parameters, to_parameters
from .edges import integrate
from .frame_noise import Search, effective_parameters, first_guess, misfit
from .local_gaussian import Local, describe, equivalent, log_density, uniform_std
from .newton import maximise
from .residuals import judge, tail_probability
from .start import starts
from .student import total_power, widen

__all__ = ["fit"]

CHUNK = 2048  # pixels whose starting points are in memory at once
ITERATIONS = 60
DESIGN, DESIGN_WARM = 6, 2  # starts from the design, without and with an earlier fit
FRAME_ROUNDS = 30
BAD_FIT_PROBABILITY = 1e-3


class _Best(NamedTuple):
    parameters: Parameters
    value: np.ndarray
    converged: np.ndarray


def _strength(statistics: Statistics | Windowed) -> np.ndarray:
    """Signal-to-noise ratio of a pixel or of a window."""
    plain = statistics if isinstance(statistics, Statistics) else statistics.statistics
    power = np.sum(np.abs(np.asarray(plain.illumination)) ** 2, axis=(-1, -2))
    return np.sqrt(power if isinstance(statistics, Statistics) else np.sum(power, axis=-1))


def _canonical(model: Model, parameters: Parameters, statistics: Statistics | Windowed) -> Parameters:
    """Of the equivalent copies with the highest density, the one nearest to the reference."""
    copies = equivalent(model, parameters)
    prior = np.asarray(model.log_prior(copies))
    likelihood = np.asarray(log_density(model, copies, statistics)) - np.where(np.isfinite(prior), prior, 0)
    likelihood = np.where(np.isnan(likelihood), -np.inf, likelihood)
    # Likelihoods of copies differ by rounding only, eps times the signal-to-noise ratio, unless an ordering of the
    # user's own breaks the symmetry.
    rounding = 30 * np.finfo(prior.dtype).eps * (1 + _strength(statistics))
    highest = likelihood.max(axis=0)
    density = prior + np.where(likelihood >= highest - rounding, highest, likelihood)
    slack = 1e-6 if density.dtype == np.float64 else 1e-3
    allowed = density >= density.max(axis=0) - slack
    return nearest(copies, Parameters(*(np.asarray(x, density.dtype) for x in REFERENCE)), allowed)


def _search(
    model: Model,
    host: Statistics | Windowed,
    statistics: Statistics | Windowed,
    earlier: Parameters | None,
    design: int | None,
) -> _Best:
    """Most probable parameters of every pixel of a chunk; ``design`` None: from the earlier ones alone."""
    dtype = np.asarray(statistics.residual).dtype
    if design is None and earlier is not None:
        points = (from_parameters(model, earlier) * (1 - 1e-4) + 1e-4)[:, None].astype(dtype)
    else:
        points = starts(model, host, statistics, earlier, design or 0).astype(dtype)
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


def _on_bounds(model: Model, parameters: Parameters, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels lie on the lower and on the upper bound of a parameter."""
    value, (low, high) = np.asarray(getattr(parameters, name)), model.bounds[name]
    near = (1e-9 if value.dtype == np.float64 else 1e-5) * (high - low)
    return value <= low + near, value >= high - near


def _correct_edges(model: Model, parameters: Parameters, statistics: Statistics | Windowed, local: Local) -> Local:
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
            jax.tree.map(lambda x, rows=padded: np.asarray(x)[rows], statistics),
        )
        better = edge.log_evidence[: len(chosen)]
        local.log_evidence[chosen] = np.where(np.isfinite(better), better, local.log_evidence[chosen])
        replace = chosen[on_bound[chosen]]
        local.covariance[replace] = edge.moments[: len(chosen)][on_bound[chosen]]
        spread = np.sqrt(np.einsum("...ii->...i", local.covariance[replace]))
        local.on_bound[replace] = True
        local.unidentified[replace] = spread > 0.5 * np.array([uniform_std(other) for other in model.free])
    return local


def fit(model: Model, measurement: Measurement, start: Fit | None = None, progress: bool = False) -> Fit:
    """The most probable parameters of every pixel, with a local Gaussian around them.

    Maximises ``log p(data | parameters) + log p(parameters)``, the density in D, theta_D, eta, theta_eta, xi (radians),
    with the gain integrated out; every pixel (or the window around it) on its own, by Newton steps from several starts.
    Of the equivalent parameter sets with the highest density the canonical one is reported
    (:func:`polinfer.canonicalise`). Nothing is random. The precision is that of the measurement: complex64 data give
    float32 results; complex128 data give float64 results where JAX has double precision enabled
    (``jax.config.update("jax_enable_x64", True)``), else float32.

    Parameters
    ----------
    model: the scene. measurement: the data, pixel shape P; it must know sigma unless the model infers it.
    start: an earlier fit of the same pixel shape and similar data (a video): its parameters are tried first and fewer
        other starts are needed.
    progress: show a progress bar.

    Returns
    -------
    Fit, arrays of shape P. Masked pixels and those with a response that is not finite are NaN and flagged.

    Raises
    ------
    ValueError: no sigma, or one that is to be inferred, a start of another shape, nothing free to fit. TypeError:
    arguments of a wrong kind.

    Notes
    -----
    Standard deviations come from the curvature at the maximum. On a bound (``Status.AT_EDGE``) the density is not a
    Gaussian there.

    With ``InferredNoise`` of scope "frame" the most probable sigma of the frame is found first by repeated fits, as the
    maximum of the density of log sigma^2 with the parameters integrated out (Laplace); all else is given this sigma.

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
    earlier = None
    if start is not None:
        earlier = Parameters(*(np.asarray(x).reshape(-1) for x in start.parameters))
    if isinstance(model.noise, InferredNoise) and not model.noise.integrated:
        return _fit_frame(model, model.noise, measurement, earlier, progress)
    prepared = _prepare(model, measurement, model.noise.integrated)
    parts = list(_parts(prepared, earlier, DESIGN if earlier is None else DESIGN_WARM, progress))
    return _assemble(model, prepared, model.noise.sigma(measurement), parts, start is not None)


class _Prepared(NamedTuple):
    model: Model
    measurement: Measurement
    summary: Summary
    pooled: Pooled
    good: np.ndarray
    sigma_unknown: bool


class _Part(NamedTuple):
    values: dict[str, np.ndarray]
    covariance: np.ndarray
    status: np.ndarray


def _prepare(model: Model, measurement: Measurement, sigma_unknown: bool) -> _Prepared:
    summary = summarise(measurement, model.noise.sigma(measurement))
    good = np.flatnonzero(~(summary.masked | summary.non_finite).reshape(-1))
    return _Prepared(model, measurement, summary, model.pool(summary), good, sigma_unknown)


def _parts(prepared: _Prepared, earlier: Parameters | None, design: int | None, progress: bool) -> Iterable[_Part]:
    """Fits of all good pixels, chunk by chunk; ``earlier`` are parameters of all pixels."""
    model, pooled, good = prepared.model, prepared.pooled, prepared.good
    # the starting points of a window take its size in memory, those of an integral over sigma the number of its nodes
    cost = 1 if model.neighbours is None else model.neighbours.rows * model.neighbours.columns
    cost *= 8 if model.noise.integrated else 1
    size = max(CHUNK // cost, 64)
    chunks: Any = range(0, len(good), size)
    if progress:
        from tqdm import tqdm

        chunks = tqdm(chunks, desc="fit", unit="chunk")
    for begin in chunks:
        chosen = good[begin : begin + size]
        known = None if earlier is None else Parameters(*(x[chosen] for x in earlier))
        own = Statistics(*(x[chosen] for x in pooled.own))
        yield _fit_chunk(prepared, pooled.take(chosen), own, known, design)


def _fit_frame(
    model: Model, noise: InferredNoise, measurement: Measurement, earlier: Parameters | None, progress: bool
) -> Fit:
    """Fit with one unknown sigma for all pixels."""
    noise.refuse(measurement)
    given = replace(model, noise=KnownNoise())

    def at(variance: float) -> _Prepared:
        return _prepare(given, replace(measurement, sigma=np.sqrt(variance)), True)

    unit = at(1.0)
    own = Statistics(*(x[unit.good] for x in unit.pooled.own))
    closed = model.ordering.decompose(least_squares_jones(own))
    search = Search(noise, first_guess(noise, own, None if closed is None else np.asarray(given.jones(closed))))
    warm = earlier
    design: int | None = DESIGN if earlier is None else DESIGN_WARM
    for _ in range(FRAME_ROUNDS if len(unit.good) else 0):
        prepared = at(search.variance)
        parts = list(_parts(prepared, warm, design, progress))
        misfits, fitted = (np.concatenate([part.values[name] for part in parts]) for name in ("misfit", "effective"))
        data = prepared.pooled.data.reshape(-1)[prepared.good]
        copies = float(np.sum(data)) / max(float(np.sum(own.count)), 1.0)
        search.update(misfits, data, fitted, copies)
        warm, design = _spread_parameters(prepared, parts), None
        if search.converged:
            break
    final = at(search.variance)
    parts = list(_parts(final, warm, DESIGN_WARM, progress))
    return _assemble(model, final, np.full(measurement.shape, np.sqrt(search.variance)), parts, earlier is not None)


def _spread_parameters(prepared: _Prepared, parts: list[_Part]) -> Parameters:
    """Parameters of all pixels, NaN where there is no fit."""
    found = {}
    for name in Parameters._fields:
        values = [part.values[name] for part in parts]
        found[name] = np.full(prepared.summary.masked.size, np.nan, values[0].dtype)
        found[name][prepared.good] = np.concatenate(values)
    return Parameters(**found)


def _fit_chunk(
    prepared: _Prepared,
    host: Statistics | Windowed,
    own: Statistics,
    earlier: Parameters | None,
    design: int | None,
) -> _Part:
    model, dtype, count = prepared.model, prepared.measurement.response.dtype, len(own.count)
    # code is compiled for a shape: pad to a power of two, so that few shapes occur
    size = 1 << (count - 1).bit_length()
    fill = np.concatenate([np.arange(count), np.zeros(size - count, int)])
    host, own = (jax.tree.map(lambda x: x[fill], values) for values in (host, own))
    earlier = None if earlier is None else Parameters(*(x[fill] for x in earlier))
    statistics, own = as_device(host, dtype), as_device(own, dtype)
    best = _search(model, host, statistics, earlier, design)
    local = _correct_edges(model, best.parameters, statistics, describe(model, best.parameters, statistics))
    effective = np.zeros(size)
    if prepared.sigma_unknown:
        effective = effective_parameters(model, best.parameters, local.covariance)
    if isinstance(model.noise, InferredNoise) and model.noise.integrated:
        power = total_power(model, model.noise, statistics)
        local = widen(model, best.parameters, local, effective, power)
    real_type = statistics.residual.dtype
    judged = judge(model, best.parameters, statistics, own, jnp.asarray(effective, real_type))
    status = np.where(best.converged, 0, int(Status.NOT_CONVERGED))
    for name in model.bounds:
        low, high = _on_bounds(model, best.parameters, name)
        status = status | np.where(low | high, int(Status.AT_EDGE), 0)
    for i, name in enumerate(model.free):
        status = status | np.where(local.unidentified[:, i], int(Status.unidentified(name)), 0)
    covariance = np.zeros((size, 5, 5), real_type)
    places = np.array([Parameters._fields.index(name) for name in model.free])
    covariance[:, places[:, None], places] = local.covariance
    values: dict[str, np.ndarray] = {name: np.asarray(getattr(best.parameters, name)) for name in Parameters._fields}
    for name in model.dropped:
        values[name] = np.full(size, np.nan, real_type)
        status = status | int(Status.unidentified(name))
    values |= {name: np.asarray(value) for name, value in judged._asdict().items()}
    values["effective"] = effective
    if prepared.sigma_unknown and not model.noise.integrated:
        values["misfit"] = np.asarray(misfit(model, best.parameters, statistics), float)
    values["log_evidence"] = local.log_evidence.astype(real_type)
    return _Part({name: x[:count] for name, x in values.items()}, covariance[:count], status[:count])


def _assemble(model: Model, prepared: _Prepared, sigma: np.ndarray | None, parts: list[_Part], started: bool) -> Fit:
    """Put the chunks back into the frame, and judge the residuals; ``sigma`` None: that of the parts."""
    summary, pooled, good = prepared.summary, prepared.pooled, prepared.good
    shape = prepared.measurement.shape
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
    gains = model.known_gain.real_parameters
    fitted = np.minimum(len(model.free) + gains * pooled.pixels, 4 * pooled.rank)
    degrees = np.maximum(2 * pooled.data - fitted, 0).astype(np.int32)
    own = np.broadcast_to(pooled.own.count, (status.size,)).reshape(shape)
    share = np.minimum(len(model.free) * own / np.maximum(pooled.data, 1) + gains, 4 * summary.rank)
    chi_square = value("chi_square")
    likely = tail_probability(model, chi_square, degrees, value("residual"), 2 * own - share)
    status = np.where(likely < BAD_FIT_PROBABILITY, status | int(Status.BAD_FIT), status).astype(np.int32)
    if sigma is None:
        with np.errstate(divide="ignore"):
            sigma = value("precision") ** -0.5
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
