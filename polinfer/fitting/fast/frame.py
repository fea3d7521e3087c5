"""A measurement through the fast route: which pixels it takes, and the result as a :class:`polinfer.Fit`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.special import gammainccinv

from ...model import Model
from ...noise import KnownNoise
from ...precision import double_precision
from ...records import Fit, Measurement, Parameters, Status
from ...statistics import Statistics, factor
from ..frame_noise import effective_parameters, misfit
from ..generic import DESIGN, DESIGN_WARM, Part, Prepared, chunk_size, fit_chunk
from ..local_gaussian import uniform_std
from ..residuals import BAD_FIT_PROBABILITY
from .describe import CONVERGED, FROZEN, NON_FINITE, ROUGH, ROWS
from .edges import correct_edges
from .engine import Frame, Responses, Summed, solve_frame
from .kernel import Shared
from .scene import Scene, scene

__all__ = ["fast_scene", "fit_part", "fit_responses", "judge_states"]

# below this ratio of the singular values of U the data are nearly those of one state, and the closed form says little
LEAST_RATIO = 1e-3
# |s| / s_0 of S = s_0 + s . sigma up to which states count as balanced; it moves angles by as much, in radians
BALANCED = {np.dtype(np.float64): 1e-11, np.dtype(np.float32): 1e-6}


class Solved(NamedTuple):
    """Rows of the result ``(rows, pixels)``, and which pixels have no answer yet.

    ``rough`` are those whose widths double precision cannot tell.
    """

    rows: np.ndarray
    edge: np.ndarray
    lost: np.ndarray
    rough: np.ndarray


def _real_type(values: np.ndarray) -> np.dtype:
    return np.zeros((), jax.dtypes.canonicalize_dtype(values.dtype)).real.dtype


def judge_states(root: np.ndarray, dtype: np.dtype) -> tuple[np.ndarray, bool]:
    """Which illuminations R ``(..., 2, 2)`` are good enough for the closed form, and whether all are balanced."""
    size = np.sum(np.abs(root) ** 2, axis=(-1, -2))
    area = np.abs(root[..., 0, 0] * root[..., 1, 1] - root[..., 0, 1] * root[..., 1, 0])
    fit_for_it = area > LEAST_RATIO * size
    # |s| / s_0 from the two invariants cancels; from the elements of S it does not
    gram = root @ np.conj(np.swapaxes(root, -1, -2))
    off = np.abs(gram[..., 0, 1]) * 2 + np.abs(gram[..., 0, 0] - gram[..., 1, 1])
    return fit_for_it, bool(np.all(off[fit_for_it] <= BALANCED[dtype] * size[fit_for_it]))


def frame_of_responses(model: Model, measurement: Measurement, good: np.ndarray | None) -> Responses | None:
    """The pixels ``good`` (None: all) as they are, where all share the illumination and sigma is known; else None."""
    n, shape = measurement.states, measurement.shape
    weight = np.ones(n) if measurement.weight is None else measurement.weight
    shared = measurement.illumination.size == 2 * n and weight.size == n
    if not shared or measurement.response.shape[:-2] != shape or type(model.noise) is not KnownNoise:
        return None
    root_weight = np.sqrt(weight.reshape(n).astype(float))
    found = factor(measurement.illumination.reshape(2, n) * root_weight)
    dtype = _real_type(measurement.response)
    usable, balanced = judge_states(found.root, dtype)
    if not usable:
        return None
    used = root_weight > 0
    kept = Shared(
        found.root.astype(np.result_type(dtype, np.complex64)),
        found.rows.astype(np.result_type(dtype, np.complex64)),
        root_weight.astype(dtype),
        dtype.type(4 * np.sum(np.log(root_weight[used]))),
        dtype.type(2 * used.sum()),
    )
    sigma = np.asarray(model.noise.sigma(measurement)) if measurement.sigma is None else measurement.sigma
    if sigma.size == 1:
        flat = sigma.reshape(1)
    else:
        flat = np.broadcast_to(sigma, shape).reshape(-1)
        flat = flat if good is None else flat[good]
    response = measurement.response.reshape(-1, 2, n)
    return Responses(response if good is None else response[good], flat.astype(dtype), kept, balanced)


def frame_of_statistics(statistics: Statistics) -> tuple[Summed, np.ndarray]:
    """Pixels ``(pixels, ...)`` with statistics of their own, and which of them the closed form is good enough for."""
    dtype = _real_type(statistics.response)
    usable, balanced = judge_states(statistics.illumination, dtype)
    complex_type = np.result_type(dtype, np.complex64)
    cast = Statistics(*(x.astype(complex_type if np.iscomplexobj(x) else dtype, copy=False) for x in statistics))
    return Summed(cast, balanced), usable


def solve(
    known: Scene, frame: Frame, earlier: Parameters | None = None, done: Callable[[int], Any] = lambda _: None
) -> Solved:
    """Maximum, Gaussian and evidence of every pixel, also at bounds; ``earlier`` parameters are tried as well."""
    rows, flags = solve_frame(known, frame, earlier, done)
    correct_edges(known, rows, flags)
    edge = (flags & (FROZEN[0] | FROZEN[2])) != 0
    told = np.isfinite(rows[ROWS["log_evidence"]])
    for row in rows[ROWS["std"]]:
        told &= np.isfinite(row)
    failed, rough = (flags & NON_FINITE != 0) | ~told, (flags & ROUGH != 0)
    if rows.dtype == np.float32:
        return Solved(rows, edge, failed | rough | (flags & CONVERGED == 0), np.zeros_like(rough))
    return Solved(rows, edge, failed | (~rough & (flags & CONVERGED == 0)), rough)


def on_bounds(model: Model, rows: np.ndarray) -> np.ndarray:
    """Where a parameter is a bound to within rounding."""
    found, near = np.zeros(rows.shape[1], bool), 8 * np.finfo(rows.dtype).eps
    for name, (low, high) in model.bounds.items():
        value, reach = rows[Parameters._fields.index(name)], near * (high - low) / 2
        found |= (value <= low + reach) | (value >= high - reach)
    return found


def status_of(model: Model, solved: Solved) -> np.ndarray:
    """Status bits that follow from the rows: bounds, what is not identified, and what is lost in rounding."""
    rows = solved.rows
    status = np.where(solved.edge | on_bounds(model, rows), np.int32(Status.AT_EDGE), np.int32(0))
    status |= np.where(solved.rough, np.int32(Status.NOT_CONVERGED), np.int32(0))
    for name in model.free:
        std = rows[5 + Parameters._fields.index(name)]
        status |= np.where(std > 0.5 * uniform_std(name), np.int32(Status.unidentified(name)), np.int32(0))
    for name in model.dropped:
        status |= np.int32(Status.unidentified(name))
    return status


@lru_cache(maxsize=256)
def fast_scene(model: Model) -> Scene | None:
    """The scene of a model whose statistics are those of single pixels, sigma given; None if it has no fast form."""
    if model.noise.integrated or (model.neighbours is not None and model.gain is not None):
        return None
    return scene(replace(model, noise=KnownNoise(), neighbours=None, misalignment=None))


def fit_part(known: Scene, prepared: Prepared, chosen: np.ndarray, earlier: Parameters | None) -> Part:
    """What :func:`polinfer.fitting.generic.fit_chunk` gives, for the pixels ``chosen`` of a prepared measurement."""
    statistics = prepared.pooled.take(chosen)
    assert isinstance(statistics, Statistics)
    return _fit_statistics(known, prepared, chosen, statistics, earlier)


def _fit_statistics(
    known: Scene, prepared: Prepared, chosen: np.ndarray, statistics: Statistics, earlier: Parameters | None
) -> Part:
    """The same from their statistics."""
    model = prepared.model
    frame, usable = frame_of_statistics(statistics)
    if not usable.any():
        return _fit_general(prepared, chosen, earlier, frame.dtype)
    solved = solve(known, frame, earlier)
    rows, status = solved.rows, status_of(model, solved)
    values = {name: rows[i] for i, name in enumerate(Parameters._fields)}
    values |= {name: rows[ROWS[name]] for name in ("log_posterior", "log_evidence", "chi_square")}
    for name in model.dropped:
        values[name] = np.full_like(values[name], np.nan)
    covariance = np.moveaxis(rows[ROWS["covariance"]].reshape(5, 5, -1), -1, 0)
    values["residual"], values["precision"] = 0.5 * values["chi_square"], np.ones_like(values["chi_square"])
    values["gain"] = np.ones(len(chosen), np.result_type(rows.dtype, np.complex64))
    if model.gain is not None:
        values["gain"] = rows[ROWS["gain_real"]] + 1j * rows[ROWS["gain_imaginary"]]
    values["effective"] = np.zeros(len(chosen))
    if prepared.sigma_unknown:
        _add_search(model, frame.statistics, values, covariance, prepared.most[chosen])
    part = Part(values, covariance, status)

    def replace_by(found: Part, where: np.ndarray) -> None:
        with np.errstate(over="ignore"):
            for name, value in found.values.items():
                values[name][where] = value
        covariance[where], status[where] = found.covariance, found.status
        status[where] |= _overflowed(values["log_posterior"][where])

    def told(where: np.ndarray) -> Parameters | None:
        return None if earlier is None else Parameters(*(x[where] for x in earlier))

    lost, single = np.flatnonzero(solved.lost & usable), frame.dtype == np.float32
    if len(lost) and single:
        precise = Statistics(*(x[lost].astype(np.result_type(x, np.float64)) for x in statistics))
        with double_precision():
            replace_by(_fit_statistics(known, prepared, chosen[lost], precise, told(lost)), lost)
        status |= np.where(on_bounds(model, rows), np.int32(Status.AT_EDGE), np.int32(0))
    lost = np.flatnonzero(~usable if single else solved.lost | ~usable)
    if len(lost):
        replace_by(_fit_general(prepared, chosen[lost], told(lost), frame.dtype), lost)
    return part


def _overflowed(log_posterior: np.ndarray) -> np.ndarray:
    """Status bit of densities that the precision of the result cannot hold."""
    return np.where(np.isfinite(log_posterior), np.int32(0), np.int32(Status.NOT_CONVERGED))


def _fit_general(prepared: Prepared, chosen: np.ndarray, earlier: Parameters | None, dtype: np.dtype) -> Part:
    """Pixels that the general route has to take: in double precision, results in that of ``dtype``."""
    size, parts, model = chunk_size(prepared.model), [], prepared.model
    with double_precision():
        for begin in range(0, len(chosen), size):
            some = slice(begin, begin + size)
            told = None if earlier is None else Parameters(*(x[some] for x in earlier))
            design = DESIGN if told is None else DESIGN_WARM
            parts.append(fit_chunk(prepared, chosen[some], told, design, np.dtype(np.complex128)))
    values = {name: np.concatenate([part.values[name] for part in parts]) for name in parts[0].values}
    with np.errstate(over="ignore"):
        for name, value in values.items():
            values[name] = value.astype(np.result_type(dtype, np.complex64) if np.iscomplexobj(value) else dtype)
    status = np.concatenate([part.status for part in parts]) | _overflowed(values["log_posterior"])
    found = np.stack([values[name] for name in Parameters._fields])
    status |= np.where(on_bounds(model, found), np.int32(Status.AT_EDGE), np.int32(0))
    return Part(values, np.concatenate([part.covariance for part in parts]).astype(dtype), status)


def _add_search(
    model: Model, statistics: Statistics, values: dict[str, np.ndarray], covariance: np.ndarray, most: np.ndarray
) -> None:
    """What the search for an unknown sigma of the frame asks of a fit at a given one."""
    pixels = len(most)
    fill = np.arange(1 << (pixels - 1).bit_length()) % pixels  # code is compiled for a shape
    parameters = Parameters(*(values[name][fill] for name in Parameters._fields))
    free = [Parameters._fields.index(name) for name in model.free]
    own = covariance[fill][:, free][:, :, free]
    values["effective"] = effective_parameters(model, parameters, own, most[fill])[:pixels]
    if model.gain is None:
        values["misfit"] = 0.5 * values["chi_square"].astype(float)
    else:
        padded = Statistics(*(x[fill] for x in statistics))
        values["misfit"] = np.asarray(misfit(model, parameters, padded), float)[:pixels]


def fit_responses(
    model: Model,
    measurement: Measurement,
    earlier: Parameters | None,
    progress: bool,
    general: Callable[[Model, Measurement, Parameters | None, bool], Fit],
) -> Fit | None:
    """:func:`polinfer.fit` where the model has a fast form and all pixels share the illumination; else None.

    ``general`` fits pixels that are left over as a measurement of their own, ``(model, measurement, earlier,
    progress)``.
    """
    known = scene(model)
    if known is None or model.neighbours is not None:
        return None
    shape = measurement.shape
    good = None
    if measurement.mask is not None:
        good = np.flatnonzero(np.broadcast_to(measurement.mask, shape))
        good = None if good.size == np.prod(shape) else good
    frame = frame_of_responses(model, measurement, good)
    if frame is None:
        return None
    known_start = None
    if earlier is not None:
        known_start = Parameters(*(np.asarray(x) if good is None else np.asarray(x)[good] for x in earlier))
    with bar(frame.pixels, progress) as done:
        solved = solve(known, frame.summed() if frame.small else frame, known_start, done)
    rows, status = solved.rows, status_of(model, solved)
    degrees = max(2 * int(frame.shared.count) - len(model.free) - model.known_gain.real_parameters, 0)
    if degrees:
        worst = 2 * gammainccinv(0.5 * degrees, BAD_FIT_PROBABILITY)
        status |= np.where(rows[ROWS["chi_square"]] > worst, np.int32(Status.BAD_FIT), np.int32(0))
    lost = np.flatnonzero(solved.lost)
    if len(lost):
        place = lost if good is None else good[lost]
        _fill_in(model, measurement, known_start, general, rows, status, lost, place, frame.shared.root_weight > 0)
    return _as_fit(model, measurement, rows, status, good, degrees, earlier is not None)


def _fill_in(
    model: Model, measurement: Measurement, earlier: Parameters | None,
    general: Callable[[Model, Measurement, Parameters | None, bool], Fit],
    rows: np.ndarray, status: np.ndarray, lost: np.ndarray, place: np.ndarray, used: np.ndarray,
) -> None:  # fmt: skip
    """Pixels without a finite response, those that single precision cannot settle, and the general route's."""
    shape, n = measurement.shape, measurement.states
    response = measurement.response.reshape(-1, 2, n)[place]
    finite = np.isfinite(response[:, :, used]).all(axis=(-1, -2))
    rows[:, lost[~finite]], status[lost[~finite]] = np.nan, int(Status.NON_FINITE)
    lost, place, response = lost[finite], place[finite], response[finite]
    if len(lost) == 0:
        return
    sigma = measurement.sigma
    part = Measurement(
        measurement.illumination.reshape(2, n).astype(np.complex128),
        response.astype(np.complex128),
        sigma if sigma is None or sigma.size == 1 else np.broadcast_to(sigma, shape).reshape(-1)[place],
        None if measurement.weight is None else measurement.weight.reshape(n),
    )
    told = None if earlier is None else Parameters(*(x[lost] for x in earlier))
    with double_precision():
        found = fit_responses(model, part, told, False, general) if rows.dtype == np.float32 else None
        found = general(model, part, told, False) if found is None else found
    rows[ROWS["parameters"], lost] = np.stack(list(found.parameters))
    rows[ROWS["std"], lost] = np.stack(list(found.std))
    rows[ROWS["covariance"], lost] = found.covariance.reshape(-1, 25).T
    with np.errstate(over="ignore"):
        for name in ("log_posterior", "log_evidence", "chi_square"):
            rows[ROWS[name], lost] = getattr(found, name)
        if found.gain is not None:
            rows[ROWS["gain_real"], lost], rows[ROWS["gain_imaginary"], lost] = found.gain.real, found.gain.imag
    status[lost] = found.status | _overflowed(rows[ROWS["log_posterior"], lost])
    status |= np.where(on_bounds(model, rows), np.int32(Status.AT_EDGE), np.int32(0))


