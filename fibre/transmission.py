"""From the sample plane to the camera: the bundle's transmission matrix A in factors, never as a dense matrix.

In: a bundle, the frames on which fields are sampled, distances. Out: fields at the camera, the adjoint, the sparse part
of A that belongs to a window, and the map as a JAX function. Called by ``Bundle.propagate`` and its companions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.fft
import scipy.interpolate
import scipy.sparse
import scipy.spatial
import scipy.special

from fibre.fibrelets import mode_matrix
from fibre.propagation import transfer_function
from fibre.records import Fibrelets
from polinfer.checks import complex_array, integer, one_of_types, real_number

if TYPE_CHECKING:
    from fibre.bundle import Bundle

__all__ = ["Frame", "Transmission"]

FAINT = 1e-6  # entries of a window's matrix below this, of its largest, are left out


@dataclass(frozen=True)
class Frame:
    """Square pixels on which a field is sampled. shape: (y, x). pixel_size: metres. The axis is the middle.

    >>> from fibre import Frame
    >>> (Frame((4, 6), 2e-6).points[0] * 1e6).round(3).tolist()
    [-3.0, -5.0]
    """

    shape: tuple[int, int]
    pixel_size: float

    def __post_init__(self) -> None:
        rows, columns = self.shape
        object.__setattr__(self, "shape", (integer("shape", rows, low=1), integer("shape", columns, low=1)))
        object.__setattr__(self, "pixel_size", real_number("pixel_size", self.pixel_size, above=0))

    @property
    def points(self) -> np.ndarray:
        """Middles of the pixels, (y x, 2) metres, row by row."""
        index = np.indices(self.shape).reshape(2, -1).T
        return (index - (np.array(self.shape) - 1) / 2) * self.pixel_size


@dataclass(frozen=True)
class Transmission:
    r"""The linear map from fields at the sample plane to fields at the camera.

    .. math:: A = H_c\, M_c\, e^{iK} M_d^\dagger\, H_d

    free space over ``distance`` from the sample to the distal facet, overlap with the modes there, the coupled cores,
    the modes at the proximal facet, and free space over ``defocus`` to the plane that the camera sees. Fields are in
    square roots of W/m^2 and powers are conserved but for light that no mode takes. H and V share all but the cores.
    The frames are periodic for free space: leave a dark margin of the width by which light spreads. A mode ends at
    three radii, where its field has fallen to 1e-4.

    bundle: the cores. sample, camera: the frames. distance, defocus: metres.

    >>> from fibre import Bundle, Frame, Transmission
    >>> bundle = Bundle.hexagonal(radius=15e-6, rng=0)
    >>> frame = Frame((64, 64), 0.8e-6)
    >>> A = Transmission(bundle, frame, frame, distance=10e-6)
    >>> x, y = (np.random.default_rng(s).normal(size=(2, 64, 64)) for s in (0, 1))
    >>> bool(np.isclose(np.vdot(y, A.propagate(x)), np.vdot(A.adjoint(y), x)))
    True
    """

    bundle: Bundle
    sample: Frame
    camera: Frame
    distance: float = 0.0
    defocus: float = 0.0

    def __post_init__(self) -> None:
        for name in ("sample", "camera"):
            one_of_types(name, getattr(self, name), (Frame,), "pass Frame(shape, pixel_size).")
        for name in ("distance", "defocus"):
            real_number(name, getattr(self, name))

    def propagate(self, fields: Any) -> np.ndarray:
        """Fields at the camera, complex (*B, 2, y, x), from fields at the sample plane, (*B, 2, y, x).

        complex64 in, complex64 out (the cores between are always double); anything else is complex128.
        """
        fields = complex_array("fields", fields, trailing=(2, *self.sample.shape))
        sample, camera, kind = self.sample, self.camera, fields.dtype
        facet = _filtered(fields, self._transfer(sample, self.distance, kind))
        launched = self._distal(kind).overlap(facet.reshape(-1, *sample.shape)) * sample.pixel_size
        received = self.bundle.transmit(launched.reshape(*fields.shape[:-2], self.bundle.cores))
        seen = self._proximal(kind).field(received.reshape(-1, self.bundle.cores)) / camera.pixel_size
        return _filtered(seen.reshape(*fields.shape[:-2], *camera.shape), self._transfer(camera, self.defocus, kind))

    def adjoint(self, fields: Any) -> np.ndarray:
        r"""The adjoint of :meth:`propagate`, :math:`\langle A x, y \rangle = \langle x, A^\dagger y \rangle` as sums
        over samples: (*B, 2, y, x) at the camera to (*B, 2, y, x) at the sample plane."""
        fields = complex_array("fields", fields, trailing=(2, *self.camera.shape))
        sample, camera, kind = self.sample, self.camera, fields.dtype
        facet = _filtered(fields, np.conj(self._transfer(camera, self.defocus, kind)))
        received = self._proximal(kind).overlap(facet.reshape(-1, *camera.shape)) / camera.pixel_size
        launched = self.bundle.transmit_adjoint(received.reshape(*fields.shape[:-2], self.bundle.cores))
        back = self._distal(kind).field(launched.reshape(-1, self.bundle.cores)) * sample.pixel_size
        return _filtered(
            back.reshape(*fields.shape[:-2], *sample.shape), np.conj(self._transfer(sample, self.distance, kind))
        )

    def matrix(self, window: Any) -> scipy.sparse.csc_array:
        r"""The columns of A that belong to a window of the sample plane, sparse complex (2 y x of the camera, 2 w).

        ``window``: boolean (y, x) on the sample frame, True for the w pixels wanted. Rows and columns are ordered H of
        all pixels, then V, row by row. Free space here is the modes' own: the radial field of a Gaussian after
        ``distance``, by its Hankel transform, so nothing wraps around. Entries below 1e-6 of the largest are left out.
        A camera out of focus has no sparse columns: ``defocus`` must be 0.

        Raises
        ------
        ValueError: a window of another shape or without pixels; a defocused camera.
        """
        window = np.asarray(window)
        if window.dtype != bool or window.shape != self.sample.shape or not window.any():
            raise ValueError(
                f"window must be boolean of shape {self.sample.shape} with at least one True, got {window.dtype} of "
                f"shape {window.shape}."
            )
        if self.defocus != 0:
            raise ValueError(f"defocus must be 0 for a sparse matrix, got {self.defocus:g} m; use propagate.")
        launch = self._launched(self.sample.points[window.ravel()])
        # fewer cores than pixels are near the window
        cores = np.flatnonzero(np.diff(launch.tocsr().indptr))
        both = np.concatenate([cores, cores + self.bundle.cores])
        each = scipy.sparse.eye_array(2 * self.bundle.cores, format="csc")[:, both]
        received = self.bundle.columns(each, FAINT) @ scipy.sparse.block_diag([launch.tocsr()[cores]] * 2, format="csc")
        modes = self._proximal(np.dtype(complex)).modes / self.camera.pixel_size
        return _thin(scipy.sparse.block_diag([modes, modes], format="csr") @ received, FAINT)

    def function(self) -> Callable[[jax.Array], jax.Array]:
        """:meth:`propagate` as a pure JAX function of complex fields (2, y, x): differentiable, for ``vmap`` and a GPU.

        Compiled for the precision that it is given. It is a ``jax.tree_util.Partial`` with the geometry's arrays as
        leaves: inside a function of your own under ``jit`` pass it as an argument, or they become constants of the
        program.
        """
        double = np.dtype(complex)
        distal, proximal = self._distal(double), self._proximal(double)
        indices, values = self.bundle.evolution.rows
        known = {
            "overlap": _Entries.of(distal.transposed),
            "field": _Entries.of(proximal.modes),
            "indices": indices,
            "values": values,
            "there": self._transfer(self.sample, self.distance, double),
            "seen": self._transfer(self.camera, self.defocus, double),
        }
        scale, cores, pixels = self.sample.pixel_size / self.camera.pixel_size, self.bundle.cores, self.camera.shape
        evolution = self.bundle.evolution

        @jax.jit
        def propagate(known: dict[str, Any], fields: jax.Array) -> jax.Array:
            fields = fields.astype(jnp.result_type(fields, jnp.complex64))
            facet = _filtered_jax(fields, known["there"]).reshape(2, -1).T
            launched = known["overlap"].product(facet, cores).T.reshape(2 * cores, 1)
            received = evolution.apply_jax(launched, 1, (known["indices"], known["values"]))
            seen = known["field"].product(received.reshape(2, cores).T, pixels[0] * pixels[1]) * scale
            return _filtered_jax(seen.T.reshape(2, *pixels), known["seen"])

        return jax.tree_util.Partial(propagate, jax.tree.map(jnp.asarray, known))

    def _distal(self, kind: np.dtype) -> _Modes:
        return self._known("distal", self.bundle.distal_centres, self.sample, kind)

    def _proximal(self, kind: np.dtype) -> _Modes:
        bundle = self.bundle
        same = self.sample == self.camera and np.array_equal(bundle.distal_centres, bundle.centres)
        return self._distal(kind) if same else self._known("proximal", bundle.centres, self.camera, kind)

    def _known(self, facet: str, centres: np.ndarray, frame: Frame, kind: np.dtype) -> _Modes:
        if (facet, kind) not in self._kept:
            modes = mode_matrix(Fibrelets(centres, self.bundle.mode_radius), frame.shape, frame.pixel_size)
            modes = scipy.sparse.csr_array(modes).astype(np.finfo(kind).dtype)
            self._kept[facet, kind] = _Modes(modes, modes.T.tocsr())
        return self._kept[facet, kind]

    @cached_property
    def _kept(self) -> dict[Any, Any]:
        """What was made for the precisions that were asked for."""
        return {}

    def _transfer(self, frame: Frame, distance: float, kind: np.dtype) -> np.ndarray:
        """Transfer function of free space; a scalar 1 for none."""
        if distance == 0:
            return np.ones((), kind)
        key = (frame, distance, kind)
        if key not in self._kept:
            whole = transfer_function(frame.shape, distance, self.bundle.wavelength, frame.pixel_size)
            self._kept[key] = whole.astype(kind)
        return self._kept[key]

    def _launched(self, points: np.ndarray) -> scipy.sparse.csc_array:
        """Amplitudes (m, w) that unit fields in single pixels at ``points`` (w, 2) launch at the facet."""
        bundle, wavelength = self.bundle, self.bundle.wavelength
        # of a Gaussian, beyond exp(-9) in the field on both sides of the transform
        narrow, wide = float(bundle.mode_radius.min()), float(bundle.mode_radius.max())
        reach = 3 * wide * float(np.hypot(1, wavelength * self.distance / np.pi / narrow**2))
        tree = scipy.spatial.cKDTree(points)
        near = tree.query_ball_point(bundle.distal_centres, reach)
        cores = np.flatnonzero([len(n) for n in near])
        if len(cores) == 0:
            return scipy.sparse.csc_array((bundle.cores, len(points)), dtype=complex)
        radius = np.linspace(0, reach, 4 * int(np.ceil(reach / min(narrow, wavelength))) + 16)
        frequency = np.linspace(0, 3 / np.pi / narrow, 16 * len(radius))
        squared = 1 / wavelength**2 - frequency**2
        turn = np.exp(2j * np.pi * self.distance * (np.sqrt(np.maximum(squared, 0)) - 1 / wavelength)) * (squared > 0)
        kernel = scipy.special.j0(2 * np.pi * radius[:, None] * frequency) * frequency * turn
        width = bundle.mode_radius[cores]
        spectra = np.sqrt(2 * np.pi) * width * np.exp(-((np.pi * frequency[:, None] * width) ** 2))
        profiles = scipy.interpolate.CubicSpline(radius, 2 * np.pi * (frequency[1] - frequency[0]) * (kernel @ spectra))
        rows, columns, values = [], [], []
        for k, core in enumerate(cores):
            place = np.asarray(near[core], int)
            away = np.hypot(*(points[place] - bundle.distal_centres[core]).T)
            rows.append(np.full(len(place), core))
            columns.append(place)
            values.append(scipy.interpolate.PPoly(profiles.c[..., k], radius)(away) * self.sample.pixel_size**2)
        places = (np.concatenate(rows), np.concatenate(columns))
        return scipy.sparse.csc_array((np.concatenate(values), places), shape=(bundle.cores, len(points)))


@dataclass(frozen=True)
class _Modes:
    """Modes as columns of unit sum of squares, sparse real (y x, m), and their transpose, both by rows."""

    modes: scipy.sparse.csr_array
    transposed: scipy.sparse.csr_array

    def overlap(self, fields: np.ndarray) -> np.ndarray:
        """Of complex fields (b, y, x) with every mode: (b, m)."""
        return _product(self.transposed, fields.reshape(len(fields), -1))

    def field(self, amplitudes: np.ndarray) -> np.ndarray:
        """Of amplitudes (b, m): (b, y x)."""
        return _product(self.modes, amplitudes)


class _Entries(NamedTuple):
    """A real sparse matrix for JAX, by rows: value, row and column of each entry."""

    values: Any
    rows: Any
    columns: Any

    @classmethod
    def of(cls, matrix: scipy.sparse.csr_array) -> _Entries:
        rows = np.repeat(np.arange(matrix.shape[0], dtype=np.int32), np.diff(matrix.indptr))
        return cls(matrix.data, rows, matrix.indices.astype(np.int32))

    def product(self, columns: jax.Array, count: int) -> jax.Array:
        """Times complex ``columns`` (k, b): (count, b)."""
        taken = columns.at[self.columns].get(mode="promise_in_bounds")
        weighted = self.values.astype(jnp.finfo(columns.dtype).dtype)[:, None] * taken
        return jax.ops.segment_sum(weighted, self.rows, count, indices_are_sorted=True, mode="promise_in_bounds")


def _filtered_jax(fields: jax.Array, transfer: jax.Array) -> jax.Array:
    if transfer.ndim == 0:
        return fields
    return jnp.fft.ifft2(jnp.fft.fft2(fields) * transfer.astype(fields.dtype))


def _product(matrix: scipy.sparse.csr_array, rows: np.ndarray) -> np.ndarray:
    """A real matrix times the complex ``rows`` (b, k), as real numbers side by side: (b, l)."""
    columns = np.ascontiguousarray(rows.T).astype(np.result_type(matrix.dtype, np.complex64), copy=False)
    parts = matrix @ columns.view(matrix.dtype)
    return np.ascontiguousarray(parts).view(columns.dtype).T


def _filtered(fields: np.ndarray, transfer: np.ndarray) -> np.ndarray:
    """Fields (..., y, x) after free space; as they are for none."""
    if transfer.ndim == 0:
        return fields
    spectrum = scipy.fft.fft2(fields, workers=-1)
    spectrum *= transfer
    return np.asarray(scipy.fft.ifft2(spectrum, workers=-1, overwrite_x=True))


def _thin(matrix: Any, faint: float) -> scipy.sparse.csc_array:
    """Without the entries below ``faint`` of the largest."""
    matrix = scipy.sparse.csc_array(matrix)
    if matrix.nnz:
        matrix.data[np.abs(matrix.data) < faint * np.abs(matrix.data).max()] = 0
        matrix.eliminate_zeros()
    return matrix
