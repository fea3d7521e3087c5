"""The verb ``select``: what a scene needs, by evidence."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ..checks import one_of_types
from ..fitting import fit
from ..model import Model
from ..noise import InferredNoise
from ..records import Measurement
from .records import Comparison
from .units import common_window
from .verb import compare

__all__ = ["infer_with", "select"]


def select(
    candidates: Mapping[str, Model],
    measurement: Measurement,
    regions: np.ndarray | None = None,
    prior: Mapping[str, float] | None = None,
    infer: Callable[[Model, Measurement], Any] = fit,
) -> Comparison:
    """What does this scene need? All candidates are inferred from the same data and compared, pooled over the scene.

    A part that a scene does not need costs evidence: its parameters spread their probability over values that the data
    exclude. The verdict names a candidate only if it is found (:func:`polinfer.compare`); while it is "undecided",
    take the simplest of those that are left.

    Parameters
    ----------
    candidates: two or more models by name. measurement: the data; a candidate that infers sigma is given them without.
    regions: integer labels, shape P: what every region needs by itself; negative ones belong to no region.
    prior: probability of every candidate before the data; None: equal.
    infer: what makes a result with an evidence of a model and data: :func:`polinfer.fit`, or a sampler such as
        ``functools.partial(polinfer.sample, rng=1)``, whose evidence has a known error.

    Notes
    -----
    An evidence is an answer to the priors too. That of D is an opinion about each single pixel: with the default one,
    of width 0.5, a scene of |D| = 0.01 at a noise of 0.02 is rightly described by D = 0, although its orderings can be
    told apart. Where small D are expected, offer a candidate that says so,
    ``priors={"diattenuation": TruncatedNormal(0, 0.02, -1, 1)}``.

    Raises
    ------
    ValueError, TypeError: fewer than two candidates, no models, two different windows; what ``infer`` raises.

    >>> import polinfer
    >>> states = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / 2**0.5
    >>> truth = polinfer.Parameters(np.zeros(30), 0.0, 1.2, 0.5, 0.2)
    >>> data = polinfer.simulate(polinfer.Model(), truth, states, sigma=0.05, rng=1)
    >>> candidates = {"retarder": Model(fixed={"diattenuation": 0.0}), "with diattenuation": Model()}
    >>> select(candidates, data).verdict
    'retarder'
    """
    if not isinstance(candidates, Mapping):
        raise TypeError(f"candidates must be a dict of models by name, got {type(candidates).__name__}.")
    if len(candidates) < 2:
        raise ValueError(f"candidates must hold at least two models, got {len(candidates)}.")
    for name, model in candidates.items():
        one_of_types(f"candidates[{name!r}]", model, (Model,), "pass Model(...).")
    one_of_types("measurement", measurement, (Measurement,), "pass a Measurement.")
    common_window(list(candidates.values()))
    found = {name: infer_with(infer, model, measurement) for name, model in candidates.items()}
    return compare(found, prior=prior, regions=regions)


def infer_with(infer: Callable[[Model, Measurement], Any], model: Model, measurement: Measurement) -> Any:
    """The result of a model; one that infers sigma is given the data without it."""
    if isinstance(model.noise, InferredNoise) and measurement.sigma is not None:
        measurement = replace(measurement, sigma=None)
    return infer(model, measurement)
