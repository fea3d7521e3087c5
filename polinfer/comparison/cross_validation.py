"""How well draws predict a state of a pixel that was left out: a second opinion beside the evidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import logsumexp

from ..model import Model
from ..records import Measurement, Parameters
from ..sampling.tilt import phase_of
from ..tilting import tilted
from .pareto import smoothed_log_weights

__all__ = ["LeaveOneOut", "leave_one_out"]

BLOCK = 1 << 21  # draws times data of the pixels in memory at once
TRUSTED = 0.7


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """Leave-one-out predictive densities, see :func:`leave_one_out`.

    log_density: ``(*P)``, ``sum_k log p(state k | the other states)``, nats, NaN without an answer. state: ``(*P, n)``,
    its terms, 0 for missing states. pareto_k: ``(*P, n)``; above 0.7 the term cannot be trusted.
    """

    log_density: np.ndarray
    state: np.ndarray
    pareto_k: np.ndarray

    @property
    def trusted(self) -> np.ndarray:
        """Whether all terms of a pixel can be trusted, ``(*P)``."""
        return np.asarray(np.all(self.pareto_k <= TRUSTED, axis=-1) & np.isfinite(self.log_density))


def leave_one_out(draws: Any) -> LeaveOneOut:
    """Density that each state of a pixel has given the others, by Pareto-smoothed importance sampling.

    ``log p(V_k | V_-k) = -log mean_s 1 / p(V_k | J_s, g_s, sigma_s)``, with the means of smoothed weights; the two
    components of a state are left out together. Gain and sigma are conditioned on where they were drawn, as the
    parameters are, so that their uncertainty is integrated out by the draws.

    With three states the one left out is a third of the data, and its weights are often heavy-tailed: look at
    ``pareto_k`` before believing it.

    Parameters
    ----------
    draws: :class:`polinfer.Draws`, with those of the gain or sigma where the model has to infer them.

    Source: A. Vehtari, A. Gelman and J. Gabry, Statistics and Computing 27, 1413 (2017).
    """
    measurement, model = draws.measurement, draws.model
    for name, part in (("gain", model.gain), ("sigma", measurement.sigma is None or None)):
        if part is not None and getattr(draws, name) is None:
            raise ValueError(f"draws holds no {name}, which its model infers; leave-one-out needs its draws.")
    shape, n = measurement.shape, measurement.states
    chains = np.asarray(draws.parameters[0]).shape[:2]
    count, pixels = int(np.prod(chains)), int(np.prod(shape))
    term, k = np.full((pixels, n), np.nan), np.full((pixels, n), np.nan)

    def flat(values: Any) -> np.ndarray:
        return np.asarray(values).reshape(count, pixels)

    parameters = {name: flat(getattr(draws.parameters, name)) for name in Parameters._fields}
    gain, sigma = (None if x is None else flat(x) for x in (draws.gain, draws.sigma))
    tilt = None if draws.tilt is None else draws.tilt.reshape(count, *draws.tilt.shape[2:])
    drawn = [parameters[name] for name in model.free] + [x for x in (gain, sigma) if x is not None]
    known = np.all([np.isfinite(x[0]) for x in drawn], axis=0)
    good = np.flatnonzero(known)
    size = max(1, BLOCK // (count * n))
    for begin in range(0, len(good), size):
        chosen = good[begin : begin + size]
        density = log_densities(
            model, measurement, Parameters(**{m: x[:, chosen] for m, x in parameters.items()}), chosen,
            None if gain is None else gain[:, chosen], None if sigma is None else sigma[:, chosen],
            None if tilt is None else phase_of(model, tilt, shape, chosen),
        )  # fmt: skip
        ratios = np.moveaxis(-density, 0, -1)
        weights, k[chosen] = smoothed_log_weights(ratios)
        term[chosen] = logsumexp(weights - ratios, axis=-1)
    return LeaveOneOut(term.sum(axis=-1).reshape(shape), term.reshape(*shape, n), k.reshape(*shape, n))


def log_densities(
    model: Model,
    measurement: Measurement,
    parameters: Parameters,
    pixels: np.ndarray,
    gain: np.ndarray | None,
    sigma: np.ndarray | None,
    phase: np.ndarray | None,
) -> np.ndarray:
    """Log density of every state of the ``pixels`` (flat indices), ``(draws, pixels, n)``; 0 for missing states."""
    shape, n = measurement.shape, measurement.states
    illumination = np.broadcast_to(measurement.illumination, (*shape, 2, n)).reshape(-1, 2, n)[pixels]
    response = np.broadcast_to(measurement.response, (*shape, 2, n)).reshape(-1, 2, n)[pixels]
    weight = np.ones(n) if measurement.weight is None else measurement.weight
    weight = np.broadcast_to(weight, (*shape, n)).reshape(-1, n)[pixels].astype(float)
    if sigma is None:
        assert measurement.sigma is not None
        sigma = np.broadcast_to(measurement.sigma, shape).reshape(-1)[pixels]
    matrices = np.asarray(model.jones(parameters), complex)
    if phase is not None:
        matrices = tilted(matrices, phase)
    if gain is not None:
        matrices = gain[..., None, None] * matrices
    seen = weight > 0
    rest = np.where(seen[:, None, :], response.astype(complex), 0) - matrices @ illumination.astype(complex)
    precision = weight / np.square(np.asarray(sigma, float))[..., None]
    with np.errstate(divide="ignore"):
        log_precision = 2 * np.log(precision / np.pi)
    squares = np.sum(rest.real**2 + rest.imag**2, axis=-2)
    return np.where(seen, log_precision - precision * squares, 0.0)
