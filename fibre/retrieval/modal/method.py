"""The method: geometry once, then for every field a start and Gauss-Newton steps."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.fft
import scipy.sparse.linalg
import scipy.spatial

from fibre.fibrelets import LocalPower
from fibre.propagation import defocus_masks, phase_per_metre
from fibre.records import Fibrelets, Images, RetrievalStatus
from fibre.retrieval.base import Amplitudes, ModeMethod, Solution, Stack
from fibre.retrieval.gerchberg_saxton import GerchbergSaxton
from fibre.retrieval.modal.captures import second_polarisation
from fibre.retrieval.modal.newton import Coupling, Found, Problem, make_coupling, refine
from fibre.retrieval.modal.start import Neighbours, make_neighbours, spreads, synchronise
from fibre.retrieval.modal.views import Views, coarse_images, coarse_variance, make_views
from polinfer.checks import integer, one_of_types, real_number

__all__ = ["Modal"]

LARGE = 1 << 18  # pixels of a frame, from which on two threads make one FFT faster
MOST = 20  # Gerchberg-Saxton sweeps where no image is local


@dataclass(frozen=True)
class Modal(ModeMethod):
    r"""The complex amplitudes of the fibrelet modes that explain the images best.

    The field is :math:`E = \sum_k c_k \psi_k` with Gaussian modes :math:`\psi_k` at known places, so thousands of
    numbers are sought and not a frame, from all photons of all images:

    .. math:: \min_c \sum_i \sum_x w_i \left( g_i |F^{-1} M_i F[E]|^2 - I_i \right)^2

    with weights inverse to the variances, by Gauss-Newton steps whose linear equations are solved by conjugate
    gradients. Two things make that fast and sure. In images of little defocus only neighbouring modes meet; they are
    *linear* in the powers and the products :math:`c_k c_l^*` of neighbours, which are found first, and phases put
    together from them: no random start, no stagnation. And the steps are preconditioned by the Laplacian of the
    neighbours' phases, in which errors are large that reach far. Where no image is that local (masks that spread
    light, large defocus), a few sweeps of :class:`fibre.GerchbergSaxton` make the start.

    All is computed on a grid of half a mode radius, with images filtered to its band limit. That leaves an error of
    0.4 % in the field; a coarser one (``coarsening``) is faster: 0.6 radii take two thirds of the pixels and leave 1 %,
    0.7 radii half of them and 5 %. Light that no mode carries is a misfit.

    Parameters
    ----------
    fibrelets: places and radii of the modes. steps: most Gauss-Newton steps, >= 1. inner: most conjugate gradients in
    each, >= 1. tolerance: relative change of the amplitudes at which the steps end, >= 0. focus_spread: metres,
    standard deviation of a common error of all distances, found with the field; 0: none, and needed where masks are
    not those of a defocus. gain_spread: the same for the brightness of each image, relative to 1. coarsening: camera
    pixels in a pixel of the grid, >= 1, whole or not, where it divides the frame into even numbers; None: as many as
    make half a mode radius.

    Raises
    ------
    ValueError: settings out of range; focus_spread for images that were not made by defocus. TypeError: fibrelets of
    another kind.

    Source: the products of neighbours are PhaseLift (Candes, Strohmer and Voroninski, 2013), made local; Gauss-Newton
    for phase retrieval, Fienup (1982) and later.

    >>> from fibre import Bundle, Defocus, Fibrelets, Modal, retrieve
    >>> bundle = Bundle.hexagonal(radius=15e-6, rng=0)
    >>> c = np.exp(2j * np.pi * np.random.default_rng(1).random((2, bundle.cores)))
    >>> z = np.array([-1, 0, 1]) * 8e-6
    >>> images = np.abs(bundle.image(c, (64, 64), 0.78e-6, z)[:, 0]) ** 2
    >>> method = Modal(Fibrelets(bundle.centres, bundle.mode_radius))
    >>> field = retrieve(Defocus(images, z, bundle.wavelength, 0.78e-6), method).field
    >>> true = bundle.image(c, (64, 64), 0.78e-6)[0]
    >>> bool(abs(np.vdot(field, true)) > 0.999 * np.linalg.norm(field) * np.linalg.norm(true))
    True
    """

    fibrelets: Fibrelets
    steps: int = 12
    inner: int = 8
    tolerance: float = 2e-3
    focus_spread: float = 0.0
    gain_spread: float = 0.0
    coarsening: float | None = None

    def __post_init__(self) -> None:
        one_of_types("fibrelets", self.fibrelets, (Fibrelets,), "pass Fibrelets(centres, mode_radius).")
        integer("steps", self.steps, low=1)
        integer("inner", self.inner, low=1)
        real_number("tolerance", self.tolerance, low=0)
        real_number("focus_spread", self.focus_spread, low=0)
        real_number("gain_spread", self.gain_spread, low=0)
        if self.coarsening is not None:
            real_number("coarsening", self.coarsening, low=1)

    def solve(self, stack: Stack) -> Solution:
        """See :meth:`RetrievalMethod.solve`."""
        geometry = _geometry(self, stack)
        count, cores = len(stack.intensities), os.cpu_count() or 1

        def one(k: int) -> tuple[Found, bool]:
            with scipy.fft.set_workers(_workers(count, stack)):
                images, spread = _coarse(stack, k, geometry.views.step)
                found = self._found(stack, k, geometry, images, spread)
                misfitted = stack.variance is not None and _judged(found, images, spread)[1]
            return found, misfitted

        # a field to a thread: nearly all is inside FFTs and sparse products, which let other threads run
        with ThreadPoolExecutor(min(count, cores)) as pool:
            found, misfitted = zip(*pool.map(one, range(count)), strict=True)
        field = np.stack([geometry.camera.focus(each.amplitudes) for each in found])
        converged = np.array([self._converged(each) for each in found])
        steps = np.array([each.steps for each in found])
        known = None if stack.variance is None else np.array(misfitted)
        return Solution(field, converged, steps, misfitted=known)

    def amplitudes(self, images: Images, captures: range) -> Amplitudes:
        """See :meth:`ModeMethod.amplitudes`."""
        planes, distances = len(images.diversity), np.asarray(images.diversity, float)
        masks = defocus_masks(images.frame, distances.tobytes(), images.wavelength, images.pixel_size)
        cores = os.cpu_count() or 1

        def one(radiance: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, int, np.ndarray]:
            stack = Stack(radiance[None, :planes], noise[None, :planes], masks, distances, images.wavelength,
                          images.pixel_size)  # fmt: skip
            with scipy.fft.set_workers(_workers(len(captures), stack)):
                geometry = _geometry(self, stack)
                coarse, spread = _coarse(stack, 0, geometry.views.step)
                found = self._found(stack, 0, geometry, coarse, spread)
                floor, misfitted = _judged(found, coarse, spread)
                # a coarse pixel is the mean of step^2 of the camera's, and modes are of unit power over those
                floor *= geometry.views.step**2
                second, variance, prior = second_polarisation(
                    geometry.views, geometry.local, found.amplitudes, floor, radiance[planes:], noise[planes:],
                    images.steps,
                )  # fmt: skip
            status = 0 if self._converged(found) else int(RetrievalStatus.NOT_CONVERGED)
            status |= int(RetrievalStatus.MISFIT) if misfitted else 0
            both = np.stack([found.amplitudes, second]), np.stack([np.full(variance.shape, floor), variance])
            return *both, status, np.stack([np.full(prior.shape, np.inf), prior])

        # one more than there are cores: three captures end together on two
        with ThreadPoolExecutor(min(len(captures), cores + 1)) as pool:
            # read here, one after the other: a lazy stack makes its parts together, and not in two threads
            tasks = [pool.submit(one, *_read(images, c)) for c in captures]
            values, variances, status, most = zip(*(task.result() for task in tasks), strict=True)
        return Amplitudes(np.stack(values), np.stack(variances), np.array(status, np.uint8), np.stack(most))

    def _converged(self, found: Found) -> bool:
        return found.step <= max(self.tolerance, 2e-2)

    def _found(self, stack: Stack, k: int, geometry: Geometry, images: np.ndarray, spread: np.ndarray) -> Found:
        """Amplitudes of field ``k``, and what was found of the bench, from images and variances of the coarse grid.

        The field in focus is the sum of them times modes of unit sum of squares over the camera's pixels.
        """
        ones = np.ones(len(images))
        if not np.any(stack.intensities[k] > 0):
            dark = np.zeros(len(self.fibrelets.centres), complex)
            return Found(dark, 0.0, ones, 0.0, 0.0, powers=np.zeros_like(images))
        weights = np.where(np.isfinite(spread), 1 / spread, 0).astype(np.float32)
        turn = None
        if self.focus_spread > 0:
            if stack.distances is None:
                raise ValueError("focus_spread is positive, but the images were not made by defocus; build them with "
                                 "Defocus(...) or set focus_spread to 0.")  # fmt: skip
            turn = geometry.turn
        problem = Problem(images, weights, turn, self.focus_spread, self.gain_spread)
        if geometry.neighbours is None:
            start = self._swept(stack, k, geometry)
        else:
            powers, products = geometry.neighbours.products(images)
            start = synchronise(geometry.neighbours.pairs, powers, products)
        return refine(geometry.views, geometry.coupling, problem, Found(start, 0.0, ones), self.steps, self.inner,
                      self.tolerance)  # fmt: skip

    def _swept(self, stack: Stack, k: int, geometry: Geometry) -> np.ndarray:
        """Amplitudes from a few sweeps of all planes."""
        own = slice(k, k + 1)
        variance = None if stack.variance is None else stack.variance[own]
        one = replace(stack, intensities=stack.intensities[own], variance=variance)
        field = GerchbergSaxton(iterations=MOST, averaging=0, restarts=1).solve(one).field[0]
        camera = geometry.camera
        parts = camera.transposed @ field.reshape(-1, 1).view(np.float32)
        parts = geometry.gram.solve(parts.astype(float))
        return parts[:, 0] + 1j * parts[:, 1]


class Geometry(NamedTuple):
    """What depends on fibrelets, frame and masks only. ``camera``: the camera's own grid."""

    views: Views
    camera: Views
    coupling: Coupling
    neighbours: Neighbours | None
    gram: scipy.sparse.linalg.SuperLU
    turn: np.ndarray
    local: LocalPower


