"""The verb ``compare``: results of several models for the same data become probabilities and verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..checks import real_number
from ..noise import InferredNoise, KnownNoise
from ..records import Fit
from .cross_validation import leave_one_out
from .judgement import CERTAIN, UNDECIDED, Judgement, judge, probabilities
from .records import Comparison, PooledEvidence
from .units import NO_ANSWER, NO_DATA, units_of

__all__ = ["compare"]

LAPLACE = (
    "the evidence of a Fit is a Laplace approximation: its error is not known, about 0.3 nat a pixel and 0.1 nat on "
    "average where the posterior is as wide as a range, and does not average out over pixels"
)
UNSEEN = "a Fit does not hold its data: only their shape, mask and sigma could be checked to agree"
FRAME_SIGMA = "evidences are given the sigma of the frame that was found, not integrated over it"
NO_COMMON = (
    "no model is without diattenuation, which is what the orderings have in common: where D is within its noise and "
    "the states are not balanced, a verdict for one can be wrong; compare Model(fixed={'diattenuation': 0.0}) too"
)
OTHER_WINDOWS = "probabilities of single pixels are left out: with and without a window they are not of the same data"


def compare(
    results: Mapping[str, Any], prior: Mapping[str, float] | None = None, regions: np.ndarray | None = None
) -> Comparison:
    """Which model the data speak for: evidences of the same data under several models, pixel by pixel and pooled.

    With log evidences ``log Z_m`` and prior probabilities ``p_m`` the probability of a model in one pixel is
    ``p_m Z_m / sum_k p_k Z_k``; that of one model for the whole scene has the products of the Z over its pixels.

    Parameters
    ----------
    results: two or more by name, each a :class:`polinfer.Fit` or :class:`polinfer.Draws`, of the same measurement.
    prior: probability of every model before the data, by the same names, summing to 1. None: equal.
    regions: integer labels, shape P: every label is pooled for itself too. Negative ones belong to no region. With a
        window a tile belongs to the region of its centre.

    Returns
    -------
    Comparison. Pixels count in the pooled evidence if all models have an answer for them (not masked, finite,
    converged); other flags, such as a bad fit or a parameter that is not identified, exclude nothing. Where parameters
    are shared over a window, disjoint tiles are pooled, so that every datum counts once.

    The verdict is "undecided" while the best probability is below 0.95, or while the lead over another model does not
    stand out of the scatter of its terms: see :mod:`polinfer.comparison.judgement`.

    Where all results are draws, leave-one-out densities are a second opinion (:func:`leave_one_out`).

    Raises
    ------
    ValueError: fewer than two results, results of different data, two different windows, a prior that is no
    distribution, no evidence. TypeError: arguments of a wrong kind.

    Source: Jeffreys, Theory of Probability, 1961.

    >>> import polinfer
    >>> states = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / 2**0.5
    >>> models = {"retarder_first": polinfer.Model(), "polariser_first": polinfer.Model(polinfer.PolariserFirst())}
    >>> truth = polinfer.Parameters(np.full(30, 0.3), 0.4, 1.2, 0.5, 0.2)
    >>> data = polinfer.simulate(models["polariser_first"], truth, states, sigma=0.05, rng=1)
    >>> compare({name: polinfer.fit(model, data) for name, model in models.items()}).verdict
    'polariser_first'
    """
    given = _checked(results)
    names, records = tuple(given), list(given.values())
    log_prior = _log_prior(names, prior)
    evidence = np.stack([np.asarray(r.log_evidence, float) for r in records])
    error = np.stack([_error(r) for r in records])
    status = np.stack([np.asarray(r.status) for r in records])
    units = units_of([r.model for r in records], evidence, error, status)
    labels = _labels(regions, evidence.shape[1:])
    same = len({_window(r) for r in records}) == 1
    each = _pixels(evidence, status, log_prior) if same else np.full(evidence.shape, np.nan)
    opinions = [] if any(isinstance(r, Fit) for r in records) else [leave_one_out(r) for r in records]
    return Comparison(
        models=names,
        prior=np.exp(log_prior),
        log_evidence=evidence,
        log_evidence_error=error,
        probabilities=each,
        pixel_verdict=_pixel_verdict(names, each),
        status=np.bitwise_or.reduce(status, axis=0),
        scene=pooled_evidence(names, units.values, units.used, units.errors, log_prior),
        regions={
            int(label): pooled_evidence(
                names, units.values, units.used & (labels.ravel()[units.centre] == label), units.errors, log_prior
            )
            for label in np.unique(labels[labels >= 0])
        },
        second_opinion=_second_opinion(names, opinions, status) if opinions else None,
        leave_one_out=dict(zip(names, opinions, strict=True)) if opinions else {},
        notes=_notes(records, same),
    )


def pooled_evidence(
    names: tuple[str, ...], values: np.ndarray, used: np.ndarray, error: np.ndarray, log_prior: np.ndarray
) -> PooledEvidence:
    """Log evidences ``(model, units)`` of the units that are used, with their errors, as one record."""
    found: Judgement = judge(values[:, None], used[None], log_prior)
    choice = int(found.choice[0])
    own = values[:, used]
    count = own.shape[1]
    offset = own - own.mean(axis=1, keepdims=True) if count else own
    with np.errstate(invalid="ignore", divide="ignore"):
        spread = np.sum((offset[:, None] - offset[None]) ** 2, axis=-1) * np.divide(count, count - 1)
    return PooledEvidence(
        models=names,
        units=count,
        log_evidence=found.pooled[:, 0],
        error=np.sqrt(np.sum(error[:, used] ** 2, axis=1)),
        scatter=found.scatter[:, 0],
        probabilities=found.probability[:, 0],
        verdict=UNDECIDED if choice < 0 else names[choice],
        pair_scatter=np.sqrt(spread) if count > 1 else np.full((len(names),) * 2, np.nan),
    )


def _checked(results: Any) -> dict[str, Any]:
    if not isinstance(results, Mapping):
        raise TypeError(f"results must be a dict of fits or draws by name, got {type(results).__name__}.")
    if len(results) < 2:
        raise ValueError(f"results must hold at least two models to compare, got {len(results)}.")
    for name, result in results.items():
        if not all(hasattr(result, part) for part in ("model", "log_evidence", "status")):
            raise TypeError(f"results[{name!r}] must be a Fit or Draws, got {type(result).__name__}; fit or sample.")
        usable = np.asarray(result.status) & NO_ANSWER == 0
        if usable.any() and not np.isfinite(np.asarray(result.log_evidence)[usable]).any():
            raise ValueError(f"results[{name!r}] has no log evidence; use a sampler that computes it, or a fit.")
    found = {str(name): result for name, result in results.items()}
    first, *others = found
    for name in others:
        _same_data(first, found[first], name, found[name])
    return found


def _same_data(first: str, a: Any, second: str, b: Any) -> None:
    """Refuse results that cannot be of the same data."""

    def differ(what: str) -> ValueError:
        return ValueError(
            f"results[{first!r}] and results[{second!r}] have different {what}; infer from the same data."
        )

    if np.shape(a.status) != np.shape(b.status):
        raise differ(f"pixel shapes {np.shape(a.status)} and {np.shape(b.status)}")
    if np.any((np.asarray(a.status) ^ np.asarray(b.status)) & NO_DATA):
        raise differ("masks or finite pixels")
    seen = [getattr(r, "measurement", None) for r in (a, b)]
    if seen[0] is not None and seen[1] is not None:
        for part in ("response", "illumination", "sigma", "weight"):
            x, y = (getattr(m, part) for m in seen)
            # a model that infers sigma is given data without one
            if (part != "sigma" and (x is None) != (y is None)) or (
                x is not None and y is not None and not _alike(x, y)
            ):
                raise differ(f"{part}s")
    elif all(isinstance(r.model.noise, KnownNoise) for r in (a, b)):
        sigmas = [_sigma(r) for r in (a, b)]
        if all(s is not None for s in sigmas) and not _alike(*sigmas):
            raise differ("sigmas")


def _sigma(result: Any) -> Any:
    if isinstance(result, Fit):
        return result.sigma
    sigma = result.measurement.sigma
    return None if sigma is None else np.broadcast_to(sigma, np.shape(result.status))


def _alike(x: Any, y: Any) -> bool:
    """Equal to single precision, NaN where NaN."""
    x, y = np.asarray(x), np.asarray(y)
    try:
        return bool(np.allclose(x, y, rtol=1e-5, atol=0, equal_nan=True))
    except ValueError:
        return False


def _error(result: Any) -> np.ndarray:
    error = getattr(result, "log_evidence_error", None)
    shape = np.shape(result.log_evidence)
    return np.full(shape, np.nan) if error is None else np.broadcast_to(np.asarray(error, float), shape)


def _window(result: Any) -> tuple[int, int]:
    window = result.model.neighbours
    return (1, 1) if window is None else (window.rows, window.columns)


def _log_prior(names: tuple[str, ...], prior: Mapping[str, float] | None) -> np.ndarray:
    if prior is None:
        return np.full(len(names), -np.log(len(names)))
    if not isinstance(prior, Mapping):
        raise TypeError(f"prior must be a dict of probabilities by model name, got {type(prior).__name__}.")
    if set(prior) != set(names):
        raise ValueError(f"prior must name {', '.join(names)}, got {', '.join(map(str, prior))}.")
    values = np.array([real_number(f"prior[{name!r}]", prior[name], above=0) for name in names])
    if abs(values.sum() - 1) > 1e-6:
        raise ValueError(f"prior must sum to 1, got {values.sum():g}.")
    return np.log(values)


def _labels(regions: Any, shape: tuple[int, ...]) -> np.ndarray:
    if regions is None:
        return np.full(shape, -1)
    labels = np.asarray(regions)
    if labels.dtype.kind not in "iub":
        raise TypeError(f"regions must be integer labels, got {labels.dtype}.")
    if labels.shape != shape:
        raise ValueError(f"regions must have the pixel shape {shape}, got {labels.shape}.")
    return labels.astype(np.int64)


def _pixels(evidence: np.ndarray, status: np.ndarray, log_prior: np.ndarray) -> np.ndarray:
    answered = np.all((status & NO_ANSWER == 0) & np.isfinite(evidence), axis=0)
    found = probabilities(np.where(answered, evidence, 0.0), log_prior)
    return np.where(answered, found, np.nan)


def _pixel_verdict(names: tuple[str, ...], each: np.ndarray) -> np.ndarray:
    table = np.array([*names, UNDECIDED, ""])
    known = np.isfinite(each).all(axis=0)
    filled = np.where(known, each, 0.0)
    best = np.where(filled.max(axis=0) >= CERTAIN, filled.argmax(axis=0), len(names))
    return np.asarray(table[np.where(known, best, len(names) + 1)])


def _second_opinion(names: tuple[str, ...], opinions: list[Any], status: np.ndarray) -> PooledEvidence:
    density = np.stack([x.log_density for x in opinions])
    # densities of a pixel's own states: every pixel is a unit, whatever the models share
    flat = density.reshape(len(names), -1)
    used = np.all((status.reshape(len(names), -1) & NO_ANSWER == 0) & np.isfinite(flat), axis=0)
    even = np.full(len(names), -np.log(len(names)))
    return pooled_evidence(names, np.where(used, flat, 0.0), used, np.full(flat.shape, np.nan), even)


def _notes(records: list[Any], same: bool) -> tuple[str, ...]:
    notes = []
    if any(isinstance(r, Fit) for r in records):
        notes += [LAPLACE, UNSEEN]
    if any(isinstance(r.model.noise, InferredNoise) and not r.model.noise.integrated for r in records):
        notes.append(FRAME_SIGMA)
    with_polariser = {r.model.ordering for r in records if r.model.fixed.get("diattenuation") != 0}
    if len(with_polariser) > 1 and len(records) == sum(r.model.fixed.get("diattenuation") != 0 for r in records):
        notes.append(NO_COMMON)
    if not same:
        notes.append(OTHER_WINDOWS)
    return tuple(notes)
