"""Summaries of more pixels than draws fit into the memory: a part of the frame after the other, resumable."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..checks import one_of_types, real_number
from ..kept import Kept, fingerprint
from ..model import Model
from ..noise import InferredNoise
from ..records import Measurement, Parameters
from .ensemble import Ensemble
from .gibbs import Gibbs
from .summaries import Summary, summarise_draws
from .verb import Call, begin, draw, spread, status_of

__all__ = ["summarise"]

VALUES = 1 << 24  # draws of all parameters in memory at once
LEAST = 512  # pixels of a part


def summarise(
    model: Model,
    measurement: Measurement,
    sampler: Gibbs | Ensemble | None = None,
    chains: int = 4,
    draws: int = 1000,
    level: float = 0.68,
    rng: int | np.random.Generator | None = None,
    folder: str | Path | None = None,
    progress: bool = False,
) -> Summary:
    """Posterior means, widths and intervals of every pixel; the draws themselves are not kept.

    The same as ``sample(...).summary(level)``, but a part of the frame after the other: beside the measurement, its fit
    and the summary some hundred megabytes are needed, however large the frame. A pixel's draws depend on the seed and
    on its place in the frame only, not on the parts. No evidence is computed.

    Parameters
    ----------
    model, measurement, sampler, chains, draws, rng, progress: as in :func:`polinfer.sample`.
    level: share of the draws that an interval holds, 0 < level < 1.
    folder: where the summaries of finished parts are kept (made if absent), so that the same call goes on where it was
        interrupted; needs ``rng`` as a seed. None: nothing is kept.

    Returns
    -------
    Summary, shape P.

    Raises
    ------
    ValueError: InferredNoise of scope "frame", which ties all pixels; a folder that belongs to another call or holds a
        damaged file; a folder without a seed. TypeError and ValueError as :func:`polinfer.sample`.

    >>> import polinfer
    >>> truth = polinfer.Parameters(np.full((3, 4), 0.3), 0.5, 1.2, 0.4, 0.2)
    >>> states = np.array([[1, 1, 1], [1, 1j, -1]]) / 2**0.5
    >>> data = polinfer.simulate(polinfer.Model(), truth, states, sigma=0.01, rng=1)
    >>> found = summarise(polinfer.Model(), data, draws=200, rng=1)
    >>> found.mean.retardance.shape, bool(np.abs(found.mean.retardance - 1.2).max() < 0.05)
    ((3, 4), True)
    """
    level = real_number("level", level, above=0, high=1)
    if level == 1:
        raise ValueError("level must be < 1, got 1; the draws have no end that means anything.")
    one_of_types("model", model, (Model,), "pass Model(...).")
    if isinstance(model.noise, InferredNoise) and not model.noise.integrated:
        raise ValueError(
            "model has InferredNoise of scope 'frame': one sigma ties all pixels, which cannot be drawn in parts; use "
            "sample, or KnownNoise() and the sigma of a fit."
        )
    if folder is not None and not isinstance(rng, int | np.integer):
        raise ValueError(f"folder needs a seed, so that the same call can go on; got rng={rng!r}, pass an integer.")
    call = begin(model, measurement, sampler, chains, draws, rng)
    call = call._replace(sampler=replace(call.sampler, evidence=False))
    pixels = int(np.prod(measurement.shape))
    size = max(VALUES // (len(Parameters._fields) * call.chains * call.draws) // LEAST, 1) * LEAST
    begins = range(0, pixels, size)
    kept = None if folder is None else _kept(folder, call, level)
    done = [None if kept is None else kept.read(_part(number)) for number in range(len(begins))]
    todo = [number for number, part in enumerate(done) if part is None]
    # places within good of the pixels of each part that is still to be drawn
    places = [np.arange(*np.searchsorted(call.good, (begins[n], min(begins[n] + size, pixels)))) for n in todo]
    raws = draw(call, places, progress)
    for number, place in zip(todo, places, strict=True):
        raw, own = next(raws), slice(begins[number], min(begins[number] + size, pixels))
        status = status_of(call.found, call.good[place], raw.converged)[own]
        inside, count = call.good[place] - own.start, len(status)
        parameters = {name: spread(getattr(raw.parameters, name), inside, count) for name in Parameters._fields}
        for name in model.dropped:
            parameters[name] = np.full_like(parameters[name], np.nan)
        gain, sigma = (None if x is None else spread(x, inside, count) for x in (raw.gain, raw.sigma))
        part = summarise_draws(model, Parameters(**parameters), gain, sigma, status, level)
        done[number] = part
        if kept is not None:
            kept.write(_part(number), part)
    return Summary.join([part for part in done if part is not None], measurement.shape)


def _part(number: int) -> str:
    return f"part_{number:06d}"


def _kept(folder: str | Path, call: Call, level: float) -> Kept:
    """The folder of this call."""
    data = call.measurement
    arrays = (data.illumination, data.response, data.sigma, data.weight, data.mask)
    settings = (call.model, call.sampler, call.chains, call.draws, call.seed, level, [x is None for x in arrays])
    name = fingerprint(settings, tuple(np.asarray(x) for x in arrays if x is not None))
    return Kept(folder, name, (Summary, Parameters), "model, measurement, seed or setting")
