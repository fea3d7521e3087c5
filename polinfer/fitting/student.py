"""What an unknown sigma in every pixel does to the Gaussian around the maximum: it has Student's tails.

With sigma integrated out, the likelihood around the maximum is ``(scale + Q + d^T H d)^-p`` in d, the distance from the
maximum, with p = shape + N: a Student density of ``2 p - gamma`` degrees of freedom in the gamma directions that the
data determine. Its curvature at the maximum is that of a sigma which no parameter was fitted for. Known integrals of
this density put both right: the covariance is larger than the inverse curvature by ``p / (p - gamma / 2 - 1)``, and the
volume by ``Gamma(p - gamma / 2) p^(gamma / 2) / Gamma(p)``.
"""

from __future__ import annotations

import numpy as np
from scipy.special import gammaln

from ..model import Model
from ..neighbours import Windowed
from ..noise import InferredNoise
from ..records import Parameters
from ..statistics import Statistics
from .frame_noise import prior_curvature
from .local_gaussian import Local, invert, uniform_std

__all__ = ["total_power", "widen"]

# Student's variance exceeds the square of its width by this much at 3 degrees of freedom, and grows beyond all bounds.
MOST = 3.0


def total_power(model: Model, noise: InferredNoise, statistics: Statistics | Windowed) -> np.ndarray:
    """The power p of the likelihood of a pixel or a window around its maximum; a gain takes its share of the data."""
    members = statistics if isinstance(statistics, Statistics) else statistics.statistics
    data = np.asarray(members.count, float)
    each = np.where(data > 0, noise.shape + np.maximum(data - 0.5 * model.known_gain.real_parameters, 0), 0)
    total = each if isinstance(statistics, Statistics) else each.sum(axis=-1)
    return np.maximum(total, noise.shape)


def widen(model: Model, parameters: Parameters, local: Local, effective: np.ndarray, power: np.ndarray) -> Local:
    """Covariance and evidence of a Student density; ``effective`` parameters are determined by the data."""
    freedom = np.maximum(2 * power - effective, 1e-3)
    spread = np.where(freedom > 3, freedom / np.maximum(freedom - 2, 1e-3), MOST)
    factor = 2 * power / freedom * np.minimum(spread, MOST)
    width = np.array([uniform_std(name) for name in model.free])
    prior = prior_curvature(model, parameters) * width**2
    own = np.einsum("...i,ij->...ij", prior, np.eye(len(width)))
    known = np.isfinite(local.curvature).all(axis=(-1, -2))
    curvature = np.where(known[:, None, None], local.curvature * width[:, None] * width, np.eye(len(width)))
    covariance, _, flat = invert(own + (curvature - own) / factor[:, None, None], local.rounding, 0.0)
    covariance = covariance * width[:, None] * width
    change = (known & ~local.on_bound)[:, None, None]
    covariance = np.where(change, covariance, local.covariance)
    volume = gammaln(0.5 * freedom) - gammaln(power) + 0.5 * effective * np.log(power)
    lost = (np.sqrt(np.einsum("...ii->...i", covariance)) > 0.5 * width) | flat
    return local._replace(
        covariance=covariance,
        unidentified=local.unidentified | (lost & change[..., 0]),
        log_evidence=local.log_evidence + volume,
    )
