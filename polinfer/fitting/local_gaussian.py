"""The Gaussian around a maximum, and the evidence that follows from it (Laplace)."""

from __future__ import annotations

from functools import partial
from math import log, pi, sqrt
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..degeneracy import orbit
from ..model import Model
from ..neighbours import Windowed
from ..records import PERIODS, RANGES, Parameters
from ..statistics import Statistics
from .newton import value_gradient_hessian

__all__ = [
    "Local",
    "derivatives",
    "describe",
    "distinct_copies",
    "equivalent",
    "invert",
    "log_density",
    "log_prior",
    "log_prior_ratio",
]


class Local(NamedTuple):
    """Per pixel: covariance of the free parameters, which of them are not identified, and the log evidence.

    ``curvature`` is the negative Hessian at the maximum, ``rounding`` the precision that it was computed in, and
    ``on_bound`` says where the covariance is that of a density cut off by a bound.
    """

    covariance: np.ndarray
    unidentified: np.ndarray
    log_evidence: np.ndarray
    curvature: np.ndarray
    rounding: float
    on_bound: np.ndarray


def uniform_std(name: str) -> float:
    """Standard deviation of a uniform distribution over the range of a parameter."""
    low, high = getattr(RANGES, name)
    return (high - low) / sqrt(12)


def distinct_copies(model: Model) -> np.ndarray:
    """Which of the eight copies a model with fixed parameters can tell apart, ``(8,)`` bool."""
    generic = dict(zip(Parameters._fields, (0.37, 0.41, 1.13, 0.29, 0.53), strict=True))
    generic |= dict.fromkeys(model.dropped, 0.0) | model.fixed
    copies = orbit(Parameters(**generic))
    keep = np.ones(8, bool)
    for name, value in model.fixed.items():
        difference = getattr(copies, name) - value
        period = getattr(PERIODS, name) if name != "retardance" or model.known_gain.free_phase else np.inf
        turns = np.round(difference / period) * period if np.isfinite(period) else 0.0
        keep &= np.abs(difference - turns) < 1e-9
    free = np.stack([getattr(copies, name) for name in model.free]) if model.free else np.zeros((1, 8))
    for i in range(8):
        same = np.all(np.abs(free[:, :i] - free[:, i : i + 1]) < 1e-9, axis=0) & keep[:i]
        keep[i] &= not same.any()
    return keep


def equivalent(model: Model, parameters: Parameters) -> Parameters:
    """The copies of ``parameters`` (pixels,) that the model can tell apart, ``(copies, pixels)``."""
    known = Parameters(*(np.where(np.isnan(x), np.zeros_like(x), x) for x in parameters))
    rows = distinct_copies(model)
    return Parameters(*(x[rows] for x in orbit(known)))


@partial(jax.jit, static_argnums=0)
def log_density(model: Model, parameters: Parameters, statistics: Statistics | Windowed) -> jax.Array:
    """Log posterior of parameters ``(copies, pixels)``."""
    return model.log_density(parameters, jax.tree.map(lambda x: x[None], statistics))


# A direction cannot hold more volume than its range: sqrt(2 pi / curvature) <= sqrt(12) uniform standard deviations.
RANGE_CURVATURE = 2 * pi / 12


