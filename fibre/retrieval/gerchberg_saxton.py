"""Multi-plane Gerchberg-Saxton: visit the planes in turn, keep the phase, put back the measured amplitude."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage

from fibre.retrieval.base import RetrievalMethod, Solution, misfit
from polinfer.checks import integer, real_number

__all__ = ["GerchbergSaxton"]


@dataclass(frozen=True)
class GerchbergSaxton(RetrievalMethod):
    r"""Alternating projections over m >= 2 planes, then their average.

    With :math:`P_i` propagation to plane i and :math:`a_i` the measured amplitude, a sweep applies for i = 1 ... m in
    turn

    .. math:: E \leftarrow P_i^{-1} [ a_i \, P_i E / |P_i E| ]

    which moves fast but ends in a cycle, each plane undoing a little of the last. So the last ``averaging``
    iterations go down the gradient of :math:`\sum_i w_i (|P_i E| - a_i)^2` instead, with weights w inverse to the
    variance of the amplitudes: the planes' noise is averaged, and dark pixels, whose square root is mostly noise,
    count for little. Pixels without a usable measurement keep their own amplitude.

    A field that still moves, or fits its images 1.5 times worse than the others of its batch, has stagnated: it is
    started again from a smooth random phase, ``restarts`` times at most, and the better fit is kept.

    Parameters
    ----------
    iterations: most sweeps, >= 1. averaging: iterations of the mean afterwards, >= 0. tolerance: relative change of
    the field per sweep at which the sweeps stop. restarts: >= 0. Distances decide more than iterations: with planes
    in which light has spread over tens of fibrelets, some 50 sweeps do; a few fibrelets, hundreds.

    Source: Gerchberg and Saxton (1972) and its through-focus form, as used by the paper with about 200 iterations.
    """

    iterations: int = 150
    averaging: int = 20
    tolerance: float = 2e-3
    restarts: int = 2

    def __post_init__(self) -> None:
        integer("iterations", self.iterations, low=1)
        integer("averaging", self.averaging, low=0)
        real_number("tolerance", self.tolerance, low=0)
        integer("restarts", self.restarts, low=0)

    def solve(self, amplitudes: np.ndarray, weights: np.ndarray, masks: np.ndarray) -> Solution:
        """See :meth:`RetrievalMethod.solve`."""
        settings = (self.iterations, self.averaging, self.tolerance)
        arguments = (jnp.asarray(amplitudes), jnp.asarray(weights), jnp.asarray(masks))
        flat = jnp.zeros(amplitudes.shape[-2:], amplitudes.dtype)
        field, change, count = (np.array(part) for part in _solve(*arguments, flat, *settings))
        spent = np.full(len(field), count + self.averaging)
        left = misfit(field, amplitudes, weights, masks)
        for restart in range(self.restarts):
            # a stagnated field leaves several times the misfit of its neighbours; noise differs far less
            suspect = (change > self.tolerance) | (left > 1.5 * np.median(left))
            if not suspect.any():
                break
            phase = np.random.default_rng(restart).uniform(-np.pi, np.pi, flat.shape).astype(amplitudes.dtype)
            # correlated over a few pixels, several radians deep
            smooth = jnp.asarray(scipy.ndimage.gaussian_filter(phase, 4.0, mode="wrap") * 20)
            again, moved, count = (np.array(part) for part in _solve(*arguments, smooth, *settings))
            other = misfit(again, amplitudes, weights, masks)
            better = suspect & (other < left)
            field[better], change[better], left[better] = again[better], moved[better], other[better]
            spent[suspect] += count + self.averaging
        return Solution(field, change <= max(self.tolerance, 1e-2), spent)


def _project(view: jax.Array, amplitude: jax.Array, weight: jax.Array) -> jax.Array:
    modulus = jnp.abs(view)
    # a dark pixel has no phase to keep: it stays dark rather than divide by zero
    return view * (1 + weight * (amplitude / jnp.maximum(modulus, 1e-20) - 1))


@partial(jax.jit, static_argnums=(4, 5))
def _solve(
    amplitudes: jax.Array,
    weights: jax.Array,
    masks: jax.Array,
    phase: jax.Array,
    iterations: int,
    averaging: int,
    tolerance: float,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    images = masks.shape[0]
    back = jnp.conj(masks)
    # what a mask does not pass, its plane says nothing about: it is left as it is
    unseen = 1 - jnp.abs(masks) ** 2
    usable = (weights > 0).astype(weights.dtype)

    def sweep(spectrum: jax.Array) -> jax.Array:
        for i in range(images):
            view = _project(jnp.fft.ifft2(spectrum * masks[i]), amplitudes[:, i], usable[:, i])
            spectrum = jnp.fft.fft2(view) * back[i] + spectrum * unseen[i]
        return spectrum

    def step(carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        spectrum, _, count = carry
        new = sweep(spectrum)
        power = jnp.sum(jnp.abs(new) ** 2, axis=(1, 2))
        change = jnp.sqrt(jnp.sum(jnp.abs(new - spectrum) ** 2, axis=(1, 2)) / jnp.maximum(power, 1e-30))
        return new, change, count + 1

    def unfinished(carry: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        return (carry[2] < iterations) & jnp.any(carry[1] > tolerance)

    def average(_: int, spectrum: jax.Array) -> jax.Array:
        view = jnp.fft.ifft2(spectrum[:, None] * masks)
        moved = jnp.fft.fft2(_project(view, amplitudes, weights)) * back
        return (moved + spectrum[:, None] * unseen).mean(1)

    first = jnp.fft.fft2(amplitudes[:, 0] * jnp.exp(1j * phase)) * back[0]
    start = (first, jnp.full(len(amplitudes), jnp.inf, amplitudes.dtype), jnp.array(0))
    spectrum, change, count = jax.lax.while_loop(unfinished, step, start)
    spectrum = jax.lax.fori_loop(0, averaging, average, spectrum)
    return jnp.fft.ifft2(spectrum), change, count
