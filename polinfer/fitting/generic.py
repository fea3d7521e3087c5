"""A chunk of pixels of any model: any ordering, any priors, any window, unknown noise."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..degeneracy import REFERENCE, nearest, reduce_ranges
from ..model import Model, as_device
from ..neighbours import Pooled, Windowed
from ..noise import InferredNoise
from ..records import Measurement, Parameters, Status
from ..statistics import Statistics, Summary, summarise
from .charts import from_parameters, to_parameters
from .edges import integrate
from .frame_noise import effective_parameters, misfit
from .local_gaussian import Local, describe, equivalent, log_density, log_prior, uniform_std
from .newton import maximise
from .residuals import judge
from .start import starts
from .student import total_power, widen

__all__ = ["DESIGN", "DESIGN_WARM", "Part", "Prepared", "chunk_size", "fit_chunk", "prepare"]

CHUNK = 2048  # pixels whose starting points are in memory at once
LEAST = 64
ITERATIONS, PATIENT = 200, 600  # at most, from a start and from the best point found
DESIGN, DESIGN_WARM = 12, 2  # starts from the design, without and with an earlier fit


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
    prior = np.asarray(log_prior(model, copies))
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
        model, statistics, np.arange(pixels), from_parameters(model, parameters).astype(dtype), PATIENT
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


class Prepared(NamedTuple):
    """A measurement made ready: its statistics, and the flat indices ``good`` of the pixels that can be fitted.

    ``most`` is how many real numbers the data of a pixel can determine beside the gains.
    """

    model: Model
    measurement: Measurement
    summary: Summary
    pooled: Pooled
    good: np.ndarray
    most: np.ndarray
    sigma_unknown: bool


class Part(NamedTuple):
    """Results of some pixels by name, their covariance ``(pixels, 5, 5)`` and their status."""

    values: dict[str, np.ndarray]
    covariance: np.ndarray
    status: np.ndarray


def prepare(model: Model, measurement: Measurement, sigma_unknown: bool) -> Prepared:
    """Statistics of a measurement, of windows where the model has them."""
    summary = summarise(measurement, model.noise.sigma(measurement))
    good = np.flatnonzero(~(summary.masked | summary.non_finite).reshape(-1))
    pooled = model.pool(summary)
    most = np.maximum(4 * pooled.rank - model.known_gain.real_parameters * pooled.pixels, 0).reshape(-1)
    return Prepared(model, measurement, summary, pooled, good, most, sigma_unknown)


def chunk_size(model: Model) -> int:
    """Number of pixels that :func:`fit_chunk` takes at once."""
    # the starting points of a window take its size in memory, those of an integral over sigma the number of its nodes
    cost = 1 if model.neighbours is None else model.neighbours.rows * model.neighbours.columns
    cost *= 8 if model.noise.integrated else 1
    return max(CHUNK // cost, 64)


def fit_chunk(
    prepared: Prepared, chosen: np.ndarray, earlier: Parameters | None, design: int | None, dtype: np.dtype
) -> Part:
    """Maximum, Gaussian, evidence and residuals of the pixels ``chosen``; ``earlier`` are their parameters.

    ``dtype`` is the complex type to compute in, as far as JAX has it enabled.
    """
    model, count = prepared.model, len(chosen)
    host: Statistics | Windowed = prepared.pooled.take(chosen)
    own = Statistics(*(x[chosen] for x in prepared.pooled.own))
    # code is compiled for a shape: pad to a power of two, and not to small ones, so that few shapes occur
    size = max(1 << (count - 1).bit_length(), LEAST)
    fill = np.concatenate([np.arange(count), np.zeros(size - count, int)])
    host, own = (jax.tree.map(lambda x: x[fill], values) for values in (host, own))
    earlier = None if earlier is None else Parameters(*(x[fill] for x in earlier))
    statistics, own = as_device(host, dtype), as_device(own, dtype)
    best = _search(model, host, statistics, earlier, design)
    local = _correct_edges(model, best.parameters, statistics, describe(model, best.parameters, statistics))
    effective = np.zeros(size)
    if prepared.sigma_unknown:
        effective = effective_parameters(model, best.parameters, local.covariance, prepared.most[chosen][fill])
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
    return Part({name: x[:count] for name, x in values.items()}, covariance[:count], status[:count])
