"""The verb ``fit``: which route a model takes, one sigma for a frame, and the pixels put back into the frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ..checks import one_of_types
from ..misalignment import TiltPlane
from ..model import Model
from ..noise import InferredNoise, KnownNoise
from ..records import Fit, Measurement, Parameters, Status
from ..statistics import Statistics, least_squares_jones
from .fast import fast_scene, fit_part, fit_responses, judge_states
from .frame_noise import Search, first_guess
from .generic import DESIGN, DESIGN_WARM, Part, Prepared, chunk_size, fit_chunk, prepare
from .residuals import BAD_FIT_PROBABILITY, tail_probability
from .tilt import fit_tilted

__all__ = ["fit"]

FRAME_ROUNDS = 30
FAST_CHUNK = 1 << 16  # pixels whose statistics are in memory at once


def fit(model: Model, measurement: Measurement, start: Fit | None = None, progress: bool = False) -> Fit:
    """The most probable parameters of every pixel, with a local Gaussian around them.

    Maximises ``log p(data | parameters) + log p(parameters)``, the density in D, theta_D, eta, theta_eta, xi (radians),
    with the gain integrated out; every pixel (or the window around it) on its own, by Newton steps from the closed form
    and, where the data are ambiguous, from other starts.
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
    maximum of the density of log sigma^2 with the parameters integrated out as Gaussians; all else is given this sigma.

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
    if isinstance(model.misalignment, TiltPlane):
        return fit_tilted(model, measurement, start, progress, fit)
    earlier = None
    if start is not None:
        earlier = Parameters(*(np.asarray(x).reshape(-1) for x in start.parameters))
    if isinstance(model.noise, InferredNoise) and not model.noise.integrated:
        return _fit_frame(model, model.noise, measurement, earlier, progress)
    if isinstance(model.noise, InferredNoise) and earlier is None:
        likely = _at_likely_sigma(model, model.noise, measurement)
        if likely is not None:
            prepared = prepare(model, measurement, True)
            # few pixels have a second maximum, more where the states are unbalanced
            design = None if judge_states(prepared.pooled.own.illumination, np.dtype(np.float32))[1] else DESIGN_WARM
            parts = list(_parts(prepared, likely, design, progress))
            return _assemble(model, prepared, None, parts, False)
    found = fit_responses(model, measurement, earlier, progress, partial(_fit_general, fast=False))
    return _fit_general(model, measurement, earlier, progress) if found is None else found


def _at_likely_sigma(model: Model, noise: InferredNoise, measurement: Measurement) -> Parameters | None:
    """Where to start if every pixel has an unknown sigma: the fast route at likely ones; None if it cannot be had."""
    given = replace(model, noise=KnownNoise())
    if model.neighbours is not None or fast_scene(given) is None:
        return None
    noise.refuse(measurement)
    own = prepare(given, replace(measurement, sigma=np.ones(())), True).pooled.own
    count = np.asarray(own.count, float).reshape(measurement.shape)
    # rather too small at first: what a large one explains by noise is hard to win back
    misfit, fitted, found = np.asarray(own.residual, float).reshape(measurement.shape), 0.0, None
    for _ in range(2):
        variance = (noise.scale + misfit) / (noise.shape + np.maximum(count - 0.5 * fitted, 0))
        sigma = np.sqrt(np.where(np.isfinite(variance), variance, 1.0))
        found = fit(given, replace(measurement, sigma=sigma), found)
        misfit, fitted = 0.5 * found.chi_square * sigma**2, float(len(model.free))
    assert found is not None
    values = (np.asarray(x).reshape(-1) for x in found.parameters)
    return Parameters(*(np.where(np.isfinite(x), x, x.dtype.type(0.1)) for x in values))


def _fit_general(
    model: Model, measurement: Measurement, earlier: Parameters | None, progress: bool, fast: bool = True
) -> Fit:
    """Fit by way of the statistics of every pixel or window; without ``fast`` by the general route alone."""
    prepared = prepare(model, measurement, model.noise.integrated)
    parts = list(_parts(prepared, earlier, DESIGN if earlier is None else DESIGN_WARM, progress, fast))
    return _assemble(model, prepared, model.noise.sigma(measurement), parts, earlier is not None)


def _parts(
    prepared: Prepared, earlier: Parameters | None, design: int | None, progress: bool, fast: bool = True
) -> Iterable[Part]:
    """Fits of all good pixels, chunk by chunk; ``earlier`` are parameters of all pixels."""
    model, good = prepared.model, prepared.good
    known = fast_scene(model) if fast and len(good) else None
    size = chunk_size(model) if known is None else FAST_CHUNK
    chunks: Any = range(0, len(good), size)
    if progress:
        from tqdm import tqdm

        chunks = tqdm(chunks, desc="fit", unit="chunk")
    for begin in chunks:
        chosen = good[begin : begin + size]
        told = None if earlier is None else Parameters(*(x[chosen] for x in earlier))
        if known is not None:
            yield fit_part(known, prepared, chosen, told)
        else:
            yield fit_chunk(prepared, chosen, told, design, prepared.measurement.response.dtype)


def _fit_frame(
    model: Model, noise: InferredNoise, measurement: Measurement, earlier: Parameters | None, progress: bool
) -> Fit:
    """Fit with one unknown sigma for all pixels."""
    noise.refuse(measurement)
    given = replace(model, noise=KnownNoise())

    def at(variance: float) -> Prepared:
        return prepare(given, replace(measurement, sigma=np.sqrt(variance)), True)

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
        copies = float(np.sum(data)) / float(np.sum(own.count)) if np.any(data) else 1.0
        # a pixel that is not at its maximum has a residual that is no noise
        found = np.concatenate([part.status for part in parts]) & int(Status.NOT_CONVERGED) == 0
        found = found if found.any() else ~found
        search.update(misfits[found], data[found], fitted[found], copies)
        warm, design = _spread_parameters(prepared, parts), None
        if search.converged:
            break
    final = at(search.variance)
    parts = list(_parts(final, warm, DESIGN_WARM, progress))
    return _assemble(model, final, np.full(measurement.shape, np.sqrt(search.variance)), parts, earlier is not None)


def _spread_parameters(prepared: Prepared, parts: list[Part]) -> Parameters:
    """Parameters of all pixels, NaN where there is no fit."""
    found = {}
    for name in Parameters._fields:
        values = [part.values[name] for part in parts]
        found[name] = np.full(prepared.summary.masked.size, np.nan, values[0].dtype)
        found[name][prepared.good] = np.concatenate(values)
    return Parameters(**found)


def _assemble(model: Model, prepared: Prepared, sigma: np.ndarray | None, parts: list[Part], started: bool) -> Fit:
    """Put the chunks back into the frame, and judge the residuals; ``sigma`` None: that of the parts."""
    summary, pooled, good = prepared.summary, prepared.pooled, prepared.good
    shape = prepared.measurement.shape
    real_type = parts[0].covariance.dtype if parts else np.dtype(float)

    def spread(values: list[np.ndarray], dtype: np.dtype | type, tail: tuple[int, ...] = ()) -> np.ndarray:
        count = int(np.prod(shape))
        if values and len(good) == count:
            return np.concatenate(values).astype(dtype, copy=False).reshape((*shape, *tail))
        frame = np.full((count, *tail), np.nan, dtype)
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
