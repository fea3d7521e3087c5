"""Transport of intensity: the phase of a smooth field from how its intensity changes along the beam.

In: a stack of planes close to focus, a :class:`fibre.retrieval.base.Stack`. Out: its fields in the plane z = 0. Called
by :func:`fibre.retrieve`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fibre.retrieval.base import RetrievalMethod, Solution, Stack
from polinfer.checks import integer, one_of_types, real_number

__all__ = ["TransportOfIntensity"]


@dataclass(frozen=True)
class TransportOfIntensity(RetrievalMethod):
    r"""The phase that makes the intensity change along the beam as it does.

    For a wave e^{i(kz - wt)} of intensity I and phase :math:`\phi`, slowly varying across the beam,

    .. math:: -k \, \partial_z I = \nabla \cdot (I \nabla \phi)

    A polynomial in z, fitted to all planes of a pixel by least squares (weights inverse to the variance), gives I and
    :math:`\partial_z I` at z = 0: planes need not be symmetric, nor contain z = 0. First :math:`\phi` is found as if I
    were uniform, by one Fourier transform and its inverse; then again from what is left of the derivative, along
    conjugate directions, until nothing is. Nothing is ever divided by the intensity: dark pixels carry no flux and are
    bridged smoothly.

    It holds where the phase turns little within the light's spread over the planes,
    :math:`\lambda |z| |f|^2 \ll 1` for frequencies f in the sample, and cannot see phase vortices. Noise of the
    derivative is amplified by :math:`k / |2 \pi f|^2`: slow clouds are its mark, and the stated variance knows them
    (on average over the frame) where the images' variance is known.

    Parameters
    ----------
    order: of the polynomial in z, >= 1; fewer planes allow less: m - 1 of m usable ones at most. A pixel with a single
    usable plane is taken not to change, one with none to be dark. iterations: most steps of refinement; 0: leave the
    phase of uniform intensity. tolerance: refinement ends when the derivative that is left would change the phase by
    less than this part, > 0. regularisation: cycles per longest side of the frame, below which phase is held back, a
    part of about ``(regularisation / q)**2`` of what has q cycles, > 0. darkest: pixels below this part of the typical
    intensity (mean over the light) are taken to be that bright where phase is carried, > 0, at most 1. mirrored:
    True: no phase flows through the frame's edge (Neumann); False: the frame repeats (periodic), as it does in
    :func:`fibre.angular_spectrum`.

    Raises
    ------
    ValueError: the stack has no distances, or all of them are equal.

    Source: Teague (1983); the refinement of Zhang et al. (2020), "On a universal solution to the transport-of-intensity
    equation", Opt. Lett. 45, 3649, with conjugate directions in place of steps of one length.

    >>> from fibre import Defocus, angular_spectrum, retrieve
    >>> y, x = 2 * np.pi * np.mgrid[:64, :64] / 64
    >>> phase = 0.8 * np.cos(x) + 0.5 * np.sin(x + 2 * y)
    >>> z = np.array([-5e-6, 0, 5e-6])
    >>> images = np.stack([abs(angular_spectrum(np.exp(1j * phase), d, 850e-9, 1e-6))**2 for d in z])
    >>> found = retrieve(Defocus(images, z, wavelength=850e-9, pixel_size=1e-6), TransportOfIntensity())
    >>> bool(np.std(np.angle(found.field) - phase) < 0.01)
    True
    """

    order: int = 2
    iterations: int = 100
    tolerance: float = 1e-3
    regularisation: float = 0.03
    darkest: float = 0.003
    mirrored: bool = False

    def __post_init__(self) -> None:
        integer("order", self.order, low=1)
        integer("iterations", self.iterations, low=0)
        real_number("tolerance", self.tolerance, above=0)
        real_number("regularisation", self.regularisation, above=0)
        real_number("darkest", self.darkest, above=0, high=1)
        one_of_types("mirrored", self.mirrored, (bool,), "pass True or False.")

    def solve(self, stack: Stack) -> Solution:
        """See :meth:`RetrievalMethod.solve`."""
        if stack.distances is None:
            raise ValueError("distances must be given, got None; build the stack with Defocus, or use GerchbergSaxton.")
        if np.ptp(stack.distances) == 0:
            raise ValueError(f"distances must differ, got {stack.distances}; take planes before and behind focus.")
        unit = np.abs(stack.distances).max()
        powers = (stack.distances / unit)[:, None] ** np.arange(
            min(self.order, len(np.unique(stack.distances)) - 1) + 1
        )
        wavenumber = 2 * np.pi / stack.wavelength
        # in units of pixels and of the plane furthest away: -div(I grad phi) = scale dI/d(z/unit)
        scale = wavenumber * stack.pixel_size**2 / unit
        pull = np.float32((2 * np.pi * self.regularisation / max(stack.intensities.shape[2:])) ** 2)
        spreads: list[jax.Array] = []
        if stack.variance is None:
            intensity, slope = _fit_alike(stack.intensities, powers)
        else:
            weights = np.float32(1) / stack.variance
            intensity, slope, *spreads = _fit(stack.intensities, weights, powers.astype(np.float32))
        field, left, count = _solve(
            intensity, slope, np.float32(scale), pull, np.float32(self.darkest),
            np.float32(self.tolerance), self.iterations, self.iterations > 0, self.mirrored,
        )  # fmt: skip
        variance = None
        if spreads:
            at_focus, spread, slope_spread = (np.asarray(a) for a in (intensity, *spreads))
            variance = _variance(at_focus, spread, slope_spread, scale, pull, self.mirrored)
        converged = np.asarray(left) <= self.tolerance if self.iterations else np.ones(len(field), bool)
        return Solution(np.asarray(field), converged, np.asarray(count), variance)


def _fit_alike(images: np.ndarray, powers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intensity and slope at z = 0, (b, y, x), where all planes weigh the same: one pass over the images."""
    # least squares is linear: the same combination of planes in every pixel
    combination = np.linalg.pinv(powers)[:2].astype(np.float32)
    batch, planes, *frame = images.shape
    both = (combination @ images.reshape(batch, planes, -1)).reshape(batch, 2, *frame)
    return both[:, 0], both[:, 1]


