"""The verb ``fit`` for a model with a :class:`polinfer.TiltPlane`: the plane and all pixels together.

With the pixels' parameters eliminated the log posterior of the coefficients is a sum over pixels,
``sum_i F_i(phi_i) + log p(tilt)``, ``F_i = log sum_copies max exp f_i``. Its Newton steps cost one pass over the
pixels. The start is a peak of the spectrum of ``conj(J_01) J_10``; what the pixels say about the phase once they are
fitted gives the spectrum of everything they know, hence whether another plane is better, and how much of the posterior
lies elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from math import log, pi
from typing import Any, NamedTuple

import numpy as np

from ..misalignment import Tilt, TiltPlane
from ..model import Model
from ..neighbours import box_sum
from ..noise import KnownNoise
from ..records import Fit, Measurement, Parameters, Status
from ..tilting import untilt
from .local_gaussian import uniform_std
from .tilt_pixels import Pixels, pixels_of
from .tilt_start import Spectrum, fold, refine, spectrum_of, wrap_piston

__all__ = ["UNIFORM", "fit_tilted", "shares"]

SAMPLE = 8192  # pixels by which the plane is found before all of them are asked
STEPS = 12  # Newton steps at most
# squared Newton decrements, in standard deviations of the coefficients, below which one more step is the last: with the
# sample, whose own error is 1, and with all pixels, where what the last step leaves is of its order squared
ROUGH, NEARLY = 0.1, 3.0
LEFT = 0.01  # what may be left at the fit of the pixels
STARTS = 3  # planes that are tried where the spectrum says that another one may be better
LEAST_SHARE = 0.95  # of the posterior that the maximum must hold
UNIFORM = pi / 12**0.5  # standard deviation of a phase that is not known
NO_ANSWER = int(Status.MASKED | Status.NON_FINITE | Status.NOT_CONVERGED)
FAR = 2 * pi  # slopes beyond the main peak of a spectrum
BENDS = 2 * pi / pi**2  # curvature at which a Gaussian piston fills its range
SURE = 30.0  # lead, in nats, at which derivatives alone are believed
QUARTERS = (0.0, 0.25 * pi, 0.5 * pi, 0.75 * pi)

Fitter = Callable[[Model, Measurement, Fit | None, bool], Fit]


def fit_tilted(model: Model, measurement: Measurement, start: Fit | None, progress: bool, fit: Fitter) -> Fit:
    """What :func:`polinfer.fit` returns for a model with a tilt plane; ``fit`` fits the model without it."""
    lead = measurement.shape[:-2]
    if not lead:
        return _fit_frame(model, measurement, start, progress, fit)
    frames = []
    for index in np.ndindex(lead):
        own = None if start is None else _part_of_fit(start, index)
        frames.append(_fit_frame(model, _frame_of(measurement, index), own, progress, fit))
    return _stacked(frames, lead)


def _frame_of(measurement: Measurement, index: tuple[int, ...]) -> Measurement:
    shape = measurement.shape

    def part(values: np.ndarray | None, trailing: int) -> np.ndarray | None:
        if values is None or values.ndim - trailing <= 2:
            return values
        tail = values.shape[values.ndim - trailing :]
        return np.asarray(np.broadcast_to(values, shape + tail)[index])

    chosen: dict[str, Any] = {
        "illumination": part(measurement.illumination, 2),
        "response": part(measurement.response, 2),
    }
    chosen |= {"sigma": part(measurement.sigma, 0), "weight": part(measurement.weight, 1)}
    mask = part(measurement.mask, 0)
    if mask is not None and not mask.any():
        # a frame without pixels is masked by what it says: nothing that is finite
        mask, chosen["response"] = None, np.full_like(np.asarray(chosen["response"]), np.nan)
    return replace(measurement, **chosen, mask=mask)


def _map(function: Callable[..., Any], *records: Any) -> Any:
    """Records of the same form, array by array."""
    first = records[0]
    if first is None or isinstance(first, (bool, Model)):
        return first
    if isinstance(first, np.ndarray):
        return function(*records)
    if isinstance(first, tuple):
        return type(first)(*(_map(function, *parts) for parts in zip(*records, strict=True)))
    values = {f.name: _map(function, *(getattr(r, f.name) for r in records)) for f in fields(first)}
    return type(first)(**values)


def _part_of_fit(record: Fit, index: tuple[int, ...]) -> Fit:
    found: Fit = _map(lambda x: x[index], record)
    return found


def _stacked(frames: list[Fit], lead: tuple[int, ...]) -> Fit:
    found: Fit = _map(lambda *x: np.stack(x).reshape(*lead, *np.shape(x[0])), *frames)
    return found


def _fit_frame(model: Model, measurement: Measurement, start: Fit | None, progress: bool, fit: Fitter) -> Fit:
    plane = model.misalignment
    assert isinstance(plane, TiltPlane)
    plain = replace(model, misalignment=None)
    single = replace(plain, neighbours=None, noise=KnownNoise())
    known = measurement
    if model.noise.integrated or measurement.sigma is None:
        known = _with_likely_sigma(plain, measurement, plane, fit)
    pixels = pixels_of(single, known, plane, fit)
    found = _search(plane, pixels, None if start is None or start.tilt is None else start.tilt.coefficients)
    share = _share(plane, pixels, found)
    known_to, _ = _invert(plane, found.curvature)
    if share < LEAST_SHARE or _mean_std(plane, known_to, measurement.shape) > 0.5 * UNIFORM:
        return _unidentified(model, measurement, plane, fit(plain, measurement, start, progress), pixels, share)
    best = fit(plain, untilt(measurement, plane.phase(found.coefficients, measurement.shape)), start, progress)
    last = found
    if single == plain:
        last = _at(plane, pixels, found.coefficients, pixels.at_fit(found.coefficients, best))
        step = _step(last)
        if step @ last.curvature @ step > LEFT:  # other maxima of the pixels than those of the search
            coefficients = fold(found.coefficients + step, pixels.frame)
            best = fit(plain, untilt(measurement, plane.phase(coefficients, measurement.shape)), best, progress)
            last = _at(plane, pixels, coefficients, pixels.at_fit(coefficients, best))
    covariance, volume = _invert(plane, last.curvature)
    price = float(plane.log_prior(last.coefficients)) + volume - log(share)
    tilt = _tilt(plane, measurement, last.coefficients, covariance, share, price, pixels.spread(last.follow, np.nan))
    return _with_tilt(model, best, tilt)


def _unidentified(
    model: Model, measurement: Measurement, plane: TiltPlane, best: Fit, pixels: Pixels, share: float
) -> Fit:
    """Where no plane stands out the tilt is what it was before the data, 0, and as uncertain as then."""
    coefficients = np.zeros(len(plane.terms))
    covariance = np.diag([UNIFORM**2, *[plane.scale**2] * (len(coefficients) - 1)])
    # the circularity is then as uncertain
    moves = np.array([float(name == "circularity" and name in model.free) for name in Parameters._fields])
    follow = pixels.spread(np.repeat(moves[:, None], pixels.count, axis=1), np.nan)
    found = _with_tilt(model, best, _tilt(plane, measurement, coefficients, covariance, share, 0.0, follow))
    used = (found.status & int(Status.MASKED | Status.NON_FINITE)) == 0
    return replace(found, status=found.status | np.where(used, np.int32(Status.TILT_UNIDENTIFIED), np.int32(0)))


def _mean_std(plane: TiltPlane, covariance: np.ndarray, shape: tuple[int, ...]) -> float:
    """Root mean square of the uncertainty of the phase over the frame."""
    return float(np.sqrt(np.mean(_std(plane, covariance, shape) ** 2)))


def _std(plane: TiltPlane, covariance: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    basis = plane.basis(shape).reshape(len(covariance), -1)
    variance = np.sum(basis * (covariance @ basis), axis=0).reshape(shape)
    return np.minimum(np.sqrt(np.maximum(variance, 0)), UNIFORM)


def _tilt(
    plane: TiltPlane, measurement: Measurement, coefficients: np.ndarray, covariance: np.ndarray, share: float,
    price: float, follow: np.ndarray,
) -> Tilt:  # fmt: skip
    shape = measurement.shape
    kind = np.zeros((), measurement.response.dtype).real.dtype
    return Tilt(
        phase=plane.phase(coefficients, shape).astype(kind),
        phase_std=_std(plane, covariance, shape).astype(kind),
        coefficients=coefficients,
        covariance=covariance,
        probability=np.array(share),
        log_evidence=np.array(price),
        response=np.moveaxis(follow.reshape(5, *shape), 0, -1).astype(kind),
    )


def _with_likely_sigma(plain: Model, measurement: Measurement, plane: TiltPlane, fit: Fitter) -> Measurement:
    """The measurement with the sigma of a fit after a first guess of the tilt."""
    unit = replace(measurement, sigma=np.ones(()))
    guess = pixels_of(replace(plain, neighbours=None, noise=KnownNoise()), unit, plane, fit)
    coefficients = _first(plane, guess.suggestions())
    sigma = fit(plain, untilt(measurement, plane.phase(coefficients, measurement.shape)), None, False).sigma
    return replace(measurement, sigma=np.where(np.isfinite(sigma), sigma, 1.0))


class _Place(NamedTuple):
    """A plane, the log posterior there with its derivatives by the coefficients, and what the pixels say.

    ``phasors`` Z: what a pixel says of any phase is about ``Re(Z e^{-2 i phi})``; ``height`` is its sum at the plane.
    """

    coefficients: np.ndarray
    value: float
    gradient: np.ndarray
    curvature: np.ndarray
    phasors: np.ndarray
    height: float
    follow: np.ndarray
    spectrum: Spectrum | None = None


def _at(plane: TiltPlane, pixels: Pixels, coefficients: np.ndarray, said: Any) -> _Place:
    """Sums over the pixels; their number is that of what they said."""
    basis = pixels.basis if len(said.chosen) == pixels.count else pixels.basis[:, said.chosen]
    gradient, curvature = basis @ said.slope, -(basis * said.bend) @ basis.T
    precision = np.full(len(coefficients), plane.scale**-2.0)
    precision[0] = 0
    gradient = gradient - precision * coefficients
    value = float(np.sum(said.value)) + float(plane.log_prior(coefficients))
    waves = -0.25 * said.bend + 0.5j * said.slope
    return _Place(
        coefficients, value, gradient, curvature + np.diag(precision), waves * np.exp(2j * said.phase),
        float(np.sum(waves.real)), said.follow,
    )  # fmt: skip


def _step(place: _Place) -> np.ndarray:
    """The Newton step, uphill."""
    size = np.sqrt(np.maximum(np.abs(np.diag(place.curvature)), 1e-9))
    values, axes = np.linalg.eigh(place.curvature / np.outer(size, size))
    return np.asarray((axes @ ((axes.T @ (place.gradient / size)) / np.maximum(np.abs(values), 1e-6))) / size)


def _search(plane: TiltPlane, pixels: Pixels, earlier: np.ndarray | None) -> _Place:
    """The best plane, as far as the spectra tell, and what the pixels say there or a small step beside it."""
    coefficients = _first(plane, pixels.suggestions()) if earlier is None else np.array(earlier, float)
    tried: list[_Place] = []
    for _ in range(STARTS):
        if pixels.count > 2 * SAMPLE:
            some = np.arange(0, pixels.count, -(-pixels.count // SAMPLE) | 1)
            coefficients = _climb(plane, pixels, coefficients, some, STEPS, ROUGH).coefficients
        place = _climb(plane, pixels, coefficients, None, STEPS, NEARLY)
        tried.append(place._replace(spectrum=spectrum_of(pixels.spread(place.phasors))))
        other = _better(plane, pixels, tried)
        if other is None:
            break
        coefficients = other
    return max(tried, key=lambda place: place.value)


def _first(plane: TiltPlane, phasors: np.ndarray) -> np.ndarray:
    spectrum = spectrum_of(phasors)
    found = np.zeros(len(plane.terms))
    if spectrum.size.max() > 0:
        found[1:3] = spectrum.slopes(int(np.argmax(spectrum.size)))
        found = refine(plane, phasors, found)
    return wrap_piston(found)


def _better(plane: TiltPlane, pixels: Pixels, tried: list[_Place]) -> np.ndarray | None:
    """A plane away from those tried that by what the pixels say has a higher posterior; None: there is none."""
    place = tried[-1]
    spectrum = place.spectrum
    assert spectrum is not None
    own = place.height + float(plane.log_prior(place.coefficients[:3]))
    # log I_0(x) is at most x, and a grid is up to a tenth below the peak between its points
    if 1.1 * spectrum.highest_far(place.coefficients[1:3]) + spectrum.log_prior_peak(plane.scale) < own:
        return None
    mass = spectrum.log_mass(plane.scale) - log(spectrum.cell)
    for other in tried:
        mass = np.where(spectrum.near(other.coefficients[1:3], FAR), -np.inf, mass)
    top = int(np.argmax(mass))
    if not np.isfinite(mass.flat[top]) or mass.flat[top] + 0.1 * spectrum.size.flat[top] < own:
        return None
    found = np.zeros(len(plane.terms))
    found[1:3] = spectrum.slopes(top)
    return refine(plane, pixels.spread(place.phasors), found)


def _climb(
    plane: TiltPlane, pixels: Pixels, coefficients: np.ndarray, index: np.ndarray | None, steps: int, enough: float
) -> _Place:
    """Newton steps uphill with the pixels ``index``; one with a decrement below ``enough`` is the last."""
    best: _Place | None = None
    trial, previous = coefficients, None
    for _ in range(steps):
        said = pixels.respond(trial, previous, index)
        place = _at(plane, pixels, trial, said)
        slack = 1e-3 + pixels.rounding * abs(place.value)
        if best is not None and place.value < best.value - slack:
            trial = 0.5 * (best.coefficients + trial)
            if np.max(np.abs(trial - best.coefficients)) < 1e-6:
                break
            continue
        best, previous = place, said
        step = _step(place)
        if step @ place.curvature @ step < enough:
            return _moved(pixels, place, step) if index is None else place._replace(coefficients=trial + step)
        # within a quarter turn the pixels' answers are those of one maximum
        reach = float(np.sum(np.abs(step) * pixels.reach))
        trial = place.coefficients + step * min(1.0, 0.5 / max(reach, 1e-12))
    assert best is not None
    return best


def _moved(pixels: Pixels, place: _Place, step: np.ndarray) -> _Place:
    """A small step further, where the parabola is believed."""
    gain = float(place.gradient @ step - 0.5 * step @ place.curvature @ step)
    coefficients = fold(place.coefficients + step, pixels.frame)
    return place._replace(
        coefficients=coefficients,
        value=place.value + gain,
        gradient=place.gradient - place.curvature @ step,
        height=float(np.sum(place.phasors * np.exp(-2j * pixels.phase(coefficients))).real),
    )


def shares(found: Fit) -> np.ndarray:
    """What every pixel takes over of the log evidence of its frame's tilt: they add up to it."""
    assert found.tilt is not None
    answered = (found.status & NO_ANSWER) == 0
    members = answered.astype(np.int64)
    if found.model.neighbours is not None:  # one result of a window stands for all of its pixels
        members = box_sum(members, found.model.neighbours)
    number = np.sum(answered, axis=tuple(range(-min(2, answered.ndim), 0)), keepdims=True)
    price = found.tilt.log_evidence.reshape(number.shape)
    return np.asarray(price * members / np.maximum(number, 1), found.log_evidence.dtype)


