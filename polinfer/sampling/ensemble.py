"""The ensemble sampler: emcee on the density of one pixel, for models whose conditionals have no closed form.

It takes any model, a user's own ordering and priors included, one pixel after the other. It is the slow route, and the
independent check of the quick one: of the model it uses the log density and nothing else. Walkers move in the
coordinates of :mod:`polinfer.sampling.charts`.

What goes in: a model, a measurement, :class:`Ensemble`. What comes out: :class:`polinfer.sampling.raw.Raw`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from ..checks import integer, one_of_types
from ..fitting.frames import fit
from ..fitting.generic import Prepared, prepare
from ..kept import fingerprint
from ..model import Model, as_device
from ..noise import InferredNoise
from ..records import Fit, Measurement, Parameters
from ..statistics import Statistics
from .bridge import DEFENCE, Bridge, Proposal, autocorrelation_time, defended, fit_mixture, halves_bridged
from .charts import Target, centre_of, periods
from .checkpoint import Checkpoint
from .nuisances import draw_nuisances
from .raw import Raw

__all__ = ["Ensemble", "draw_ensemble"]

CANDIDATES = 2048  # points that are weighed to find where the walkers start
LEAST_WEIGHT = 0.05  # share of the candidates that must keep some weight
COMPONENTS = 3
# Not DESnookerMove: up to emcee 3.1.6 at least its step is not reversible, and draws of a Gaussian come out too narrow.
MOVES: tuple[tuple[str, dict[str, float], float], ...] = (
    ("DEMove", {}, 0.4),
    ("DEMove", {"gamma0": 1.0}, 0.05),
    ("StretchMove", {}, 0.25),
)
MIXTURE = 0.3  # share of the steps that propose from the mixture found at the start
LEAST_EFFECTIVE, LEAST_TIMES, MOST_R_HAT = 100.0, 5.0, 1.05


@dataclass(frozen=True)
class Ensemble:
    """Ensembles of walkers (emcee), pixel by pixel.

    Each chain of :func:`polinfer.sample` is an ensemble of its own, with its own start and random numbers. Its draws
    are the walkers' places, one after the other in time: draw ``i`` is walker ``i % walkers`` at record
    ``i // walkers``, and records lie ``thin`` steps apart. Neighbouring draws are thus different walkers, and a walker
    meets itself ``walkers`` draws later; ``thin`` must be long enough for it to have forgotten by then.

    Parameters
    ----------
    walkers: even, at least twice the number of free parameters (10 where all are free).
    warmup: steps before the first record, >= 0.
    thin: steps between records, >= 1. With the default one record is nearly independent of the next.
    backend: folder (made if absent) in which the state is kept while sampling, so that the same call goes on where it
        was interrupted, with the same result; None: nothing is kept.
    evidence: whether to compute the log evidence.

    Raises
    ------
    ValueError, TypeError: values out of range or of a wrong kind.

    Source: Foreman-Mackey et al., PASP 125, 306 (2013); ter Braak and Vrugt, Statistics and Computing 18, 435 (2008).

    >>> Ensemble(walkers=64).walkers
    64
    """

    walkers: int = 32
    warmup: int = 200
    thin: int = 10
    backend: str | Path | None = None
    evidence: bool = True

    def __post_init__(self) -> None:
        for name, low in (("walkers", 4), ("warmup", 0), ("thin", 1)):
            object.__setattr__(self, name, integer(name, getattr(self, name), low=low))
        if self.walkers % 2:
            raise ValueError(f"walkers must be even (one half moves along the other), got {self.walkers}.")
        if self.backend is not None:
            one_of_types("backend", self.backend, (str, Path), "pass the path of a folder, or None.")
            object.__setattr__(self, "backend", str(self.backend))  # can be stored
        if not isinstance(self.evidence, bool):
            raise TypeError(f"evidence must be True or False, got {type(self.evidence).__name__}.")


class _Chain(NamedTuple):
    """Places ``(time, walker, k)`` and log densities ``(time, walker)``."""

    places: np.ndarray
    values: np.ndarray


class _Pixel(NamedTuple):
    """Results of one pixel; the fields of :class:`Raw` without the axis of pixels."""

    parameters: Parameters
    gain: np.ndarray | None
    sigma: np.ndarray | None
    evidence: Bridge
    converged: bool


def draw_ensemble(
    model: Model,
    measurement: Measurement,
    sampler: Ensemble,
    chains: int,
    draws: int,
    seed: int,
    progress: bool = False,
    good: np.ndarray | None = None,
    found: Fit | None = None,
) -> Raw:
    """Draws from the posterior of the pixels ``good``, flat indices; None: all that are neither masked nor non-finite.

    ``found`` are the most probable parameters that the walkers start around, None: fit them here.
    ``chains`` ensembles are run for each pixel, and ``draws`` draws of each are kept (see :class:`Ensemble` for their
    order). The random numbers of an ensemble come from ``SeedSequence([seed, flat index of the pixel, ensemble])``, so
    they do not depend on the other pixels. With neighbours the parameters are those of the window around each pixel;
    gain and sigma are those of the pixel itself, drawn given the parameters (None where the model has none to infer).
    ``converged``: of every coordinate, split R-hat is below 1.05, there are at least 100 effective draws, and the
    records are five autocorrelation times of a walker long. Then the evidence comes from bridge sampling, each
    half of the ensembles with a mixture fitted to the other half; else it is NaN, as its error could not be trusted.

    Raises
    ------
    ValueError: too few walkers, nothing free, InferredNoise of scope "frame" (one sigma for all pixels cannot be drawn
    pixel by pixel), a backend that belongs to another call. As :func:`polinfer.fit` otherwise.
    """
    _check(model, sampler)
    prepared = prepare(model, measurement, model.noise.integrated)
    chosen = prepared.good if good is None else np.asarray(good, np.int64)
    found = _fit(model, measurement, chosen) if found is None else found
    folder = None if sampler.backend is None else Path(sampler.backend)
    bar = _bar(progress, len(chosen) * chains)
    pixels = []
    for pixel in chosen:
        statistics = jax.tree.map(lambda x: x[0], prepared.pooled.take(np.array([pixel])))
        centre, covariance = _start(model, found, int(pixel))
        target = Target(model, as_device(statistics, np.complex128), centre, sampler.walkers // 2)
        name = fingerprint(model, replace(sampler, backend=None, evidence=True), seed, int(pixel), statistics)
        runs = []
        for chain in range(chains):
            kept = None if folder is None else Checkpoint(folder / f"pixel_{pixel}_ensemble_{chain}.npz", name)
            stream = np.random.SeedSequence([seed, int(pixel), chain])
            runs.append(_run(target, covariance, sampler, -(-draws // sampler.walkers), stream, kept))
            bar.update(1)
        own = Statistics(*(x[pixel] for x in prepared.pooled.own))
        pixels.append(_describe(target, own, runs, draws, [seed, int(pixel)], sampler.evidence))
    bar.close()
    return _assemble(pixels, prepared, chains, draws)


def _check(model: Model, sampler: Ensemble) -> None:
    one_of_types("sampler", sampler, (Ensemble,), "pass Ensemble(...).")
    if not model.free:
        raise ValueError("model has no free parameter to sample; fix fewer of them.")
    if sampler.walkers < 2 * len(model.free):
        raise ValueError(
            f"walkers must be at least {2 * len(model.free)}, twice the number of free parameters, got "
            f"{sampler.walkers}; pass more walkers."
        )
    if isinstance(model.noise, InferredNoise) and not model.noise.integrated:
        raise ValueError(
            "model has InferredNoise of scope 'frame', one sigma for all pixels, but Ensemble draws pixel by pixel; "
            "use Gibbs(), or KnownNoise() and the sigma of a fit in the measurement."
        )


def _bar(progress: bool, total: int) -> Any:
    from tqdm import tqdm

    return tqdm(total=total, desc="sample", unit="ensemble", disable=not progress)


def _fit(model: Model, measurement: Measurement, chosen: np.ndarray) -> Fit:
    """Maxima of the chosen pixels at least."""
    if model.neighbours is None and len(chosen):
        mask = np.zeros(int(np.prod(measurement.shape)), bool)
        mask[chosen] = True
        measurement = replace(measurement, mask=mask.reshape(measurement.shape))
    return fit(model, measurement)


def _start(model: Model, found: Fit, pixel: int) -> tuple[np.ndarray, np.ndarray]:
    """Centre ``(k,)`` and covariance ``(k, k)`` of a pixel in the coordinates, widths no larger than the ranges.

    They are rounded, so that the last digits of a fit, which depend on how many pixels it held, change nothing.
    """
    centre = centre_of(model, Parameters(*(x.reshape(-1)[pixel] for x in found.parameters)))
    columns = [Parameters._fields.index(name) for name in model.free]
    covariance = np.array(found.covariance.reshape(-1, 5, 5)[pixel], float)[np.ix_(columns, columns)]
    widest = np.where(np.isfinite(periods(model)), periods(model) / 4, 0.8)
    if "diattenuation" in model.free:
        k = model.free.index("diattenuation")
        slope = max(np.cos(centre[k]), 0.05)
        covariance[k] /= slope
        covariance[:, k] /= slope
    if not np.isfinite(covariance).all():
        covariance = np.diag(widest**2)
    width = np.sqrt(np.maximum(np.diag(covariance), 1e-24))
    correlation = np.round(covariance / np.outer(width, width), 2)
    np.fill_diagonal(correlation, 1.0)
    values, axes = np.linalg.eigh(correlation)
    correlation = (axes * np.maximum(values, 0.02)) @ axes.T
    width = np.array([float(f"{x:.3g}") for x in np.minimum(width, widest)])
    digits = 10.0 ** np.floor(np.log10(width) - 1)
    return np.round(centre / digits) * digits, correlation * np.outer(width, width)


def _run(
    target: Target,
    covariance: np.ndarray,
    sampler: Ensemble,
    records: int,
    stream: np.random.SeedSequence,
    kept: Checkpoint | None,
) -> _Chain:
    """One ensemble: start, warm up, record; or go on from a checkpoint."""
    from emcee import State

    first, later = stream.spawn(2)
    start, proposal = _spread(target, covariance, sampler.walkers, np.random.default_rng(first))
    engine = _engine(target, proposal, start.shape)
    state = State(start, random_state=np.random.RandomState(np.random.MT19937(later)).get_state())
    places = np.empty((records, *start.shape))
    values = np.empty((records, len(start)))
    done, warm = 0, False
    if kept is not None and (earlier := kept.read()) is not None:
        done, warm = min(len(earlier.places), records), True
        places[:done], values[:done] = earlier.places[:done], earlier.values[:done]
        state = State(earlier.now, log_prob=earlier.now_values, random_state=earlier.random_state)
    if not warm and sampler.warmup:
        state = next(_advance(engine, state, 1, sampler.warmup))
    for step in _advance(engine, state, records - done, sampler.thin):
        places[done], values[done] = step.coords, step.log_prob
        done += 1
        if kept is not None:
            kept.write(places[:done], values[:done], step, last=done == records)
    return _Chain(places, values)


def _engine(target: Any, proposal: Proposal, shape: tuple[int, ...]) -> Any:
    """emcee with our mix of moves."""
    from emcee import EnsembleSampler, moves

    mixed = [(getattr(moves, name)(**settings), share) for name, settings, share in MOVES]
    mixed.append((moves.MHMove(_independent(proposal)), MIXTURE))
    return EnsembleSampler(*shape, target, moves=mixed, vectorize=True)


def _advance(engine: Any, state: Any, records: int, thin: int) -> Iterator[Any]:
    return iter(
        engine.sample(state, iterations=records, thin_by=thin, store=False, skip_initial_state_check=True)
        if records
        else ()
    )


def _independent(proposal: Proposal) -> Any:
    """A move for emcee that proposes from the mixture whatever the place."""

    def move(places: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(random.randint(1 << 32, size=4, dtype=np.uint64))
        new = proposal.draw(rng, len(places))
        density = proposal.log_density(np.concatenate([places, new]))
        return new, density[: len(places)] - density[len(places) :]

    return move


def _spread(
    target: Target, covariance: np.ndarray, walkers: int, rng: np.random.Generator
) -> tuple[np.ndarray, Proposal]:
    """Places of the walkers, ``(walkers, k)``, and a mixture that resembles the density.

    Candidates around the maximum and from the prior are drawn in proportion to the density, twice: the second time
    from a mixture that resembles the first ones. Modes that the fit has not found are thus found if the prior does.
    """

    root = np.linalg.cholesky(covariance)
    around = np.full(2, 0.5), np.stack([target.centre] * 2), np.stack([root, 2 * root])
    proposal = defended(target, around, 0.4)
    for _ in range(2):
        points = proposal.draw(rng, CANDIDATES)
        values, prior = target.evaluate(points)
        logs = _temper(values - proposal.log_density(points, prior))
        keys = logs + rng.gumbel(size=len(logs))  # the largest are a draw without replacement
        order = np.argsort(-keys)
        weights = np.exp(logs - np.logaddexp.reduce(logs))
        sample = points[rng.choice(len(points), size=CANDIDATES // 4, p=weights)]
        proposal = defended(target, fit_mixture(sample, COMPONENTS, rng), DEFENCE)
    return points[order[:walkers]], proposal


def _temper(logs: np.ndarray) -> np.ndarray:
    """Log weights, levelled until they are spread over enough candidates."""
    logs = np.where(np.isfinite(logs), logs, -np.inf)
    power = 1.0
    while power > 1e-9:
        weights = np.exp(power * (logs - logs.max()))
        if weights.sum() ** 2 / np.sum(weights**2) >= LEAST_WEIGHT * len(logs):
            break
        power *= 0.7
    return power * logs


def _describe(target: Target, own: Statistics, runs: list[_Chain], draws: int, seed: list[int], wanted: bool) -> _Pixel:
    """Parameters, gain and sigma ``(chain, draw)``, evidence and convergence of one pixel."""
    places, values = (np.stack(x) for x in zip(*runs, strict=True))
    chains, k = len(runs), places.shape[-1]
    # drawn with streams of their own, after all else: the chains do not depend on them
    streams = [np.random.default_rng(np.random.SeedSequence([*seed, chain, 1])) for chain in range(chains)]
    whole = [target.unfold(x.reshape(-1, k), rng) for x, rng in zip(places, streams, strict=True)]
    parameters = Parameters(*(np.stack(x) for x in zip(*whole, strict=True)))
    matrices = np.asarray(target.model.jones(parameters), complex)
    kept = Parameters(*(x[:, :draws] for x in parameters))
    drawn = [draw_nuisances(target.model, own, m[:draws], r) for m, r in zip(matrices, streams, strict=True)]
    gain, sigma = (None if x[0] is None else np.stack(x) for x in zip(*drawn, strict=True))
    converged = _converged(places, values)
    evidence = Bridge(np.nan, np.nan)
    if converged and wanted:
        stream = np.random.SeedSequence([*seed, chains, 2])
        evidence = halves_bridged(target, places, values, stream, COMPONENTS)
    return _Pixel(kept, gain, sigma, evidence, converged)


def _converged(places: np.ndarray, values: np.ndarray) -> bool:
    """Whether the coordinates agree between the ensembles, and walkers have forgotten where they were."""
    series = np.concatenate([places, values[..., None]], axis=-1)
    records = values.shape[1]
    length = records // 2
    if length < 2:
        return False  # so few records say nothing
    halves = series[:, : 2 * length].reshape(2 * len(values), -1, series.shape[-1])
    for i in range(series.shape[-1]):
        time = autocorrelation_time(series[..., i])
        forgotten = records >= LEAST_TIMES * time and values.size >= LEAST_EFFECTIVE * time
        within, between = halves[..., i].var(axis=1).mean(), halves[..., i].mean(axis=1).var(ddof=1)
        if not forgotten or not within + between <= MOST_R_HAT**2 * within:
            return False
    return True


def _assemble(pixels: list[_Pixel], prepared: Prepared, chains: int, draws: int) -> Raw:
    """The pixels side by side, in the precision of a fit of the measurement."""
    complex_type = jax.dtypes.canonicalize_dtype(prepared.measurement.response.dtype)
    real_type = np.zeros((), complex_type).real.dtype
    shape = (chains, draws, len(pixels))

    def beside(columns: list[np.ndarray], dtype: Any) -> np.ndarray:
        return np.stack(columns, axis=-1).astype(dtype) if columns else np.empty(shape, dtype)

    def nuisance(name: str, dtype: Any, inferred: bool) -> np.ndarray | None:
        return beside([getattr(p, name) for p in pixels], dtype) if inferred else None

    fields = Parameters._fields
    return Raw(
        Parameters(*(beside([getattr(p.parameters, name) for p in pixels], real_type) for name in fields)),
        nuisance("gain", complex_type, prepared.model.gain is not None),
        nuisance("sigma", real_type, prepared.model.noise.integrated),
        np.array([p.evidence.log_evidence for p in pixels], real_type),
        np.array([p.evidence.error for p in pixels], real_type),
        np.array([p.converged for p in pixels], bool),
    )
