"""Would the model, with what the data say about it, make data like these again?"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import gammaincc

from .. import storage
from ..checks import as_generator, integer
from ..elements import multiply
from ..model import Model, as_device
from ..neighbours import rows_of
from ..records import Parameters
from ..statistics import Statistics, Summary, summarise
from ..storage import array
from .blocks import blocks, flat
from .diagnostics import NO_DRAWS
from .tilt import phase_of

if TYPE_CHECKING:
    from .draws import Draws

__all__ = ["Predictive", "predict"]

LEAST = 64


@dataclass(frozen=True, eq=False)
class Predictive:
    """Result of :meth:`Draws.predictive`: the measured data beside those that the posterior predicts.

    The discrepancy of data V of the pixel itself, at draw s, is ``X_s = 2 sum_k w_k |V_k - g_s J_s U_k|^2 /
    sigma_s^2``. Of data that the model makes at this draw, it has a chi-square distribution with as many degrees of
    freedom as there are real data, so their tail probability is known without making any.

    Attributes
    ----------
    p_value: mean over the draws of the probability that predicted data have a larger discrepancy than the measured
        ones, in [0, 1], shape P. Near 0: the model does not explain the data, or sigma is too small; near 1: sigma is
        too large. It uses the data twice and crowds around 0.5 when all is well, so it is no level of a test. 1 where
        there are no data. With a sigma of the pixel's own it says little: sigma follows the residual.
    chi_square: mean of X over the draws. degrees_of_freedom: number of real data, ``4 n`` without missing states.
    response: predicted responses, complex ``(draw, *P, 2, n)``, NaN where a state is missing (weight 0); None if they
        were not asked for.
    seed: seed of their noise, None if a generator came or no responses were made.

    NaN where there are no draws.
    """

    p_value: np.ndarray = array(("*P",), "1")
    chi_square: np.ndarray = array(("*P",), "1")
    degrees_of_freedom: np.ndarray = array(("*P",), "1")
    response: np.ndarray | None = array(("draw", "*P", "polarisation", "state"), "1", default=None)
    seed: int | None = None

    def to_dataset(self) -> Any:
        """As a labelled :class:`xarray.Dataset`."""
        return storage.to_dataset(self)


@partial(jax.jit, static_argnums=0)
def _jones(model: Model, parameters: Parameters, phase: jax.Array | None) -> jax.Array:
    """``T^-1 J T``, or J where there is no tilt."""
    matrix = model.jones(parameters)
    if phase is None:
        return matrix
    turn = jax.lax.complex(jnp.cos(phase), jnp.sin(phase))
    one = jnp.ones_like(turn)
    top, bottom = jnp.stack([one, turn], axis=-1), jnp.stack([jnp.conj(turn), one], axis=-1)
    return matrix * jnp.stack([top, bottom], axis=-2)


@partial(jax.jit, static_argnums=0)
def _residuals(
    model: Model, parameters: Parameters, gain: jax.Array, phase: jax.Array | None, statistics: Statistics
) -> jax.Array:
    """``sum_k w_k |V_k - g J U_k|^2`` in the unit of the statistics; gain, parameters and tilt ``(draw, pixel)``."""
    matrix = _jones(model, parameters, phase)
    rest = gain[..., None, None] * multiply(matrix, statistics.illumination) - statistics.response
    return jnp.sum(jnp.real(rest) ** 2 + jnp.imag(rest) ** 2, axis=(-1, -2)) + statistics.residual


def _summary(draws: Draws) -> Summary:
    """Statistics in the unit of sigma where it is known, in that of the response where it was drawn."""
    known = None if draws.sigma is not None else draws.model.noise.sigma(draws.measurement)
    if known is None and draws.sigma is None:
        raise ValueError("draws have no sigma, but the model infers it; sample again with a sampler that draws it.")
    if draws.gain is None and draws.model.gain is not None:
        raise ValueError("draws have no gain, but the model has one; sample again with a sampler that draws it.")
    return summarise(draws.measurement, known)


def _chosen(values: Any, draws: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Values ``(chain, draw, pixel)`` of some draws, counted through all chains, and pixels: ``(draw, pixel)``."""
    every = flat(values)
    return np.asarray(every.reshape(-1, every.shape[-1])[draws[:, None], pixels])