def _with_tilt(model: Model, found: Fit, tilt: Tilt) -> Fit:
    """The fit of the pixels, with the uncertainty and the price of the tilt."""
    kind = found.covariance.dtype
    answered = (found.status & NO_ANSWER) == 0
    evidence = found.log_evidence + shares(replace(found, tilt=tilt))
    follow = np.nan_to_num(tilt.response) * tilt.phase_std[..., None]
    total = found.covariance + (follow[..., :, None] * follow[..., None, :]).astype(kind)
    with np.errstate(invalid="ignore"):
        widths = np.sqrt(np.einsum("...ii->...i", total))
    status = found.status.copy()
    for i, name in enumerate(Parameters._fields):
        if name in model.dropped:
            widths[..., i] = np.nan
        elif name in model.free:
            wide = answered & (widths[..., i] > 0.5 * uniform_std(name))
            status |= np.where(wide, int(Status.unidentified(name)), 0).astype(status.dtype)
    return replace(
        found,
        model=model,
        std=Parameters(*(widths[..., i] for i in range(5))),
        covariance=total,
        log_evidence=evidence,
        status=status,
        tilt=tilt,
    )


def _invert(plane: TiltPlane, curvature: np.ndarray) -> tuple[np.ndarray, float]:
    """Covariance, and the log of the volume of the Gaussian; no direction is wider than before the data."""
    size = np.array([BENDS**0.5, *[1 / plane.scale] * (len(curvature) - 1)])
    values, axes = np.linalg.eigh(curvature / np.outer(size, size))
    values = np.maximum(values, 1.0)
    covariance = (axes / values) @ axes.T / np.outer(size, size)
    volume = 0.5 * len(size) * log(2 * pi) - 0.5 * float(np.sum(np.log(values))) - float(np.sum(np.log(size)))
    return covariance, volume