class _Key:
    """Fibrelets and masks by their values: the geometry takes seconds, and a run asks for the same one every time."""

    def __init__(self, method: Modal, stack: Stack) -> None:
        self.method, self.stack = method, stack
        known = stack.masks if stack.distances is None else stack.distances
        fibrelets = method.fibrelets
        self.values = (fibrelets.centres.tobytes(), fibrelets.mode_radius.tobytes(), known.tobytes(),
                       stack.masks.shape, stack.pixel_size, stack.wavelength, method.coarsening)  # fmt: skip

    def __hash__(self) -> int:
        return hash(self.values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self.values == other.values


def _workers(fields: int, stack: Stack) -> int:
    """Threads for one FFT while so many fields are found side by side: in small ones they wait for each other."""
    return max(1, (os.cpu_count() or 1) // fields) if np.prod(stack.masks.shape[-2:]) >= LARGE else 1


def _geometry(method: Modal, stack: Stack) -> Geometry:
    return _made(_Key(method, stack))


@lru_cache(maxsize=2)
def _made(key: _Key) -> Geometry:
    method, masks, pixel = key.method, key.stack.masks, key.stack.pixel_size
    key.method = key.stack = None  # type: ignore[assignment]  # the cache must not hold images
    fibrelets, wavelength = method.fibrelets, key.values[5]
    views = make_views(fibrelets, masks, pixel, method.coarsening)
    camera = make_views(fibrelets, masks, pixel, 1)
    fields, radii = spreads(fibrelets, masks, pixel)
    tree = scipy.spatial.cKDTree(fibrelets.centres)
    gram = scipy.sparse.linalg.splu((camera.transposed @ camera.modes).tocsc().astype(float))
    turn, _ = phase_per_metre(views.masks.shape[-2:], wavelength, views.pixel_size)
    return Geometry(views, camera, make_coupling(tree, views, radii),
                    make_neighbours(fibrelets, views, fields, radii, pixel), gram, turn.astype(np.float32),
                    LocalPower(views.squares, fibrelets.centres))  # fmt: skip


def _judged(found: Found, images: np.ndarray, spread: np.ndarray) -> tuple[float, bool]:
    """As :func:`fibre.retrieval.base.judged`, of images on the coarse grid (image, y, x) and what was found of them:
    variance of the field from the noise of the images, and whether field and images differ by more."""
    assert found.powers is not None
    total = left = light = 0.0
    count = 0
    for image, variance, power, gain in zip(images, spread, found.powers, found.gains, strict=True):
        amplitude, weight, usable = _amplitude_weights(image / np.float32(gain), variance)
        total += float(weight.sum(dtype=float))
        left += float(np.vdot(weight, (np.sqrt(power) - amplitude) ** 2))
        light += float(np.vdot(weight, amplitude**2))
        count += usable
    if not total > 0:
        return float(max(np.abs(images).sum(), 1.0)), True  # no pixel says anything: all light that there could be
    expected = count / total
    return 2 * expected / len(images), left > 2 * count + 0.01 * light


def _amplitude_weights(image: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Amplitudes of an image, their inverse variances, and how many are usable."""
    usable = np.isfinite(variance)
    known = np.where(usable, variance, 1)
    # near zero intensity the square root is no longer linear: its error is at most sqrt(deviation)
    weight = np.where(usable, 4 * np.maximum(image, np.sqrt(known)) / known, 0)
    return np.sqrt(np.maximum(image, 0)), weight, int(np.count_nonzero(usable))


def _read(images: Images, capture: int) -> tuple[np.ndarray, np.ndarray]:
    """Radiance of a capture and its variance, infinite where saturated, float32 (image, y, x)."""
    radiance = np.asarray(images.radiance[capture], np.float32)
    noise, saturated = np.asarray(images.variance[capture], np.float32), np.asarray(images.saturated[capture])
    if saturated.any() and np.any(np.isfinite(noise[saturated])):
        noise = np.where(saturated, np.float32(np.inf), noise)
    return radiance, noise


def _coarse(stack: Stack, k: int, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Images of field ``k`` and their variances on the coarse grid, (image, y, x)."""
    intensities = stack.intensities[k]
    variance = _variance(intensities) if stack.variance is None else stack.variance[k]
    return coarse_images(intensities, step), coarse_variance(variance, step)


def _variance(images: np.ndarray) -> np.ndarray:
    """Where nothing is known of the noise: in proportion to the light, with a floor of 1 % of its mean."""
    mean = images.mean(axis=(1, 2), keepdims=True)
    return np.maximum(images, 0) + 0.01 * mean
