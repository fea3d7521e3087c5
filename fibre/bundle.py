"""Forward model of the fibre bundle: cores on a jittered hexagonal lattice, coupled to their neighbours.

In: amplitudes of the fibrelet modes at the distal facet, or fields in front of it. Out: amplitudes at the proximal
facet, and the camera's view of them at any defocus. Called by the simulated bench and by tests of recovery.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.fft
import scipy.sparse
import scipy.spatial

from fibre.evolution import Evolution
from fibre.propagation import defocus_masks
from fibre.transmission import Frame, Transmission
from polinfer.checks import as_generator, complex_array, integer, real_array, real_number
from polinfer.storage import array

__all__ = ["Bundle"]

REACH = 4.2  # mode radii, beyond which a mode's light is left out
TILE = 64  # pixels along a side of what is made at once


@dataclass(frozen=True)
class Bundle:
    r"""A bundle of single-mode fibrelets with two polarisations each.

    The amplitudes (h, v) of core k at the distal facet arrive at the proximal facet as :math:`c' = T c` with

    .. math:: T = e^{i K}, \quad K = L \, (\beta + \text{coupling})

    and the Hermitian K, of the fibre's whole length L, holds each core's propagation constant and birefringence on its
    2 x 2 diagonal blocks and the coupling to its nearest neighbours beside them. T is applied and never formed
    (:class:`fibre.evolution.Evolution`).

    Parameters
    ----------
    centres: (m, 2) metres, (row, column), of the cores at the proximal facet, which the camera sees. mode_radius: (m,)
    metres, 1/e field radius of the Gaussian mode. coupling: K, sparse Hermitian (2 m, 2 m) in radians, rows and columns
    ordered h of all cores, then v. wavelength: metres, in vacuum. distal_centres: (m, 2) metres at the distal facet;
    None: as at the proximal one.

    Raises
    ------
    ValueError: shapes that do not fit, values that are not finite, a coupling that is not Hermitian.

    Source: coupled-mode theory of multicore fibres; lattice after imaging bundles of about 4.5 um pitch.

    >>> bundle = Bundle.hexagonal(radius=20e-6, rng=0)
    >>> far = bundle.transmit(np.ones((2, bundle.cores)))
    >>> bool(np.isclose(np.linalg.norm(far) ** 2, 2 * bundle.cores))  # lossless
    True
    """

    centres: np.ndarray = array(("core", "row_column"), "m")
    mode_radius: np.ndarray = array(("core",), "m")
    coupling: Any = array(("row", "column"), "rad")
    wavelength: float = 850e-9
    distal_centres: np.ndarray = array(("core", "row_column"), "m", default=None)

    def __post_init__(self) -> None:
        centres = real_array("centres", self.centres, shape=(None, 2), finite=True)
        m = len(centres)
        object.__setattr__(self, "centres", centres)
        object.__setattr__(
            self, "mode_radius", real_array("mode_radius", self.mode_radius, shape=(m,), above=0, finite=True)
        )
        distal: Any = centres if self.distal_centres is None else self.distal_centres
        object.__setattr__(self, "distal_centres", real_array("distal_centres", distal, shape=(m, 2), finite=True))
        if not scipy.sparse.issparse(self.coupling) or self.coupling.shape != (2 * m, 2 * m):
            raise ValueError(f"coupling must be a sparse matrix of shape ({2 * m}, {2 * m}) for {m} cores.")
        coupling = scipy.sparse.csr_array(self.coupling)
        skew = coupling - coupling.conj().T
        if not np.all(np.isfinite(coupling.data)) or np.any(np.abs(skew.data) > 1e-9 * np.abs(coupling.data).max()):
            raise ValueError("coupling must be finite and Hermitian: what one core gives, the other gives back.")
        object.__setattr__(self, "coupling", coupling)
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
        registration: Any = None,
        rng: int | np.random.Generator | None = None,
    ) -> Bundle:
        """A round bundle on a hexagonal lattice.

        ``radius``, ``pitch``, ``jitter`` (standard deviation of each coordinate), ``mode_radius``, ``wavelength`` in
        metres; ``mode_spread`` relative. The fibre's length is contained in the three dimensionless products
        ``detuning`` (spread of propagation constants times length, radians), ``birefringence`` (per core, radians)
        and ``coupling`` (between touching neighbours, radians). ``registration``: affine map (2, 3) from the proximal
        facet to the distal one, whose lattice may lie turned, larger and shifted; None: the same.
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
        matrix = _couplings(centres, pitch, detuning, birefringence, coupling, generator)
        if registration is None:
            return cls(centres, radii, matrix, wavelength)
        affine = real_array("registration", registration, shape=(2, 3), finite=True)
        return cls(centres, radii, matrix, wavelength, centres @ affine[:, :2].T + affine[:, 2])

    @property
    def cores(self) -> int:
        """Number of fibrelets m."""
        return len(self.centres)

    @cached_property
    def evolution(self) -> Evolution:
        """The exponential of the coupling."""
        return Evolution.of(self.coupling)

    @cached_property
    def transfer(self) -> scipy.sparse.csc_array:
        """T as a sparse matrix (2 m, 2 m), entries below 1e-9 left out: for small bundles. Each core reaches some
        hundred others, so ten thousand cores take minutes and hundreds of megabytes, where :meth:`transmit` takes
        milliseconds."""
        return self.columns(scipy.sparse.eye_array(2 * self.cores, format="csc"), faint=1e-9)

    def columns(self, launched: Any, faint: float = 0.0) -> scipy.sparse.csc_array:
        """T times sparse columns of amplitudes (2 m, w), sparse; entries of modulus below ``faint`` left out."""
        launched = scipy.sparse.csc_array(launched)
        if launched.shape[0] != 2 * self.cores:
            raise ValueError(f"launched must have {2 * self.cores} rows, got shape {launched.shape}.")
        parts = []
        for start in range(0, launched.shape[1], 128):
            part = self.evolution.apply(launched[:, start : start + 128].toarray())
            part[np.abs(part) < faint] = 0
            parts.append(scipy.sparse.csc_array(part))
        return scipy.sparse.csc_array(scipy.sparse.hstack(parts, format="csc"))

    def disturbed(self, piston: float = 0.0, tilt: tuple[float, float] = (0.0, 0.0), heating: float = 0.0) -> Bundle:
        r"""The bundle after slow bending and warming.

        .. math:: K' = (1 + \text{heating}) K + \text{piston} + \text{tilt} \cdot r

        A bend of the whole fibre makes the cores on its outer side longer in proportion to their place r: radians per
        metre along (row, column). ``heating`` is the relative change of the optical length beyond what all cores have
        in common, which is the ``piston``, radians.
        """
        row, column = (real_number("tilt", t) for t in tilt)
        extra = real_number("piston", piston) + self.centres @ [row, column]
        diagonal = scipy.sparse.diags_array(np.concatenate([extra, extra]))
        return replace(self, coupling=(1 + real_number("heating", heating, above=-1)) * self.coupling + diagonal)

    def transmit(self, amplitudes: Any) -> np.ndarray:
        """Mode amplitudes at the proximal facet, complex (*B, 2, m), from those at the distal facet, (*B, 2, m)."""
        return self._evolved(amplitudes, 1)

    def transmit_adjoint(self, amplitudes: Any) -> np.ndarray:
        """The adjoint of :meth:`transmit`, which is its inverse: <T x, y> = <x, T* y>. Shapes (*B, 2, m)."""
        return self._evolved(amplitudes, -1)

    def _evolved(self, amplitudes: Any, sign: int) -> np.ndarray:
        amplitudes = complex_array("amplitudes", amplitudes, trailing=(2, self.cores))
        columns = np.ascontiguousarray(amplitudes.reshape(-1, 2 * self.cores).T)
        return np.ascontiguousarray(self.evolution.apply(columns, sign).T).reshape(amplitudes.shape)

    def propagate(
        self, fields: Any, sample: Frame, camera: Frame | None = None, distance: float = 0.0, defocus: float = 0.0
    ) -> np.ndarray:
        """Fields at the camera, complex (*B, 2, y, x), from fields at the sample plane (*B, 2, y, x).

        ``sample``, ``camera`` (None: the same): :class:`fibre.Frame`, on which they are sampled. ``distance``: metres
        from the sample to the distal facet; ``defocus``: metres from the proximal facet to the plane that the camera
        sees. See :class:`fibre.Transmission`; the geometry is kept for the next call with the same frames.
        """
        return self._between(sample, camera, distance, defocus).propagate(fields)

    def adjoint(
        self, fields: Any, sample: Frame, camera: Frame | None = None, distance: float = 0.0, defocus: float = 0.0
    ) -> np.ndarray:
        """The adjoint of :meth:`propagate`: fields at the camera (*B, 2, y, x) to fields at the sample plane."""
        return self._between(sample, camera, distance, defocus).adjoint(fields)

    def matrix(
        self, window: Any, sample: Frame, camera: Frame | None = None, distance: float = 0.0
    ) -> scipy.sparse.csc_array:
        """The columns of the transmission matrix of the sample's pixels in ``window``, boolean (y, x): sparse (2 y x of
        the camera, 2 w). See :meth:`fibre.Transmission.matrix`."""
        return self._between(sample, camera, distance, 0.0).matrix(window)

    def _between(self, sample: Frame, camera: Frame | None, distance: float, defocus: float) -> Transmission:
        wanted = (sample, sample if camera is None else camera, distance, defocus)
        kept: tuple[Any, Transmission] | None = self.__dict__.get("_last")
        if kept is None or kept[0] != wanted:
            kept = (wanted, Transmission(self, *wanted))
            self.__dict__["_last"] = kept
        return kept[1]

    def launch(self, points: Any, waist: float) -> scipy.sparse.csr_array:
        r"""Amplitude that a unit-power Gaussian spot at each point of the distal facet launches in each core.

        Sparse real (m, p):

        .. math:: \frac{2 w w_k}{w^2 + w_k^2} e^{-|r - r_k|^2 / (w^2 + w_k^2)}

        the overlap of two Gaussians. ``points`` (p, 2) and ``waist`` (1/e field radius) in metres.
        """
        points = real_array("points", points, shape=(None, 2), finite=True)
        waist = real_number("waist", waist, above=0)
        reach = 4 * np.sqrt(waist**2 + self.mode_radius.max() ** 2)
        tree = scipy.spatial.cKDTree(self.distal_centres)
        near = tree.query_ball_point(points, reach)
        column = np.repeat(np.arange(len(points)), [len(n) for n in near])
        row = np.concatenate([np.asarray(n, int) for n in near]) if len(column) else np.zeros(0, int)
        distance2 = ((points[column] - self.distal_centres[row]) ** 2).sum(1)
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
        The optical axis is the middle of the frame. A mode's light ends where it is less than 1e-7 of its middle's.
        """
        amplitudes = complex_array("amplitudes", amplitudes, trailing=(2, self.cores))
        distances = real_array("distances", distances, finite=True)
        oversampling, padding = integer("oversampling", oversampling, low=1), integer("padding", padding, low=1)
        step = real_number("pixel_size", pixel_size, above=0) / oversampling
        inner = (shape[0] * oversampling, shape[1] * oversampling)
        # as many pixels on either side of the frame
        height, width = (n * padding + n * (padding - 1) % 2 for n in inner)
        outer = (height, width)
        rows, columns = (slice((o - i) // 2, (o - i) // 2 + i) for o, i in zip(outer, inner, strict=True))
        masks = defocus_masks(outer, distances.tobytes(), self.wavelength, step)
        batch = amplitudes.reshape(-1, self.cores).astype(np.complex64)
        frames = np.empty((len(batch), distances.size, *inner), np.complex64)
        for b, c in enumerate(batch):
            focus = self._in_focus(c, outer, step)
            spectrum = None
            for z, distance in enumerate(distances.ravel()):
                if distance == 0:
                    frames[b, z] = focus[rows, columns]
                    continue
                spectrum = scipy.fft.fft2(focus, workers=-1) if spectrum is None else spectrum
                # what leaves the frame is not computed along the second axis
                half: Any = scipy.fft.ifft(spectrum * masks[z], axis=0, workers=-1, overwrite_x=True)
                frames[b, z] = scipy.fft.ifft(half[rows], axis=1, workers=-1)[:, columns]
        frames = frames.reshape(*amplitudes.shape[:-1], *distances.shape, *inner)
        return np.moveaxis(frames, amplitudes.ndim - 2, -3)

    def _in_focus(self, amplitudes: np.ndarray, shape: tuple[int, int], step: float) -> np.ndarray:
        """The field in focus, complex64 (y, x), of amplitudes (m,) on pixels of ``step`` metres, tile by tile: each is
        the product of the profiles of the modes whose light comes there."""
        field = np.empty(shape, np.complex64)
        reach = REACH * float(self.mode_radius.max())
        y, x = ((np.arange(n) - (n - 1) / 2) * step for n in shape)
        parts = np.stack([amplitudes.real, amplitudes.imag]) * np.sqrt(2 / np.pi) / self.mode_radius
        for top in range(0, shape[0], TILE):
            rows = slice(top, top + TILE)
            beside = self._within(0, y[rows], reach, np.arange(self.cores))
            for left in range(0, shape[1], TILE):
                columns = slice(left, left + TILE)
                near = self._within(1, x[columns], reach, beside)
                down, across = (self._profile(u, axis, near) for axis, u in enumerate((y[rows], x[columns])))
                seen = (parts[:, None, near].astype(np.float32) * down) @ across.T
                field.real[rows, columns], field.imag[rows, columns] = seen
        return field

    def _within(self, axis: int, u: np.ndarray, reach: float, of: np.ndarray) -> np.ndarray:
        """Those of some modes that are within ``reach`` of places along an axis."""
        centre = self.centres[of, axis]
        return of[(centre > u[0] - reach) & (centre < u[-1] + reach)]

    def _profile(self, u: np.ndarray, axis: int, modes: np.ndarray) -> np.ndarray:
        """The modes' Gaussians at places along an axis, float32 (u, modes)."""
        away = (u[:, None] - self.centres[modes, axis]) / self.mode_radius[modes]
        return np.exp(-(away**2)).astype(np.float32)


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