def _as_fit(
    model: Model, measurement: Measurement, rows: np.ndarray, status: np.ndarray, good: np.ndarray | None,
    degrees: int, started: bool,
) -> Fit:  # fmt: skip
    shape = measurement.shape
    for name in model.dropped:
        i = Parameters._fields.index(name)
        rows[[i, 5 + i]] = np.nan
    if good is not None:
        frame = np.full((len(rows), int(np.prod(shape))), np.nan, rows.dtype)
        frame[:, good] = rows
        bits = np.full(int(np.prod(shape)), int(Status.MASKED), np.int32)
        bits[good] = status
        rows, status = frame, bits
    rows = rows.reshape(-1, *shape)
    covariance = np.moveaxis(rows[ROWS["covariance"]].reshape(5, 5, *shape), (0, 1), (-2, -1))
    gain = None
    if model.gain is not None:
        gain = rows[ROWS["gain_real"]] + 1j * rows[ROWS["gain_imaginary"]]
    return Fit(
        model=model,
        parameters=Parameters(*rows[ROWS["parameters"]]),
        std=Parameters(*rows[ROWS["std"]]),
        covariance=covariance,
        log_posterior=rows[ROWS["log_posterior"]],
        log_evidence=rows[ROWS["log_evidence"]],
        sigma=np.array(np.broadcast_to(np.asarray(model.noise.sigma(measurement)), shape), rows.dtype),
        gain=gain,
        status=status.reshape(shape),
        chi_square=rows[ROWS["chi_square"]],
        degrees_of_freedom=np.full(shape, degrees, np.int32),
        started_from_fit=started,
    )


@contextmanager
def bar(pixels: int, shown: bool) -> Iterator[Callable[[int], Any]]:
    """What to call after so many more pixels."""
    if not shown:
        yield lambda _: None
        return
    from tqdm import tqdm

    with tqdm(total=pixels, desc="fit", unit="pixel", unit_scale=True) as progress:
        yield progress.update