@jax.jit
def _fit(images: jax.Array, weights: jax.Array, powers: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Intensity and slope at z = 0 and their variances, (b, y, x), by weighted least squares in every pixel.

    images, weights (inverse variances, 0 = unusable): (b, m, y, x); powers of z: (m, n + 1).
    """
    size = powers.shape[1]
    usable = weights > 0
    images = jnp.where(usable, images, 0)
    # relative weights keep single precision away from its limits
    most = jnp.maximum(weights.max(1), jnp.finfo(weights.dtype).tiny)
    weights = weights / most[:, None]
    # sums over planes are written out, so that they are one pass over the images
    z = powers[:, 1]
    moments, right = [], []
    weighted, seen = list(jnp.moveaxis(weights, 1, 0)), list(jnp.moveaxis(weights * images, 1, 0))
    for i in range(2 * size - 1):
        moments.append(sum(w * z[k] ** i for k, w in enumerate(weighted)))
        if i < size:
            right.append(sum(w * z[k] ** i for k, w in enumerate(seen)))
    sums = [[moments[i + j] for j in range(size)] for i in range(size)]
    # Cholesky by hand, element by element; a power that the usable planes cannot tell from lower ones is left out
    lower = [[sums[i][j] for j in range(size)] for i in range(size)]
    inverse: list[jax.Array] = []
    for i in range(size):
        for j in range(i):
            lower[i][j] = (sums[i][j] - sum(lower[i][k] * lower[j][k] for k in range(j))) * inverse[j]
        pivot = sums[i][i] - sum(lower[i][k] ** 2 for k in range(i))
        inverse.append(jnp.where(pivot > 1e-5 * sums[i][i], 1 / jnp.sqrt(jnp.maximum(pivot, 1e-30)), 0))

    def solved(values: list[jax.Array]) -> list[jax.Array]:
        forward: list[jax.Array] = []
        for i in range(size):
            forward.append((values[i] - sum(lower[i][k] * forward[k] for k in range(i))) * inverse[i])
        back = list(forward)
        for i in reversed(range(size)):
            back[i] = (forward[i] - sum(lower[k][i] * back[k] for k in range(i + 1, size))) * inverse[i]
        return back

    zero, one = jnp.zeros_like(most), jnp.ones_like(most)
    intensity, slope = solved(right)[:2]
    spread = [solved([one if i == j else zero for i in range(size)])[j] / most for j in range(2)]
    return intensity, slope, spread[0], spread[1]


def _variance(
    intensity: np.ndarray, spread: np.ndarray, slope_spread: np.ndarray, scale: float, pull: np.float32, mirrored: bool
) -> np.ndarray:
    """Variance of the complex field, (b, y, x): the amplitude's, and the mean over the frame of the phase's."""
    batch, y, x = intensity.shape
    intensity = np.maximum(intensity, 0).astype(float)
    waves = 1 / (_laplacian((y, x), mirrored) + pull) ** 2
    waves[0, 0] = 0  # the piston is nobody's
    if not mirrored:
        # real transforms keep one of each pair of waves
        waves[:, 1 : (x + 1) // 2] *= 2
    uniform = (intensity**2).sum((1, 2)) / np.maximum(intensity.sum((1, 2)), 1e-100)
    phase = scale**2 * slope_spread.mean((1, 2)) * waves.sum() / (y * x) / np.maximum(uniform, 1e-100) ** 2
    # near zero intensity the square root is no longer linear: its error is at most sqrt(deviation)
    amplitude = spread / (4 * np.maximum(intensity, np.sqrt(spread)) + 1e-30)
    # an error of the phase turns the field about zero, at most to the other side
    variance = amplitude + intensity * np.minimum(phase, 2).reshape(batch, 1, 1)
    # without a usable plane all that is known is how bright fields are
    return np.where(spread > 0, variance, uniform.reshape(batch, 1, 1)).astype(np.float32)


@partial(jax.jit, static_argnums=(7, 8))
def _solve(
    intensity: jax.Array,
    slope: jax.Array,
    scale: jax.Array,
    pull: jax.Array,
    darkest: jax.Array,
    tolerance: jax.Array,
    iterations: Any,
    refined: bool,
    mirrored: bool,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Fields (b, y, x), the part of the derivative that is left (b), steps (b)."""
    intensity = jnp.maximum(intensity, 0)
    total = jnp.maximum(intensity.sum((1, 2), keepdims=True), 1e-30)
    # a lamp that drifts makes all light change alike: no phase does
    source = scale * (slope - intensity * slope.sum((1, 2), keepdims=True) / total)
    # a uniform intensity that stands for all: as much as a typical photon sees
    uniform = jnp.maximum((intensity**2).sum((1, 2), keepdims=True) / total, 1e-30)
    laplacian = jnp.asarray(_laplacian((intensity.shape[1], intensity.shape[2]), mirrored), intensity.dtype) + pull

    def as_if_uniform(left: jax.Array) -> jax.Array:
        return _inverse(left / uniform, laplacian, mirrored)

    if not refined:
        phase = as_if_uniform(source)
        count = jnp.zeros(len(intensity), jnp.int32)
        rest = jnp.zeros(len(intensity), intensity.dtype)
    else:
        faces = _faces(intensity, darkest * uniform, mirrored)
        phase, rest, count = _refine(
            source, as_if_uniform, partial(_carried, faces, pull * uniform, mirrored), tolerance, iterations
        )  # fmt: skip
    phase = phase - (phase * intensity).sum((1, 2), keepdims=True) / total
    amplitude = jnp.sqrt(intensity)
    field = jax.lax.complex(amplitude * jnp.cos(phase), amplitude * jnp.sin(phase))
    return field, rest, count


Steps = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]


