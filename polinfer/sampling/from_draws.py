"""Evidence of single pixels from draws of any sampler, by bridge sampling: half a second a pixel of 4000 draws.

The draws are moved into the coordinates of :mod:`polinfer.sampling.charts`, where the evidence is the integral of one
density without edges, to the copies and turns that the shares there give them. Used where the identity of
:mod:`polinfer.sampling.gibbs.evidence` is uncertain: long ridges, which no box around the draws resolves.
"""

from __future__ import annotations

import jax
import numpy as np

from ..fitting.generic import prepare
from ..model import Model, as_device
from ..records import Fit, Measurement, Parameters
from .bridge import halves_bridged
from .charts import Target, centre_of, into_chart

__all__ = ["bridged_evidence"]

COMPONENTS, POINTS = 8, 8  # of the mixture, and how many times as many points from it as draws


def bridged_evidence(
    model: Model, measurement: Measurement, found: Fit, pixels: np.ndarray, parameters: Parameters, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Log evidence (nats) and its standard error of the ``pixels`` (flat numbers), both ``(pixels)``.

    ``parameters`` are their draws ``(chain, draw, pixels)``, ``found`` the fit of the frame. The random numbers of a
    pixel depend on the seed and on its number.
    """
    prepared, result = prepare(model, measurement, model.noise.integrated), np.empty((2, len(pixels)))
    for k, pixel in enumerate(pixels):
        statistics = as_device(jax.tree.map(lambda x: x[0], prepared.pooled.take(np.array([pixel]))), np.complex128)
        centre = centre_of(model, Parameters(*(np.asarray(x.reshape(-1)[pixel], float) for x in found.parameters)))
        target, stream = Target(model, statistics, centre, 16), np.random.SeedSequence([seed, int(pixel), 3])
        drawn = Parameters(*(np.asarray(x[..., k], float) for x in parameters))
        shape = drawn.diattenuation.shape
        first, second = stream.spawn(2)
        flat = centre_of(model, Parameters(*(x.reshape(-1) for x in drawn)))
        places = into_chart(model, centre, flat, np.random.default_rng(first))
        values = target(places).reshape(*shape, 1)
        places = places.reshape(*shape, 1, -1)
        result[:, k] = halves_bridged(target, places, values, second, COMPONENTS, POINTS)
    return result[0], result[1]
