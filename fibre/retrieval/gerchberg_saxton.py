"""Multi-plane Gerchberg-Saxton: visit the planes in turn, keep the phase, put back the measured amplitude."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage

from fibre.retrieval.base import RetrievalMethod, Solution, Stack, misfit
from polinfer.checks import integer, real_number
from polinfer.threads import each, piece

__all__ = ["GerchbergSaxton", "averaged"]


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

    A field that still moves and is not as near to its images as twice their noise, or that fits them 1.5 times worse
    than the others of its batch, has stagnated: it is started again from a smooth random phase, ``restarts`` times at
    most, and the better fit is kept.

    Parameters
    ----------
    iterations: most sweeps, >= 1. averaging: iterations of the mean afterwards, >= 0. tolerance: the sweeps stop when
    the field changes by less than this per sweep, or than a tenth of the images' relative noise; 0: never. restarts:
    >= 0. coarsening: the first sweeps take one pixel in so many and low frequencies only (1: all from the start, also
    where a side of the frame is not a multiple of twice that). Distances decide more than iterations: with planes in
    which light has spread over tens of fibrelets, some 50 sweeps do; a few fibrelets, hundreds.

    Source: Gerchberg and Saxton (1972) and its through-focus form, as used by the paper with about 200 iterations.
    """

    iterations: int = 150
    averaging: int = 20
    tolerance: float = 2e-3
    restarts: int = 2
    coarsening: int = 2

    def __post_init__(self) -> None:
        integer("iterations", self.iterations, low=1)
        integer("averaging", self.averaging, low=0)
        real_number("tolerance", self.tolerance, low=0)
        integer("restarts", self.restarts, low=0)
        integer("coarsening", self.coarsening, low=1)

    def solve(self, stack: Stack) -> Solution:
        """See :meth:`RetrievalMethod.solve`."""
        noise, shape = stack.noise, stack.intensities.shape[-2:]
        # the planes' noise keeps the field moving by a few per cent of it, however long one waits
        tolerance = np.asarray(np.maximum(self.tolerance, 0.1 * noise) * (self.tolerance > 0), np.float32)
        coarse = self.coarsening if all(n % (2 * self.coarsening) == 0 for n in shape) else 1
        everything, flat = np.arange(len(noise)), np.zeros(shape, np.float32)
        field, change, spent, left = self._run(stack, everything, tolerance, flat, coarse)
        # planes that contradict each other keep a field moving for ever: it is found where noise explains what is left
        explained = np.zeros(len(noise)) if stack.measured.expected is None else 2 * stack.measured.expected
        for restart in range(self.restarts):
            # a stagnated field leaves several times the misfit of its neighbours; noise differs far less
            chosen = np.flatnonzero(((change > tolerance) & (left > explained)) | (left > 1.5 * np.median(left)))
            if len(chosen) == 0:
                break
            phase = np.random.default_rng(restart).uniform(-np.pi, np.pi, size=shape)
            # correlated over a few pixels, several radians deep
            smooth = scipy.ndimage.gaussian_filter(phase, 4.0, mode="wrap") * 20
            again = self._run(stack, chosen, tolerance, smooth, 1)
            better = again.left < left[chosen]
            for old, new in zip((field, change, left), (again.field, again.change, again.left), strict=True):
                old[chosen[better]] = new[better]
            spent[chosen] += again.sweeps
        return Solution(field, change <= np.maximum(tolerance, 1e-2), spent)

    def _run(self, stack: Stack, chosen: np.ndarray, tolerance: np.ndarray, phase: np.ndarray, coarse: int) -> _Found:
        """``chosen`` fields from ``phase`` in the first plane: on a processor one by one, on all cores."""
        size = min(piece(1, 64), 1 << (len(chosen) - 1).bit_length())
        # code is compiled for a shape: pieces are filled up, so that few shapes occur
        filled = np.resize(chosen, -(-len(chosen) // size) * size)
        found: list[_Found] = [None] * (len(filled) // size)  # type: ignore[list-item]
        amplitudes, weights = stack.amplitudes, stack.weights

        def part(k: int) -> None:
            some = filled[k * size : (k + 1) * size]
            images = (amplitudes[some], weights[some], stack.masks)
            spectrum, change, sweeps = _spectra(images, phase, tolerance[some], self.iterations, self.averaging, coarse)
            field = np.array(jnp.fft.ifft2(spectrum))
            found[k] = _Found(field, np.array(change), np.array(sweeps) + self.averaging, misfit(field, *images))

        each(part, range(len(found)))
        return _Found(*(np.concatenate(values)[: len(chosen)] for values in zip(*found, strict=True)))


class _Found(NamedTuple):
    """field (b, y, x); of each its last relative change, its sweeps, and the mean squared misfit it leaves, (b,)."""

    field: np.ndarray
    change: np.ndarray
    sweeps: np.ndarray
    left: np.ndarray


def _spectra(
    images: tuple[np.ndarray, np.ndarray, np.ndarray],
    phase: np.ndarray,
    tolerance: np.ndarray,
    iterations: int,
    averaging: int,
    coarse: int,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """What :func:`_solve` returns, from a phase in the first plane; ``images``: amplitudes, weights, masks."""
    amplitudes, weights, masks = images
    first = np.fft.fft2(amplitudes[:, 0] * np.exp(1j * phase)) * np.conj(masks[0])
    if coarse > 1:
        # every second pixel samples the same field, and low frequencies alone make a good start at less cost
        few = (..., slice(None, None, coarse), slice(None, None, coarse))
        low = [np.fft.ifftshift(_middle(n, coarse)) for n in masks.shape[-2:]]
        place = (..., low[0][:, None], low[1])
        spectrum, _, _ = _solve(
            amplitudes[few], weights[few], masks[place], first[place] / coarse**2, 3 * tolerance, iterations, 0
        )
        first = np.zeros_like(first)
        first[place] = np.asarray(spectrum) * coarse**2
    return _solve(amplitudes, weights, masks, first, tolerance, iterations, averaging)


def _middle(count: int, coarse: int) -> np.ndarray:
    """Places in the spectrum of ``count`` samples of the lowest frequencies that ``count / coarse`` samples have."""
    few = count // coarse
    return np.arange(-few // 2, few // 2) % count


def _project(view: jax.Array, amplitude: jax.Array, weight: jax.Array) -> jax.Array:
    modulus = jnp.abs(view)
    # a dark pixel has no phase to keep: it stays dark rather than divide by zero
    return view * (1 + weight * (amplitude / jnp.maximum(modulus, 1e-20) - 1))


def averaged(
    spectrum: jax.Array, amplitudes: jax.Array, weights: jax.Array, masks: jax.Array, scale: jax.Array | None = None
) -> jax.Array:
    """The mean over the views of spectra (b, y, x) that have the amplitudes (b, m, y, x) there, as far as their weights
    say; ``scale`` (b, m): of the amplitudes, None: 1. What a mask does not pass is left as it is."""
    images = len(masks)

    def add(i: Any, total: jax.Array) -> jax.Array:
        wanted = amplitudes[:, i] if scale is None else amplitudes[:, i] * scale[:, i, None, None]
        view = _project(jnp.fft.ifft2(spectrum * masks[i]), wanted, weights[:, i])
        return total + jnp.fft.fft2(view) * jnp.conj(masks[i])

    # one view after the other: all of them at the same time leave the processor's cache
    unseen = (1 - jnp.abs(masks) ** 2).sum(0)
    return jax.lax.fori_loop(0, images, add, spectrum * unseen) / images


@partial(jax.jit, static_argnums=6)
def _solve(
    amplitudes: jax.Array,
    weights: jax.Array,
    masks: jax.Array,
    first: jax.Array,
    tolerance: jax.Array,
    iterations: Any,
    averaging: int,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Spectra from the spectra ``first``, the last relative change, and the number of sweeps; every field stops for
    itself."""
    images = masks.shape[0]
    back = jnp.conj(masks)
    # what a mask does not pass, its plane says nothing about: it is left as it is
    unseen = 1 - jnp.abs(masks) ** 2
    usable = (weights > 0).astype(weights.dtype)

    # a loop that is compiled once: quicker than a row of all views
    def visit(i: Any, spectrum: jax.Array) -> jax.Array:
        view = _project(jnp.fft.ifft2(spectrum * masks[i]), amplitudes[:, i], usable[:, i])
        return jnp.fft.fft2(view) * back[i] + spectrum * unseen[i]

    def sweep(spectrum: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, images, visit, spectrum)

    def step(carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        spectrum, change, count = carry
        moves = change > tolerance
        new = jnp.where(moves[:, None, None], sweep(spectrum), spectrum)
        power = jnp.sum(jnp.abs(new) ** 2, axis=(1, 2))
        moved = jnp.sqrt(jnp.sum(jnp.abs(new - spectrum) ** 2, axis=(1, 2)) / jnp.maximum(power, 1e-30))
        return new, jnp.where(moves, moved, change), count + moves

    def unfinished(carry: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        return jnp.any((carry[2] < iterations) & (carry[1] > tolerance))

    def average(_: int, spectrum: jax.Array) -> jax.Array:
        return averaged(spectrum, amplitudes, weights, masks)

    start = (
        first.astype(masks.dtype),
        jnp.full(len(amplitudes), jnp.inf, amplitudes.dtype),
        jnp.zeros(len(amplitudes), int),
    )
    spectrum, change, count = jax.lax.while_loop(unfinished, step, start)
    spectrum = jax.lax.fori_loop(0, averaging, average, spectrum)
    return spectrum, change, count
