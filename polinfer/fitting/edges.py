"""Maxima on or near a bound, where a Gaussian is the wrong shape.

The bounded parameter is integrated numerically, the others as a Gaussian at every node. The nodes are evenly spaced in
the logarithm of the distance from the bound: the density may fall off on any scale there, and for D as
``exp(-b sqrt(1 - |D|))``.
"""

from __future__ import annotations

from math import log
from typing import NamedTuple

import numpy as np

from ..model import Model
from ..neighbours import Windowed
from ..records import Parameters
from ..statistics import Statistics
from .local_gaussian import RANGE_CURVATURE, derivatives, invert, log_density, log_prior_ratio, uniform_std

__all__ = ["Edge", "integrate"]

NODES = 97


class Edge(NamedTuple):
    """Per pixel: second moments about the maximum of the free parameters, and the log evidence."""

    moments: np.ndarray
    log_evidence: np.ndarray


def _distances(dtype: np.dtype, span: float) -> tuple[np.ndarray, float]:
    lowest = log(1e-13 if dtype == np.float64 else 1e-6)
    grid = np.linspace(lowest, 0.0, NODES)
    return span * np.exp(grid), grid[1] - grid[0]


def integrate(
    model: Model, name: str, high: np.ndarray, parameters: Parameters, statistics: Statistics | Windowed
) -> Edge:
    """Integrate over ``name`` from its upper (``high``) or lower bound in every pixel."""
    free, k = model.free, model.free.index(name)
    bounds = model.bounds[name]
    stack = np.stack([np.asarray(getattr(parameters, n)) for n in free], axis=-1)
    span, spacing = _distances(stack.dtype, bounds[1] - bounds[0])
    points = np.broadcast_to(stack, (NODES, *stack.shape)).copy()
    points[..., k] = np.where(high, bounds[1] - span[:, None], bounds[0] + span[:, None])
    value, gradient, hessian = (np.asarray(x, float) for x in derivatives(model, points, statistics))
    usable = np.isfinite(value) & np.isfinite(gradient).all(-1) & np.isfinite(hessian).all((-1, -2))
    others = [i for i in range(len(free)) if i != k]
    slope = np.where(usable[..., None], gradient, 0)[..., others]
    curvature = np.where(usable[..., None, None], -hessian, np.eye(len(free)))[..., others, :][..., others]
    width = np.array([uniform_std(free[i]) for i in others])
    covariance, log_volume, flat = invert(
        curvature * width[:, None] * width, float(np.finfo(points.dtype).eps), RANGE_CURVATURE
    )
    usable &= ~flat.any(axis=-1)
    covariance, log_volume = covariance * width[:, None] * width, log_volume + np.log(width).sum()
    shift = np.einsum("...ij,...j->...i", covariance, slope)
    lift = 0.5 * np.einsum("...i,...i->...", slope, shift)
    # The parabola of the others holds near the maximum only: a node from where it would rise above the maximum itself,
    # or would move another parameter far, is one that it does not describe.
    top = np.asarray(log_density(model, Parameters(*(np.asarray(x)[None] for x in parameters)), statistics), float)
    usable &= (value + lift <= top + 0.1) & (np.abs(shift) < 0.5 * width).all(axis=-1)
    log_weight = np.where(usable, value + lift + log_volume + np.log(span * spacing)[:, None], -np.inf)
    nodes = dict.fromkeys(Parameters._fields, np.zeros(points.shape[:-1], points.dtype))
    nodes |= {n: points[..., i] for i, n in enumerate(free)}
    everything = np.logaddexp.reduce(log_weight + log_prior_ratio(model, Parameters(**nodes)), axis=0)
    total = np.logaddexp.reduce(log_weight, axis=0)
    own = np.exp(log_weight - np.where(np.isfinite(total), total, 0))
    offset = np.zeros_like(points)
    offset[..., others] = shift
    offset[..., k] = points[..., k] - stack[:, k]
    moments = np.einsum("np,npi,npj->pij", own, offset, offset)
    spread = np.einsum("np,npij->pij", own, covariance)
    places = np.array(others, int)
    moments[:, places[:, None], places] += spread
    return Edge(moments, everything)
