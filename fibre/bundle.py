"""Forward model of the fibre bundle: cores on a jittered hexagonal lattice, coupled to their neighbours.

In: amplitudes of the fibrelet modes at the distal facet. Out: amplitudes at the proximal facet, and the camera's
view of them at any defocus. Called by the simulated bench and by tests of recovery.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.fft
import scipy.sparse
import scipy.spatial

from fibre.propagation import transfer_function
from polinfer.checks import as_generator, complex_array, integer, real_array, real_number
from polinfer.storage import array

__all__ = ["Bundle"]


@dataclass(frozen=True)
class Bundle:
    r"""A bundle of single-mode fibrelets with two polarisations each.

    The amplitudes (h, v) of core k at the distal facet arrive at the proximal facet as :math:`c' = T c` with

    .. math:: T = e^{i L K}

    and the Hermitian K holds each core's propagation constant and birefringence on its 2 x 2 diagonal blocks and the
    coupling to its nearest neighbours beside them. T is kept as a sparse matrix: coupling is local.

    Parameters
    ----------
    centres: (m, 2) metres, (row, column). mode_radius: (m,) metres, 1/e field radius of the Gaussian mode.
    transfer: sparse complex (2 m, 2 m), rows and columns ordered h of all cores, then v of all cores.
    wavelength: metres, in vacuum.

    Source: coupled-mode theory of multicore fibres; lattice after imaging bundles of about 4.5 um pitch.

    >>> bundle = Bundle.hexagonal(radius=20e-6, rng=0)
    >>> far = bundle.propagate(np.ones((2, bundle.cores)))
    >>> bool(np.isclose(np.linalg.norm(far) ** 2, 2 * bundle.cores, rtol=1e-3))  # lossless
    True
    """

    centres: np.ndarray = array(("core", "row_column"), "m")
    mode_radius: np.ndarray = array(("core",), "m")
    transfer: Any = array(("row", "column"), "1")
    wavelength: float = 850e-9

    def __post_init__(self) -> None:
        centres = real_array("centres", self.centres, shape=(None, 2), finite=True)
        m = len(centres)
        object.__setattr__(self, "centres", centres)
        object.__setattr__(
            self, "mode_radius", real_array("mode_radius", self.mode_radius, shape=(m,), above=0, finite=True)
        )
        if not scipy.sparse.issparse(self.transfer) or self.transfer.shape != (2 * m, 2 * m):
            raise ValueError(f"transfer must be a sparse matrix of shape ({2 * m}, {2 * m}) for {m} cores.")
        object.__setattr__(self, "transfer", scipy.sparse.csr_array(self.transfer))
        real_number("wavelength", self.wavelength, above=0)

    @classmethod
    def hexagonal(
        cls,
        radius: float = 55e-6,
        pitch: float = 4.5e-6,
        jitter: float = 0.15e-6,
        mode_radius: float = 1.6e-6,
        mode_spread: float = 0.02,
        detuning: float = 8.0,
        birefringence: float = 2.0,
        coupling: float = 0.25,
        wavelength: float = 850e-9,
        rng: int | np.random.Generator | None = None,
    ) -> Bundle:
        """A round bundle on a hexagonal lattice.

        ``radius``, ``pitch``, ``jitter`` (standard deviation of each coordinate), ``mode_radius``, ``wavelength`` in
        metres; ``mode_spread`` relative. The fibre's length is contained in the three dimensionless products
        ``detuning`` (spread of propagation constants times length, radians), ``birefringence`` (per core, radians)
        and ``coupling`` (between touching neighbours, radians).
        """
        generator, _ = as_generator(rng)
        radius = real_number("radius", radius, above=0)
        pitch = real_number("pitch", pitch, above=0)
        if radius < pitch:
            raise ValueError(f"radius must be at least one pitch ({pitch:g} m), got {radius:g}.")
        rows = int(np.ceil(radius / (pitch * np.sqrt(3) / 2)))
        row, column = np.mgrid[-rows : rows + 1, -rows - 1 : rows + 2]
        lattice = np.stack([row * pitch * np.sqrt(3) / 2, (column + 0.5 * (row % 2)) * pitch], -1).reshape(-1, 2)
        lattice = lattice[np.hypot(*lattice.T) <= radius]
        m = len(lattice)
        centres = lattice + real_number("jitter", jitter, low=0) * generator.standard_normal((m, 2))
        radii = mode_radius * (1 + mode_spread * generator.standard_normal(m))
        generator_matrix = _couplings(centres, pitch, detuning, birefringence, coupling, generator)
        return cls(centres, radii, _exponential(1j * generator_matrix), wavelength)

    @property
    def cores(self) -> int:
        """Number of fibrelets m."""
        return len(self.centres)

    @cached_property
    def _adjoint_transfer(self) -> Any:
        return self.transfer.conj().T.tocsr()

    def _apply(self, matrix: Any, name: str, amplitudes: Any) -> np.ndarray:
        amplitudes = complex_array(name, amplitudes, trailing=(2, self.cores))
        flat = amplitudes.reshape(-1, 2 * self.cores)
        return np.asarray((matrix @ flat.T).T).reshape(amplitudes.shape)

    def propagate(self, amplitudes: Any) -> np.ndarray:
        """Mode amplitudes at the proximal facet, complex (*B, 2, m), from those at the distal facet, (*B, 2, m)."""
        return self._apply(self.transfer, "amplitudes", amplitudes)

    def adjoint(self, amplitudes: Any) -> np.ndarray:
        """The adjoint of :meth:`propagate`: <T x, y> = <x, T* y>. Shapes (*B, 2, m)."""
        return self._apply(self._adjoint_transfer, "amplitudes", amplitudes)

    def launch(self, points: Any, waist: float) -> scipy.sparse.csr_array:
        r"""Amplitude that a unit-power Gaussian spot at each point launches in each core, sparse real (m, p).

        .. math:: \frac{2 w w_k}{w^2 + w_k^2} e^{-|r - r_k|^2 / (w^2 + w_k^2)}

        the overlap of two Gaussians. ``points`` (p, 2) and ``waist`` (1/e field radius) in metres.
        """
        points = real_array("points", points, shape=(None, 2), finite=True)
        waist = real_number("waist", waist, above=0)
        reach = 4 * np.sqrt(waist**2 + self.mode_radius.max() ** 2)
        tree = scipy.spatial.cKDTree(self.centres)
        near = tree.query_ball_point(points, reach)
        column = np.repeat(np.arange(len(points)), [len(n) for n in near])
        row = np.concatenate([np.asarray(n, int) for n in near]) if len(column) else np.zeros(0, int)
        distance2 = ((points[column] - self.centres[row]) ** 2).sum(1)
        width2 = waist**2 + self.mode_radius[row] ** 2
        values = 2 * waist * self.mode_radius[row] / width2 * np.exp(-distance2 / width2)
        return scipy.sparse.csr_array((values, (row, column)), shape=(self.cores, len(points)))

    def image(
        self,
        amplitudes: Any,
        shape: tuple[int, int],
        pixel_size: float,
        distances: Any = 0.0,
        oversampling: int = 1,
        padding: int = 2,
    ) -> np.ndarray:
        r"""The field that the camera sees, complex64 (*B, *Z, 2, y, x), from proximal amplitudes (*B, 2, m).

        In focus every mode is a Gaussian,

        .. math:: \sqrt{\frac{2}{\pi}} \frac{1}{w_k} e^{-|r - r_k|^2 / w_k^2}

        of unit power per square metre; ``distances`` (metres, shape Z) along the beam the field follows the exact
        angular spectrum on a frame ``padding`` times as wide, so that light leaves the frame and does not come back.
        ``oversampling`` gives that many samples per pixel and axis: frames are then (oversampling y, oversampling x).
        The optical axis is the middle of the frame. Separable modes: a frame costs one product (y, m) (m, x).
        """
        amplitudes = complex_array("amplitudes", amplitudes, trailing=(2, self.cores))
        distances = real_array("distances", distances, finite=True)
        oversampling, padding = integer("oversampling", oversampling, low=1), integer("padding", padding, low=1)
        step = real_number("pixel_size", pixel_size, above=0) / oversampling
        inner = (shape[0] * oversampling, shape[1] * oversampling)
        outer = (inner[0] * padding, inner[1] * padding)
        rows, columns = (self._profile(n, step, self.centres[:, axis]) for axis, n in enumerate(outer))
        crop = tuple(slice((o - i) // 2, (o - i) // 2 + i) for o, i in zip(outer, inner, strict=True))
        masks = transfer_function(outer, distances.ravel(), self.wavelength, step).astype(np.complex64)
        batch = amplitudes.reshape(-1, self.cores).astype(np.complex64)
        frames = np.empty((len(batch), distances.size, *inner), np.complex64)
        for b, c in enumerate(batch):
            focus = (rows * c) @ columns.T
            spectrum = None
            for z, distance in enumerate(distances.ravel()):
                if distance == 0:
                    frames[b, z] = focus[crop]
                    continue
                spectrum = scipy.fft.fft2(focus, workers=-1) if spectrum is None else spectrum
                frames[b, z] = scipy.fft.ifft2(spectrum * masks[z], workers=-1)[crop]
        frames = frames.reshape(*amplitudes.shape[:-1], *distances.shape, *inner)
        return np.moveaxis(frames, amplitudes.ndim - 2, -3)

    def _profile(self, n: int, step: float, centres: np.ndarray) -> np.ndarray:
        u = (np.arange(n) - (n - 1) / 2) * step
        width = self.mode_radius
        return (np.sqrt(np.sqrt(2 / np.pi) / width) * np.exp(-(((u[:, None] - centres) / width) ** 2))).astype(
            np.float32
        )


def _couplings(
    centres: np.ndarray,
    pitch: float,
    detuning: float,
    birefringence: float,
    coupling: float,
    generator: np.random.Generator,
) -> scipy.sparse.csr_array:
    """L K: Hermitian, sparse (2 m, 2 m)."""
    m = len(centres)
    pairs = scipy.spatial.cKDTree(centres).query_pairs(1.35 * pitch, output_type="ndarray")
    i, j = pairs.T
    separation = np.hypot(*(centres[i] - centres[j]).T)
    # evanescent fields: coupling falls exponentially with the separation of the cores
    strength = coupling * np.exp(-4 * (separation / pitch - 1))
    neighbours = scipy.sparse.csr_array((strength, (i, j)), shape=(m, m))
    neighbours = neighbours + neighbours.T
    common = detuning * generator.standard_normal(m)
    axis = np.pi * generator.random(m)
    splitting = birefringence * np.abs(generator.standard_normal(m)) / 2
    hh = scipy.sparse.diags_array(common + splitting * np.cos(2 * axis)) + neighbours
    vv = scipy.sparse.diags_array(common - splitting * np.cos(2 * axis)) + neighbours
    hv = scipy.sparse.diags_array(-splitting * np.sin(2 * axis))
    return scipy.sparse.csr_array(scipy.sparse.block_array([[hh, hv], [hv, vv]]))


def _exponential(matrix: Any, tolerance: float = 1e-7) -> scipy.sparse.csr_array:
    """Exponential of a sparse matrix by scaling and squaring, entries below ``tolerance`` dropped at each squaring.

    The exponential of a local coupling is local, but scipy's exact one fills with rounding dust and is ten times
    slower. Each squaring doubles the error of the last, so it stays below 1e-4 in norm at the sizes met here.
    """
    norm = max(float(abs(matrix).sum(axis=1).max()), 1e-300)
    squarings = max(0, int(np.ceil(np.log2(norm / 0.25))))
    step = scipy.sparse.csr_array(matrix) / 2**squarings
    term = total = scipy.sparse.csr_array(scipy.sparse.eye_array(matrix.shape[0], dtype=complex))
    for order in range(1, 9):
        term = term @ step / order
        total = total + term
    for _ in range(squarings):
        total = total @ total
        total.data[np.abs(total.data) < tolerance] = 0
        total.eliminate_zeros()
    return scipy.sparse.csr_array(total)
