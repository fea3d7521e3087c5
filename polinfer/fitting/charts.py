"""Coordinates in which the optimiser sees no edge.

A bounded parameter is written as ``x = middle + half sin(u)``, so that a maximum on the bound is an ordinary maximum
in u. J depends on ``sqrt(1 - |D|)``, so D is first written as ``sin delta``, in which J is smooth. Angles on a circle
are not wrapped. The maximum sought stays that of the density in the parameters themselves.
"""

from __future__ import annotations

from math import asin

import jax
import jax.numpy as jnp
import numpy as np

from ..model import Model
from ..records import Parameters

__all__ = ["from_parameters", "to_parameters"]


def _bounds(model: Model, name: str) -> tuple[float, float] | None:
    bounds = model.bounds.get(name)
    if bounds is None or name != "diattenuation":
        return bounds
    return asin(bounds[0]), asin(bounds[1])


def to_parameters(model: Model, coordinates: jax.Array) -> Parameters:
    """Parameters (of the free ones; NaN for the others) of coordinates ``(..., free)``."""
    values = dict.fromkeys(Parameters._fields, jnp.full(coordinates.shape[:-1], jnp.nan, coordinates.dtype))
    for i, name in enumerate(model.free):
        value, bounds = coordinates[..., i], _bounds(model, name)
        if bounds is not None:
            middle, half = 0.5 * (bounds[0] + bounds[1]), 0.5 * (bounds[1] - bounds[0])
            value = middle + half * jnp.sin(value)
            if name == "diattenuation":
                value = jnp.sin(value)
            low, high = (jnp.asarray(bound, value.dtype) for bound in model.bounds[name])
            value = jnp.minimum(jnp.maximum(value, low), high)  # rounding must not leave the support
        values[name] = value
    return Parameters(**values)


def from_parameters(model: Model, parameters: Parameters) -> np.ndarray:
    """Coordinates ``(..., free)`` of parameters; values beyond a bound are moved onto it."""
    columns = []
    for name in model.free:
        value, bounds = np.asarray(getattr(parameters, name)), _bounds(model, name)
        if bounds is not None:
            if name == "diattenuation":
                value = np.arcsin(np.clip(value, -1, 1))
            middle, half = 0.5 * (bounds[0] + bounds[1]), 0.5 * (bounds[1] - bounds[0])
            value = np.arcsin(np.clip((value - middle) / half, -1, 1))
        columns.append(value)
    return np.stack(columns, axis=-1)