def _refine(
    source: jax.Array,
    as_if_uniform: Callable[[jax.Array], jax.Array],
    carried: Callable[[jax.Array], jax.Array],
    tolerance: jax.Array,
    iterations: Any,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Phase whose ``carried`` is the source (b, y, x), the part left (b), steps (b), by conjugate gradients.

    Where the phase as if uniform is right (``carried`` of it is the source) the first step ends it.
    """

    def dot(one: jax.Array, other: jax.Array) -> jax.Array:
        return (one * other).sum((1, 2), keepdims=True)

    first = as_if_uniform(source)
    power = dot(source, first)
    floor = jnp.maximum(power * tolerance**2, 1e-30)

    def step(carry: Steps) -> Steps:
        phase, left, direction, energy, count, number = carry
        moving = energy > floor
        image = carried(direction)
        # a field that is done stays as it is while others of its batch move
        length = jnp.where(moving, energy / jnp.maximum(dot(direction, image), 1e-30), 0)
        phase, left = phase + length * direction, left - length * image
        corrected = as_if_uniform(left)
        after = jnp.where(moving, dot(left, corrected), energy)
        direction = corrected + after / jnp.maximum(energy, 1e-30) * direction
        return phase, left, direction, after, count + moving[:, 0, 0], number + 1

    def unfinished(carry: Steps) -> jax.Array:
        return (carry[5] < iterations) & jnp.any(carry[3] > floor)

    start = (jnp.zeros_like(source), source, first, power, jnp.zeros(len(source), jnp.int32), jnp.array(0))
    phase, _, _, energy, count, _ = jax.lax.while_loop(unfinished, step, start)
    return phase, jnp.sqrt(jnp.maximum(energy, 0) / jnp.maximum(power, 1e-30))[:, 0, 0], count


def _extend(values: jax.Array, axis: int, mirrored: bool) -> jax.Array:
    """Three more pixels at both ends of an axis, as the edge of the frame has it."""
    margin = [(0, 0)] * values.ndim
    margin[axis] = (3, 3)
    return jnp.pad(values, margin, mode="symmetric" if mirrored else "wrap")


def _between(values: jax.Array, axis: int, outer: float, inner: float, sign: int) -> jax.Array:
    """From n samples the n - 3 combinations of four neighbours, which stand between the middle two."""
    n = values.shape[axis]
    a, b, c, d = (jax.lax.slice_in_dim(values, i, n - 3 + i, axis=axis) for i in range(4))
    return inner * (c + sign * b) + outer * (d + sign * a)


def _faces(intensity: jax.Array, floor: jax.Array, mirrored: bool) -> list[jax.Array]:
    """Intensity between neighbouring pixels, down and across, interpolated by cubics; at least the floor."""
    return [
        jnp.maximum(_between(_extend(intensity, axis, mirrored), axis, -1 / 16, 9 / 16, 1), floor) for axis in (1, 2)
    ]


def _carried(faces: list[jax.Array], pull: jax.Array, mirrored: bool, phase: jax.Array) -> jax.Array:
    r""":math:`-\nabla \cdot (I \nabla \phi) + p \phi`: differences between pixels, of fourth order, twice."""
    total = pull * phase
    for axis, face in zip((1, 2), faces, strict=True):
        flux = face * _between(_extend(phase, axis, mirrored), axis, -1 / 24, 27 / 24, -1)
        total = total - _between(flux, axis, -1 / 24, 27 / 24, -1)
    return total


def _laplacian(frame: tuple[int, int], mirrored: bool) -> np.ndarray:
    """What :func:`_carried` of intensity 1 does to the waves of a transform, (y, x) or (y, x // 2 + 1)."""
    y, x = frame
    turns = [np.arange(n) / (2 * n) for n in frame] if mirrored else [np.fft.fftfreq(y), np.fft.rfftfreq(x)]
    down, across = (((27 * np.sin(np.pi * f) - np.sin(3 * np.pi * f)) / 12) ** 2 for f in turns)
    return down[:, None] + across


def _inverse(values: jax.Array, laplacian: jax.Array, mirrored: bool) -> jax.Array:
    """Divide by the Laplacian, wave by wave: cosines for a mirrored frame, complex waves for a periodic one."""
    if mirrored:
        return jax.scipy.fft.idctn(jax.scipy.fft.dctn(values, axes=(1, 2)) / laplacian, axes=(1, 2))
    return jnp.fft.irfft2(jnp.fft.rfft2(values) / laplacian, s=values.shape[1:])
