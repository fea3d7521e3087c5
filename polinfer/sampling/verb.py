"""The verb ``sample``: which sampler draws, and the draws put back into the frame."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ..checks import as_generator, integer, one_of_types
from ..degeneracy import nearest
from ..fitting import fit
from ..fitting.local_gaussian import equivalent
from ..fitting.tilt import shares
from ..model import Model
from ..noise import InferredNoise
from ..records import Fit, Measurement, Parameters, Status
from ..tilting import untilt
from .draws import Draws
from .ensemble import Ensemble, draw_ensemble
from .from_draws import bridged_evidence
from .gibbs import Gibbs, draw_gibbs, part_of, problem_of
from .raw import Raw
from .tilt import draw_coefficients, move

__all__ = ["Call", "begin", "draw", "sample", "spread", "status_of"]

LEAST = 4  # draws of a chain
POOR, FULL = 0.015, 4000  # nat, of an evidence by so many draws


def sample(
    model: Model,
    measurement: Measurement,
    sampler: Gibbs | Ensemble | None = None,
    chains: int = 4,
    draws: int = 1000,
    rng: int | np.random.Generator | None = None,
    progress: bool = False,
) -> Draws:
    """Draws from the posterior of every pixel.

    The density is ``p(parameters | data)``, in D, theta_D, eta, theta_eta, xi (radians), with gain and noise drawn
    along where they are unknown. Chains start around the most probable parameters. Of the eight equivalent parameter
    sets each draw is the one that is nearest to the most probable parameters of its pixel.

    Parameters
    ----------
    model: the scene. measurement: the data, pixel shape P.
    sampler: :class:`Gibbs` (None: with its default settings), all pixels at once, or :class:`Ensemble`, any model, one
        pixel after the other.
    chains: independent chains (ensembles) of each pixel, >= 1; four show whether they agree.
    draws: draws that are kept of each chain, >= 4.
    rng: seed, generator, or None: a fresh seed. It is recorded. A pixel's random numbers depend on the seed and on its
        place in the frame only.
    progress: show a progress bar.

    Returns
    -------
    Draws, parameters of shape ``(chain, draw, *P)``. ``status`` holds NOT_CONVERGED where the chains do not agree after
    all further sweeps, BAD_FIT and AT_EDGE from the most probable parameters, and UNIDENTIFIED flags from
    the fit; :meth:`Draws.summary` sets the latter anew from the draws.

    Raises
    ------
    ValueError: a model that the sampler cannot draw from, numbers out of range; as :func:`polinfer.fit` otherwise.
    TypeError: arguments of a wrong kind.

    Source: conditional distributions, ``docs/theory-inference.md``; ensembles, Foreman-Mackey et al., PASP 125, 306
    (2013).

    >>> import polinfer
    >>> truth = polinfer.Parameters(0.3, 0.5, 1.2, 0.4, 0.2)
    >>> states = np.array([[1, 1, 1], [1, 1j, -1]]) / 2**0.5
    >>> data = polinfer.simulate(polinfer.Model(), truth, states, sigma=0.01, rng=1)
    >>> found = sample(polinfer.Model(), data, draws=200, rng=1)
    >>> found.parameters.retardance.shape, bool(abs(found.summary().mean.retardance - 1.2) < 0.05)
    ((4, 200), True)
    """
    call = begin(model, measurement, sampler, chains, draws, rng)
    raw = next(draw(call, [np.arange(len(call.good))], progress))
    return _assemble(call, raw)


class Call(NamedTuple):
    """A checked call: ``found`` is the fit that the chains begin at, ``good`` the flat numbers of pixels with data."""

    model: Model
    measurement: Measurement
    sampler: Gibbs | Ensemble
    chains: int
    draws: int
    seed: int
    found: Fit
    good: np.ndarray


def begin(
    model: Model, measurement: Measurement, sampler: Any, chains: int, draws: int, rng: int | np.random.Generator | None
) -> Call:
    """Checks the arguments of :func:`sample` and fits."""
    one_of_types("model", model, (Model,), "pass Model(...).")
    one_of_types("measurement", measurement, (Measurement,), "pass a Measurement.")
    sampler = Gibbs() if sampler is None else sampler
    one_of_types("sampler", sampler, (Gibbs, Ensemble), "pass Gibbs(...) or Ensemble(...).")
    chains, draws = integer("chains", chains, low=1), integer("draws", draws, low=LEAST)
    generator, seed = as_generator(rng)
    if seed is None:
        seed = int(generator.integers(1 << 62))
    by_frame = isinstance(model.noise, InferredNoise) and not model.noise.integrated
    if by_frame and isinstance(sampler, Gibbs) and sampler.fallback is not None:
        raise ValueError("sampler has a fallback, but model infers one sigma of the frame, which Ensemble cannot draw; "
                         "use Gibbs() without one.")  # fmt: skip
    found = fit(model, measurement)
    good = np.flatnonzero(np.ravel(found.status & int(Status.MASKED | Status.NON_FINITE)) == 0)
    return Call(model, measurement, sampler, chains, draws, seed, found, good)


def draw(call: Call, parts: Iterable[np.ndarray], progress: bool) -> Iterator[Raw]:
    """Draws of the pixels ``good[part]``, part by part."""
    from tqdm import tqdm

    model, measurement, sampler, chains, draws, seed, found, good = call
    if found.tilt is not None:
        plain = call._replace(
            model=replace(model, misalignment=None),
            measurement=untilt(measurement, found.tilt.phase),
            found=replace(found, model=replace(model, misalignment=None), tilt=None),
        )
        parts = list(parts)
        coefficients = draw_coefficients(found, chains, draws, seed)
        for part, raw in zip(parts, draw(plain, parts, progress), strict=True):
            moved = _aligned(move(raw.parameters, found, coefficients, good[part]), found, good[part])
            yield raw._replace(parameters=moved)
        return
    if isinstance(sampler, Ensemble):
        for part in parts:
            raw = draw_ensemble(model, measurement, sampler, chains, draws, seed, progress, good[part], found)
            yield raw._replace(parameters=_aligned(raw.parameters, found, good[part]))
        return
    problem = problem_of(model, measurement, found, good)
    with tqdm(total=len(good), desc="sample", unit="pixel", disable=not progress) as bar:
        for part in parts:
            own = problem if len(part) == len(good) else part_of(problem, part)
            raw = draw_gibbs(own, good[part], sampler, chains, draws, seed, bar.update)
            yield _weighed(call, good[part], _handed_over(call, good[part], raw))


def _weighed(call: Call, pixels: np.ndarray, raw: Raw) -> Raw:
    """The evidence anew where its stated error is too large: long ridges, which no box around the draws resolves."""
    # of few draws every error is large
    poor = np.flatnonzero(raw.log_evidence_error > POOR * max(FULL / (call.chains * call.draws), 1) ** 0.5)
    if len(poor):
        drawn = Parameters(*(x[..., poor] for x in raw.parameters))
        value, error = bridged_evidence(call.model, call.measurement, call.found, pixels[poor], drawn, call.seed)
        better = error < raw.log_evidence_error[poor]
        raw.log_evidence[poor[better]], raw.log_evidence_error[poor[better]] = value[better], error[better]
    return raw


def _handed_over(call: Call, pixels: np.ndarray, raw: Raw) -> Raw:
    """The draws of ``Gibbs``, where its chains do not agree those of its fallback."""
    sampler, failed = call.sampler, np.flatnonzero(~raw.converged)
    if not isinstance(sampler, Gibbs) or sampler.fallback is None or len(failed) == 0:
        return raw
    other = replace(sampler.fallback, evidence=sampler.evidence)
    own = draw_ensemble(call.model, call.measurement, other, call.chains, call.draws, call.seed, False, pixels[failed],
                        call.found)  # fmt: skip
    own = own._replace(parameters=_aligned(own.parameters, call.found, pixels[failed]))

    def put(old: np.ndarray | None, new: np.ndarray | None) -> None:
        if old is not None:
            old[..., failed] = new

    for old, new in zip((*raw.parameters, *raw[1:]), (*own.parameters, *own[1:]), strict=True):
        put(old, new)
    return raw


def _aligned(parameters: Parameters, found: Fit, good: np.ndarray) -> Parameters:
    """Of the copies of every draw that the model can tell apart the one nearest to the fit."""
    reference = Parameters(*(np.nan_to_num(np.asarray(x, float).reshape(-1)[good]) for x in found.parameters))
    return nearest(equivalent(found.model, Parameters(*(np.asarray(x, float) for x in parameters))), reference)


def spread(values: np.ndarray, place: np.ndarray, pixels: int) -> np.ndarray:
    """Values ``(..., part)`` at the places of ``pixels`` pixels, NaN elsewhere."""
    if len(place) == pixels:
        return values
    frame = np.full((*values.shape[:-1], pixels), np.nan, values.dtype)
    frame[..., place] = values
    return frame


def status_of(found: Fit, place: np.ndarray, converged: np.ndarray) -> np.ndarray:
    """Status bits of the whole frame, flat: those of the fit, and whether the chains of the pixels ``place`` agree."""
    # whether the climb to the maximum converged says nothing about the draws
    status = np.ravel(found.status).astype(np.int32) & ~int(Status.NOT_CONVERGED)
    status[place] |= np.where(converged, 0, int(Status.NOT_CONVERGED)).astype(np.int32)
    return status


def _assemble(call: Call, raw: Raw) -> Draws:
    model, shape, good = call.model, call.measurement.shape, call.good

    def framed(values: np.ndarray | None) -> Any:
        if values is None:
            return None
        values = spread(np.asarray(values), good, int(np.prod(shape)))
        return values.reshape((*values.shape[:-1], *shape))

    values = {name: framed(getattr(raw.parameters, name)) for name in Parameters._fields}
    for name in model.dropped:
        values[name] = np.full_like(values[name], np.nan)
    evidence, tilt = framed(raw.log_evidence), None
    if call.found.tilt is not None:
        evidence = evidence + shares(call.found)
        tilt = draw_coefficients(call.found, call.chains, call.draws, call.seed)
    return Draws(
        model, call.measurement, Parameters(**values), evidence, framed(raw.log_evidence_error),
        status_of(call.found, good, raw.converged).reshape(shape), framed(raw.gain), framed(raw.sigma), call.seed,
        call.sampler, tilt,
    )  # fmt: skip
