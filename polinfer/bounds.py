"""The least uncertainty that any unbiased estimate can have (Cramer-Rao)."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .checks import broadcast, complex_array, one_of_types, real_array
from .elements import multiply
from .model import Model
from .records import Parameters

__all__ = ["cramer_rao_bound"]


@partial(jax.jit, static_argnums=0)
def _jacobian(model: Model, points: jax.Array, illumination: jax.Array) -> jax.Array:
    """Derivatives of the real data with respect to the free parameters and the gain, (pixels, data, unknowns)."""
    count = len(model.free)

    def data(x: jax.Array, states: jax.Array) -> jax.Array:
        values = dict.fromkeys(Parameters._fields, jnp.zeros((), x.dtype))
        values |= {name: x[i] for i, name in enumerate(model.free)}
        field = multiply(model.jones(Parameters(**values)), states)
        if model.known_gain.real_parameters == 1:
            field = jnp.exp(1j * x[count]) * field
        elif model.known_gain.real_parameters == 2:
            field = (1 + jax.lax.complex(x[count], x[count + 1])) * field
        return jnp.concatenate([jnp.real(field).ravel(), jnp.imag(field).ravel()])

    return jax.vmap(jax.jacfwd(data))(points, illumination)


def cramer_rao_bound(model: Model, parameters: Parameters, illumination: Any, sigma: Any) -> Parameters:
    """Standard deviations that no unbiased estimate can undercut, for each parameter.

    The square roots of the diagonal of the inverse Fisher information
    ``F_ij = (2 / sigma^2) Re <d(g J U)/dp_i, d(g J U)/dp_j>``; an unknown gain is part of p, taken at g = 1
    (for another amplitude divide sigma by it). Priors do not enter.

    Parameters
    ----------
    model: ordering, gain and fixed parameters. parameters: of shape P, radians. illumination: complex ``(*P, 2, n)``.
    sigma: > 0, broadcasts to P.

    Returns
    -------
    Parameters of shape P: radians, 0 for fixed parameters, inf for what the data do not determine.

    Raises
    ------
    ValueError, TypeError: arguments that do not fit together, out of range or not finite.

    >>> truth = Parameters(0.0, 0.0, 1.0, 0.4, 0.2)
    >>> states = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / 2**0.5
    >>> bound = cramer_rao_bound(Model(), truth, states, sigma=0.01)
    >>> round(float(bound.diattenuation) / 0.01, 3), float(bound.diattenuation_angle)
    (0.816, inf)
    """
    one_of_types("model", model, (Model,), "pass Model(...).")
    one_of_types("parameters", parameters, (Parameters,), "pass Parameters(...).")
    values = {n: real_array(f"parameters.{n}", getattr(parameters, n), finite=True) for n in model.free}
    illumination = complex_array("illumination", illumination, trailing=(2, None), finite=True)
    sigma = real_array("sigma", sigma, above=0, finite=True)
    shape = broadcast(
        **{f"parameters.{name}": x.shape for name, x in values.items()},
        illumination=illumination.shape[:-2],
        sigma=sigma.shape,
    )
    count = len(model.free)
    extra = model.known_gain.real_parameters
    points = np.zeros((*shape, count + extra))
    slope = np.ones((*shape, count + extra))
    clipped = np.zeros(shape, bool)
    for i, name in enumerate(model.free):
        points[..., i] = values[name]
        if name == "diattenuation":
            # at |D| = 1 the derivative by D is infinite, by delta (D = sin delta) it is not: just inside it is the same
            inside = 1 - float(jnp.finfo(jnp.result_type(float)).eps) ** 0.5
            points[..., i] = np.clip(points[..., i], -inside, inside)
            clipped = np.broadcast_to(np.abs(values[name]) > inside, shape)
            slope[..., i] = np.sqrt(1 - points[..., i] ** 2)
    states = np.broadcast_to(illumination, (*shape, *illumination.shape[-2:]))
    jacobian = np.asarray(
        _jacobian(model, points.reshape(-1, count + extra), states.reshape(-1, *states.shape[-2:])), float
    )
    jacobian = jacobian * slope.reshape(-1, 1, count + extra)
    _, singular, axes = np.linalg.svd(jacobian, full_matrices=False)
    eps = np.finfo(jnp.result_type(float)).eps
    # numbers of data below those of unknowns leave directions without any singular value
    missing = np.maximum(0.0, 1.0 - np.sum(axes**2, axis=-2))
    # what vanishes like sqrt(1 - |D|) towards |D| = 1 is still eps^(1/4) just inside
    least = np.where(clipped, 10 * eps**0.25, 100 * eps).reshape(-1, 1)
    lost = singular <= least * singular.max(axis=-1, keepdims=True)
    inverse = np.where(lost, 0, 1 / np.where(lost, 1, singular))
    variance = 0.5 * np.sum((axes * inverse[..., None]) ** 2, axis=-2)
    missing = missing + np.sum(axes**2 * lost[..., None], axis=-2)
    std = np.where(missing > 1e-6, np.inf, np.sqrt(variance)).reshape(*shape, -1) * sigma[..., None]
    result = {name: np.zeros(shape) for name in model.fixed} | {name: np.full(shape, np.inf) for name in model.dropped}
    result |= {name: std[..., i] for i, name in enumerate(model.free)}
    if "diattenuation" in model.free:
        result["diattenuation"] = result["diattenuation"] * np.sqrt(1 - np.square(values["diattenuation"]))
    return Parameters(**result)