def _share(plane: TiltPlane, pixels: Pixels, place: _Place) -> float:
    """How much of the posterior of the plane lies around the maximum."""
    if not pixels.count:
        return 0.0
    assert place.spectrum is not None
    own = _invert(plane, place.curvature[:3, :3])[1] + float(plane.log_prior(place.coefficients[:3]))
    lead = place.height + own - _elsewhere(plane, place.spectrum, place.coefficients, place.height + own - SURE)
    if lead < SURE:
        # derivatives at one phase say little of the others: ask at them
        first = np.eye(len(place.coefficients))[0]
        values = [pixels.respond(place.coefficients + shift * first, None, None).value for shift in QUARTERS]
        waves = 0.5 * (values[0] - values[2]) + 0.5j * (values[1] - values[3])
        spectrum = spectrum_of(pixels.spread(waves * np.exp(2j * pixels.phase(place.coefficients))))
        height = float(np.sum(values[0] - np.mean(values, axis=0)))
        lead = height + own - _elsewhere(plane, spectrum, place.coefficients, -np.inf)
    return float(1 / (1 + np.exp(min(-lead, 700.0))))


def _elsewhere(plane: TiltPlane, spectrum: Spectrum, coefficients: np.ndarray, enough: float) -> float:
    """Log of the posterior mass of planes away from one, over that of pixels that say the same at all phases.

    An upper bound, where that is below ``enough``.
    """
    bound = spectrum.highest_far(coefficients[1:3]) + spectrum.log_prior_peak(plane.scale)
    bound += log(spectrum.cell * spectrum.size.size)
    if bound < enough:
        return bound
    far = ~spectrum.near(coefficients[1:3], FAR)
    return float(np.logaddexp.reduce(spectrum.log_mass(plane.scale)[far])) if far.any() else -np.inf