def invert(curvature: np.ndarray, eps: float, least: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Covariance, log of the Gaussian's volume ``log sqrt(det(2 pi C))``, and which parameters are flat.

    The matrix, in units in which 1 is "no information", is brought to unit diagonal first, which keeps the digits of
    small entries beside large ones. Directions without positive curvature are given a width of 1, and the parameter
    that they mostly consist of is called flat. No direction is given less curvature than ``least``.
    """
    size = np.sqrt(np.maximum(np.abs(np.einsum("...ii->...i", curvature)), 1e-9))
    values, axes = np.linalg.eigh(curvature / (size[..., :, None] * size[..., None, :]))
    directions = axes / size[..., :, None]
    lost = values < 30 * eps
    longest = np.max(directions**2, axis=-2)
    values = np.maximum(np.where(lost, longest, values), least * longest)
    covariance = np.einsum("...ij,...j,...kj->...ik", directions, 1 / values, directions)
    flat = np.zeros(size.shape, bool)
    leading = np.argmax(np.abs(directions), axis=-2)
    for k in range(size.shape[-1]):
        flat |= lost[..., k, None] & (leading[..., k, None] == np.arange(size.shape[-1]))
    log_volume = 0.5 * size.shape[-1] * log(2 * pi) - 0.5 * np.log(values).sum(-1) - np.log(size).sum(-1)
    return covariance, log_volume, flat


@partial(jax.jit, static_argnums=0)
def log_prior(model: Model, parameters: Parameters) -> jax.Array:
    """Log prior density, compiled as a whole: of its twenty operations each would be compiled for itself."""
    return model.log_prior(parameters)


def log_prior_ratio(model: Model, parameters: Parameters) -> np.ndarray:
    """``log sum_c p(copy c) / p(parameters)`` over the equivalent copies: what their evidence adds to that of one."""
    priors = np.asarray(log_prior(model, equivalent(model, parameters)), float)
    with np.errstate(invalid="ignore"):
        return np.nan_to_num(np.logaddexp.reduce(priors, axis=0) - np.asarray(log_prior(model, parameters), float))


@partial(jax.jit, static_argnums=0)
def derivatives(
    model: Model, points: jax.Array, statistics: Statistics | Windowed
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Log posterior, gradient and Hessian in the free parameters at ``points`` (copies, pixels, free)."""

    def one(point: jax.Array, data: Statistics | Windowed) -> tuple[jax.Array, jax.Array, jax.Array]:
        def function(x: jax.Array) -> jax.Array:
            values = dict.fromkeys(Parameters._fields, jnp.zeros((), x.dtype))
            values |= {name: x[i] for i, name in enumerate(model.free)}
            return model.log_density(Parameters(**values), data)

        return value_gradient_hessian(function, point)

    return jax.vmap(jax.vmap(one), in_axes=(0, None))(points, statistics)


def describe(model: Model, parameters: Parameters, statistics: Statistics | Windowed) -> Local:
    """Covariance at ``parameters`` (pixels,) and the evidence summed over the equivalent copies.

    Every copy is a maximum of the likelihood but not of the prior, so its Gaussian integral is that of a parabola with
    slope g: ``log p + g^T C g / 2 + (k log 2 pi + log |C|) / 2``.
    """
    copies = equivalent(model, parameters)
    stack = np.stack([getattr(copies, name) for name in model.free], axis=-1)
    points = np.concatenate([np.stack([getattr(parameters, name) for name in model.free], axis=-1)[None], stack])
    value, gradient, hessian = (np.asarray(x, float) for x in derivatives(model, points, statistics))
    usable = np.isfinite(value) & np.isfinite(gradient).all(-1) & np.isfinite(hessian).all((-1, -2))
    width = np.array([uniform_std(name) for name in model.free])
    # in units of the uniform width, a curvature of 1 is what no data at all would leave
    scaled = np.where(usable[..., None, None], -hessian * width[:, None] * width, np.eye(len(width)))
    eps = float(np.finfo(points.dtype).eps)
    covariance, _, flat = invert(scaled, eps, 0.0)
    within_range, log_volume, _ = invert(scaled, eps, RANGE_CURVATURE)
    unidentified = (np.sqrt(np.einsum("...ii->...i", covariance)) > 0.5) | flat
    slope = gradient * width
    lift = 0.5 * np.einsum("...i,...ij,...j->...", slope, within_range, slope)
    log_volume = log_volume + np.log(width).sum()
    integral = np.where(np.isfinite(value), value + np.where(usable, lift, 0) + log_volume, -np.inf)[1:]
    evidence = np.logaddexp.reduce(integral, axis=0)
    result = covariance[0] * width[:, None] * width
    result[~usable[0]] = np.nan
    curvature = np.where(usable[0][:, None, None], -hessian[0], np.nan)
    return Local(result, unidentified[0], evidence, curvature, eps, np.zeros(len(evidence), bool))
