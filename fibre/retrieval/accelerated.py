"""Averaged projections with momentum over a whole frame: for fields of any kind.

In: a :class:`fibre.retrieval.base.Stack`. Out: its fields. Called by :func:`fibre.retrieve`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fibre.retrieval.base import RetrievalMethod, Solution, Stack
from fibre.retrieval.gerchberg_saxton import GerchbergSaxton, averaged
from polinfer.checks import integer, real_number

__all__ = ["Accelerated"]

EVERY = 5  # iterations between two looks at the gains

# last spectrum, the point ahead of it, length of the sequence, gains, relative change, iterations
_Carry = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]


@dataclass(frozen=True)
class Accelerated(RetrievalMethod):
    r"""The field that fits the amplitudes of all planes best, by gradients with momentum.

    Lowers :math:`\Phi = \sum_i \sum_x w_i (\sqrt{g_i} |P_i E| - a_i)^2`, P propagation to plane i, a the measured
    amplitude, w its inverse variance, from some sweeps of :class:`fibre.GerchbergSaxton`. One iteration is the mean
    over the planes of their projections, which never raises :math:`\Phi`, taken from a point ahead of the last field,
    with Nesterov's sequence of step lengths; the momentum starts anew whenever it points uphill. It costs what a sweep
    costs, and needs some square root of the number of plain averaging steps. Nothing is assumed of the field; where it
    is known to consist of fibrelet modes, :class:`fibre.Modal` is far faster and better.

    A common error of all distances cannot be found: :math:`|P_{z+d} E| = |P_z (P_d E)|`, the field is then that of
    another plane. Only modes know where their focus is.

    Parameters
    ----------
    iterations: most, >= 1. sweeps: of Gerchberg-Saxton before, >= 1. tolerance: relative change of the field in one
    iteration at which it ends, >= 0. gain_spread: standard deviation of the brightness g of each image, relative to
    their geometric mean, found with the field; 0: all are 1.

    Raises
    ------
    ValueError: settings out of range.

    Source: Nesterov (1983); restarts, O'Donoghue and Candes (2015); averaged projections are gradients, Fienup (1982).

    >>> from fibre import Accelerated, Defocus, angular_spectrum, retrieve
    >>> y, x = np.mgrid[-32:32, -32:32] * 1e-6
    >>> beam = np.exp(-((x - 4e-6)**2 + y**2) / (6e-6)**2) - np.exp(-((x + 5e-6)**2 + y**2) / (5e-6)**2)
    >>> z = np.array([-8e-5, -4e-5, 0, 4e-5, 8e-5])
    >>> images = np.stack([abs(angular_spectrum(beam, d, 850e-9, 1e-6))**2 for d in z])
    >>> found = retrieve(Defocus(images, z, wavelength=850e-9, pixel_size=1e-6), Accelerated())
    >>> bool(abs(np.vdot(beam, found.field)) > 0.999 * np.linalg.norm(beam) * np.linalg.norm(found.field))
    True
    """

    iterations: int = 100
    sweeps: int = 20
    tolerance: float = 1e-3
    gain_spread: float = 0.0

    def __post_init__(self) -> None:
        integer("iterations", self.iterations, low=1)
        integer("sweeps", self.sweeps, low=1)
        real_number("tolerance", self.tolerance, low=0)
        real_number("gain_spread", self.gain_spread, low=0)

    def solve(self, stack: Stack) -> Solution:
        """See :meth:`RetrievalMethod.solve`."""
        start = GerchbergSaxton(iterations=self.sweeps, averaging=0, restarts=0).solve(stack)
        noise = np.maximum(stack.noise, 1e-3).astype(np.float32)
        field, change, count = _run(
            start.field, stack.amplitudes, stack.weights, stack.masks, np.float32(self.gain_spread),
            np.float32(self.tolerance), noise, self.iterations, self.gain_spread > 0,
        )  # fmt: skip
        done = np.asarray(change) <= max(self.tolerance, 1e-2)
        return Solution(np.asarray(field), done, start.iterations + int(count))


@partial(jax.jit, static_argnums=8)
def _run(
    start: jax.Array, amplitudes: jax.Array, weights: jax.Array, masks: jax.Array, spread: jax.Array,
    tolerance: jax.Array, noise: jax.Array, iterations: Any, with_gains: bool,
) -> tuple[jax.Array, jax.Array, jax.Array]:  # fmt: skip
    """Fields (b, y, x), their last relative change (b,), iterations."""
    # weight 1 is the variance of the best pixel: (relative noise)^2 mean(a^2); prior and misfit must share a unit
    unit = noise**2 * (weights * amplitudes**2).sum((1, 2, 3)) / jnp.maximum((weights > 0).sum((1, 2, 3)), 1)

    def brightness(spectrum: jax.Array) -> jax.Array:
        """Gains that fit best where the field is held, one on the average: the field takes up what is common."""
        modulus = jnp.abs(jnp.fft.ifft2(spectrum[:, None] * masks))
        known = (unit / (0.5 * spread) ** 2)[:, None] + 1e-20
        root = ((weights * modulus * amplitudes).sum((2, 3)) + known) / ((weights * modulus**2).sum((2, 3)) + known)
        root = jnp.maximum(root, 1e-3)
        return (root / jnp.exp(jnp.log(root).mean(1, keepdims=True))) ** 2

    def step(carry: _Carry) -> _Carry:
        last, ahead, t, gains, _, count = carry
        if with_gains:
            gains = jax.lax.cond(count % EVERY == 0, brightness, lambda _: gains, last)
        new = averaged(ahead, amplitudes, weights, masks, 1 / jnp.sqrt(gains))
        uphill = (jnp.conj(ahead - new) * (new - last)).real.sum((1, 2)) > 0
        t = jnp.where(uphill, 1.0, t)
        following = 0.5 * (1 + jnp.sqrt(1 + 4 * t**2))
        momentum = jnp.where(uphill, 0.0, (t - 1) / following)[:, None, None]
        power = jnp.maximum((jnp.abs(new) ** 2).sum((1, 2)), 1e-30)
        change = jnp.sqrt((jnp.abs(new - last) ** 2).sum((1, 2)) / power)
        return new, new + momentum * (new - last), following, gains, change, count + 1

    def unfinished(carry: _Carry) -> jax.Array:
        return (carry[5] < iterations) & jnp.any(carry[4] > tolerance)

    b, m = amplitudes.shape[:2]
    spectrum = jnp.fft.fft2(start)
    real = amplitudes.dtype
    start_at = (spectrum, spectrum, jnp.ones(b, real), jnp.ones((b, m), real), jnp.full(b, jnp.inf, real), jnp.array(0))
    spectrum, _, _, _, change, count = jax.lax.while_loop(unfinished, step, start_at)
    return jnp.fft.ifft2(spectrum), change, count