def predict(draws: Draws, rng: int | np.random.Generator | None, count: int, responses: bool) -> Predictive:
    """Posterior predictive check of every pixel by its own data, with the draws of gain and sigma.

    Parameters
    ----------
    draws: the posterior. rng: seed, generator or None (a fresh seed), for the noise of predicted responses.
    count: how many draws to use, evenly spread over all chains, >= 1; at most all of them are.
    responses: also make predicted responses, one for each draw used. They take the memory of as many measurements.

    Raises
    ------
    ValueError: a count below 1; draws without the gain or sigma that the model infers.

    Source: Gelman, Meng, Stern, "Posterior predictive assessment of model fitness via realized discrepancies",
    Statistica Sinica 6 (1996) 733.

    >>> from polinfer import Measurement
    >>> from polinfer.sampling.draws import Draws
    >>> rng = np.random.default_rng(0)
    >>> values = Parameters(*np.zeros((5, 1, 50, 2)))
    >>> data = Measurement.from_jones(np.array([np.eye(2), 3 * np.eye(2)]), 1.0)
    >>> draws = Draws(Model(), data, values, np.zeros(2), np.zeros(2), np.zeros(2, np.int32), None, None, 1, None)
    >>> check = predict(draws, 1, 20, responses=True)
    >>> check.chi_square.tolist(), check.degrees_of_freedom.tolist(), check.p_value.round(3).tolist()
    ([0.0, 16.0], [8, 8], [1.0, 0.042])
    >>> check.response.shape
    (20, 2, 2, 2)
    """
    count = integer("draws", count, low=1)
    summary, shape = _summary(draws), draws.shape
    statistics = rows_of(summary.statistics, shape)
    good = np.flatnonzero((np.asarray(draws.status) & NO_DRAWS) == 0)
    total = draws.chains * draws.count
    used = np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int))
    degrees = np.broadcast_to(4 * summary.states, shape).astype(np.int32)
    chi_square, p_value = (np.full(int(np.prod(shape)), np.nan) for _ in range(2))
    for part in blocks(good, 8 * len(used)):
        # code is compiled for a shape: pad to a power of two, as the fit does
        size = max(1 << (len(part) - 1).bit_length(), LEAST)
        padded = np.concatenate([part, np.full(size - len(part), part[0])])
        parameters, gain, phase = _device(draws, used, padded)
        own = as_device(Statistics(*(x[padded] for x in statistics)), draws.measurement.response.dtype)
        found = 2 * np.asarray(_residuals(draws.model, parameters, gain, phase, own), float)[:, : len(part)]
        if draws.sigma is not None:
            found /= _chosen(draws.sigma, used, part).astype(float) ** 2
        freedom = degrees.reshape(-1)[part]
        tail = gammaincc(0.5 * np.maximum(freedom, 1), 0.5 * found)
        chi_square[part] = found.mean(axis=0)
        p_value[part] = np.where(freedom > 0, tail.mean(axis=0), 1.0)
    kind = np.asarray(draws.parameters.diattenuation).dtype
    response, seed = None, None
    if responses:
        generator, seed = as_generator(rng)
        response = _responses(draws, used, good, generator)
    return Predictive(p_value.reshape(shape).astype(kind), chi_square.reshape(shape).astype(kind), degrees, response,
                      seed)  # fmt: skip


def _device(draws: Draws, used: np.ndarray, pixels: np.ndarray) -> tuple[Parameters, jax.Array, jax.Array | None]:
    """Parameters, gain and phase of the tilt ``(draw, pixel)`` as JAX arrays in the measurement's precision."""
    complex_type = jax.dtypes.canonicalize_dtype(draws.measurement.response.dtype)
    real_type = np.zeros((), complex_type).real.dtype
    parameters = Parameters(*(jnp.asarray(_chosen(x, used, pixels).astype(real_type)) for x in draws.parameters))
    gain = np.ones((len(used), len(pixels))) if draws.gain is None else _chosen(draws.gain, used, pixels)
    phase = None
    if draws.tilt is not None:
        each = draws.tilt.reshape(draws.chains * draws.count, *draws.tilt.shape[2:])[used]
        phase = jnp.asarray(phase_of(draws.model, each, draws.shape, pixels).astype(real_type))
    return parameters, jnp.asarray(gain.astype(complex_type)), phase


def _responses(draws: Draws, used: np.ndarray, good: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Predicted responses ``(draw, *P, 2, n)``."""
    measurement, shape, states = draws.measurement, draws.shape, draws.measurement.states
    kind = measurement.response.dtype
    made = np.full((len(used), int(np.prod(shape)), 2, states), np.nan, kind)
    illumination = np.broadcast_to(measurement.illumination, (*shape, 2, states)).reshape(-1, 2, states)
    weight = np.ones(states) if measurement.weight is None else measurement.weight
    weight = np.broadcast_to(weight, (*shape, states)).reshape(-1, states)
    with np.errstate(divide="ignore"):
        spread = np.where(weight > 0, weight, np.nan) ** -0.5
    known = None if draws.sigma is not None else np.asarray(draws.model.noise.sigma(measurement)).reshape(-1)
    for part in blocks(good, 8 * len(used) * states):
        parameters, gain, phase = _device(draws, used, part)
        clean = np.asarray(_jones(draws.model, parameters, phase)) @ illumination[part]
        sigma = _chosen(draws.sigma, used, part) if known is None else np.broadcast_to(known[part], gain.shape)
        pair = rng.normal(scale=0.5**0.5, size=(2, *clean.shape))
        noise = sigma[..., None, None] * spread[part][:, None, :] * (pair[0] + 1j * pair[1])
        made[:, part] = np.asarray(gain)[..., None, None] * clean + noise
    return made.reshape(len(used), *shape, 2, states)
