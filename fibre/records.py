"""The records of this package: what each verb takes and returns.

    Images -> Calibration | Recording -> (retrieve_fields) CalibrationFields | RecordingFields
           -> (recover) Inverse -> (reconstruct) polinfer.Measurement

All are frozen dataclasses of arrays in SI units; coordinates are (row, column) in metres from the middle of the frame.
Their array fields are declared for storage, so every one can be saved and loaded.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np
import scipy.sparse

from fibre.propagation import transfer_function
from polinfer.checks import complex_array, integer, one_of_types, real_array, real_number
from polinfer.storage import array, setting

__all__ = [
    "Calibration",
    "CalibrationFields",
    "Defocus",
    "Diversity",
    "Fibrelets",
    "Images",
    "Interference",
    "Inverse",
    "Recording",
    "RecordingFields",
    "RetrievalStatus",
    "Retrieved",
]


class RetrievalStatus(enum.IntFlag):
    """What to know about a retrieved field; flags add up."""

    OK = 0
    NOT_CONVERGED = 1  # still moving at the last iteration: allow more iterations, or more diverse planes
    MISFIT = 2  # the images differ from the field's by more than their noise: check distances, masks, saturation


@dataclass(frozen=True)
class Diversity:
    """Images of one field (or a batch) through known masks in the Fourier plane of the second modulator.

    Image i is the intensity ``|F^-1[masks_i F[field]]|^2`` in photo-electrons per second.

    Parameters
    ----------
    intensities: real (*B, m, y, x), >= 0 up to noise. masks: complex (m, y, x) on the frequencies of ``fftfreq``,
    modulus at most 1. wavelength, pixel_size: metres. variance: real (*B, m, y, x) of the intensities, > 0, infinite
    where a pixel says nothing (saturated); None = unknown, all alike. distances: (m,) metres, where the masks are
    those of a defocus (:func:`Defocus`), for methods that ask; None = other masks.
    """

    intensities: np.ndarray = array(("*P", "image", "y", "x"), "photo-electrons/s")
    masks: np.ndarray = array(("image", "y", "x"), "1")
    wavelength: float = setting()
    pixel_size: float = setting()
    variance: np.ndarray | None = array(("*P", "image", "y", "x"), "(photo-electrons/s)^2", default=None)
    distances: np.ndarray | None = array(("image",), "m", default=None)

    def __post_init__(self) -> None:
        intensities = real_array("intensities", self.intensities, trailing=(None, None, None), finite=True)
        masks = complex_array("masks", self.masks, shape=intensities.shape[-3:], finite=True)
        object.__setattr__(self, "intensities", intensities)
        object.__setattr__(self, "masks", masks)
        real_number("wavelength", self.wavelength, above=0)
        real_number("pixel_size", self.pixel_size, above=0)
        if self.variance is not None:
            variance = real_array("variance", self.variance, above=0)
            if variance.shape != intensities.shape:
                raise ValueError(
                    f"variance must have the shape of intensities {intensities.shape}, got {variance.shape}."
                )
            object.__setattr__(self, "variance", variance)
        if self.distances is not None:
            distances = real_array("distances", self.distances, shape=(len(masks),), finite=True)
            object.__setattr__(self, "distances", distances)

    @cached_property
    def single_masks(self) -> jax.Array:
        """``masks`` in single precision where JAX computes, made once: a run asks for them again and again."""
        return jax.device_put(self.masks.astype(np.complex64))


def Defocus(
    intensities: Any,
    distances: Any,
    wavelength: float,
    pixel_size: float,
    variance: Any = None,
    numerical_aperture: float | None = None,
) -> Diversity:
    r"""Diversity by defocus: image i (real (*B, m, y, x)) was taken ``distances[i]`` metres along the beam.

    ``numerical_aperture``: of the microscope that sees the field, at the field's side. Its pupil passes
    :math:`|f| \le \mathrm{NA}/\lambda` only, so that all beyond is noise, and is not retrieved; None: as far as the
    pixels reach.

    >>> Defocus(np.ones((3, 8, 8)), [-1e-5, 0, 1e-5], wavelength=850e-9, pixel_size=1e-6).masks.shape
    (3, 8, 8)
    """
    intensities = real_array("intensities", intensities, trailing=(None, None, None), finite=True)
    distances = real_array("distances", distances, shape=(intensities.shape[-3],), finite=True)
    shape = intensities.shape[-2:]
    masks = transfer_function(shape, distances, wavelength, pixel_size)
    if numerical_aperture is not None:
        highest = real_number("numerical_aperture", numerical_aperture, above=0) / wavelength
        fy, fx = (np.fft.fftfreq(n, pixel_size) for n in shape)
        masks = np.where(fy[:, None] ** 2 + fx**2 <= highest**2, masks, 0)
    return Diversity(intensities, masks, wavelength, pixel_size, variance, distances)


@dataclass(frozen=True)
class Retrieved:
    """A field from its intensities, up to a common phase.

    field: complex (*B, y, x), square root of the intensity unit. variance: real (*B, y, x), E|error|^2 of the complex
    field from the noise of the images alone. status: :class:`RetrievalStatus` (*B). iterations: (*B).
    """

    field: np.ndarray = array(("*P", "y", "x"), "sqrt(photo-electrons/s)")
    variance: np.ndarray = array(("*P", "y", "x"), "photo-electrons/s")
    status: np.ndarray = array(("*P",), "1")
    iterations: np.ndarray = array(("*P",), "1")


@dataclass(frozen=True)
class Interference:
    """The interference of the two polarisations, from phase-stepped images.

    product: complex (*B, y, x), conj(H) V. variance: real (*B, y, x), E|error|^2 of the product; infinite where fewer
    than three usable steps are left. mean: real (*B, y, x), (|H|^2 + |V|^2) / 2.
    """

    product: np.ndarray = array(("*P", "y", "x"), "photo-electrons/s")
    variance: np.ndarray = array(("*P", "y", "x"), "(photo-electrons/s)^2")
    mean: np.ndarray = array(("*P", "y", "x"), "photo-electrons/s")


@dataclass(frozen=True)
class Images:
    """A stack of merged images: for each capture the defocused views of H, then the phase-stepped interference.

    radiance, variance: real (capture, image, y, x), photo-electrons per second and its square; saturated: bool, the
    same shape. Any array that is indexed by capture will do (a memory map, a lazy stack). diversity: (m,) metres,
    defocus of the first m images. steps: (k,) radians, phase of V against H in the last k. times: (capture,)
    seconds since the start. wavelength, pixel_size (at the facet): metres.
    """

    radiance: Any = array(("capture", "image", "y", "x"), "photo-electrons/s")
    variance: Any = array(("capture", "image", "y", "x"), "(photo-electrons/s)^2")
    saturated: Any = array(("capture", "image", "y", "x"), "1")
    diversity: np.ndarray = array(("plane",), "m")
    steps: np.ndarray = array(("step",), "rad")
    times: np.ndarray = array(("capture",), "s")
    wavelength: float = setting()
    pixel_size: float = setting()

    def __post_init__(self) -> None:
        diversity = real_array("diversity", self.diversity, shape=(None,), finite=True)
        steps = real_array("steps", self.steps, shape=(None,), finite=True)
        times = real_array("times", self.times, shape=(None,), finite=True)
        expected = (len(times), len(diversity) + len(steps))
        for name in ("radiance", "variance", "saturated"):
            shape = tuple(getattr(getattr(self, name), "shape", ()))
            if len(shape) != 4 or shape[:2] != expected:
                raise ValueError(
                    f"{name} must have shape (capture, image, y, x) = ({expected[0]}, {expected[1]}, y, x) to go with "
                    f"times, diversity and steps, got {shape}."
                )
            if shape != tuple(self.radiance.shape):
                raise ValueError(f"{name} must have the shape of radiance {tuple(self.radiance.shape)}, got {shape}.")
        for name, value in (("diversity", diversity), ("steps", steps), ("times", times)):
            object.__setattr__(self, name, value)
        real_number("wavelength", self.wavelength, above=0)
        real_number("pixel_size", self.pixel_size, above=0)

    @property
    def captures(self) -> int:
        """Number of captures."""
        return len(self.times)

    @property
    def frame(self) -> tuple[int, int]:
        """(y, x) of one image."""
        y, x = self.radiance.shape[-2:]
        return int(y), int(x)


@dataclass(frozen=True)
class Calibration:
    """Known inputs to the fibre and the images that they made.

    images: one capture per input, each with the fixed reference spot beside. inputs: sparse complex (2 p, captures),
    amplitude of the spot at each distal point (rows: h of all p points, then v), columns are captures. points:
    (p, 2) metres at the distal facet; grid: their (rows, columns), row by row. references: captures of the reference
    spot alone. registration: (2, 3) affine map, camera = registration @ (row, column, 1) of the distal point.
    """

    images: Images = array((), "1")
    inputs: Any = array(("input", "capture"), "1")
    points: np.ndarray = array(("point", "row_column"), "m")
    grid: tuple[int, int] = setting()
    references: Images = array((), "1")
    registration: np.ndarray = array(("row_column", "affine"), "1")

    def __post_init__(self) -> None:
        one_of_types("images", self.images, (Images,), "pass the captured Images.")
        one_of_types("references", self.references, (Images,), "pass the captures of the reference spot alone.")
        points = real_array("points", self.points, shape=(None, 2), finite=True)
        rows, columns = (integer("grid", n, low=1) for n in self.grid)
        if rows * columns != len(points):
            raise ValueError(f"grid {self.grid} must hold all points, got {len(points)} points.")
        expected = (2 * len(points), self.images.captures)
        if not scipy.sparse.issparse(self.inputs) or self.inputs.shape != expected:
            came = getattr(self.inputs, "shape", type(self.inputs).__name__)
            raise ValueError(f"inputs must be a sparse matrix (2 p, captures) = {expected}, got {came}.")
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "grid", (rows, columns))
        object.__setattr__(self, "inputs", scipy.sparse.csr_array(self.inputs))
        object.__setattr__(
            self, "registration", real_array("registration", self.registration, shape=(2, 3), finite=True)
        )


@dataclass(frozen=True)
class Recording:
    """Images of a sample in n illumination states, of the same scene without the sample, and of the reference.

    images: n captures. illumination: complex (2, n), nominal states. blank: n captures without the sample, which fix
    the illumination at every point. references: captures of the reference spot alone.
    """

    images: Images = array((), "1")
    illumination: np.ndarray = array(("polarisation", "state"), "1")
    blank: Images = array((), "1")
    references: Images = array((), "1")

    def __post_init__(self) -> None:
        for name in ("images", "blank", "references"):
            one_of_types(name, getattr(self, name), (Images,), "pass the captured Images.")
        illumination = complex_array("illumination", self.illumination, shape=(2, None), finite=True)
        for name in ("images", "blank"):
            captures = getattr(self, name).captures
            if captures != illumination.shape[1]:
                raise ValueError(
                    f"{name} must have one capture per illumination state ({illumination.shape[1]}), got {captures}."
                )
        object.__setattr__(self, "illumination", illumination)


@dataclass(frozen=True)
class Fibrelets:
    """Where the fibrelets are in the camera image: the basis in which fields are kept.

    centres: (m, 2) metres from the middle of the frame. mode_radius: metres, 1/e radius of the field of each mode, (m,)
    or one number for all.
    """

    centres: np.ndarray = array(("fibrelet", "row_column"), "m")
    mode_radius: np.ndarray = array(("fibrelet",), "m")

    def __post_init__(self) -> None:
        centres = real_array("centres", self.centres, shape=(None, 2), finite=True)
        radius = real_array("mode_radius", self.mode_radius, above=0, finite=True)
        if radius.shape not in ((), (len(centres),)):
            raise ValueError(
                f"mode_radius must have shape () or ({len(centres)},) to go with centres, got {radius.shape}."
            )
        object.__setattr__(self, "centres", centres)
        object.__setattr__(self, "mode_radius", np.broadcast_to(radius, len(centres)).copy())

    @classmethod
    def pixels(cls, frame: tuple[int, int], pixel_size: float, rows: slice, columns: slice) -> Fibrelets:
        """The pixel basis of a window: a "fibrelet" for every pixel of ``frame[rows, columns]``.

        What the paper's recovery works in, and what is left where fibrelets cannot be told apart. Slices may have
        steps. A window of a few thousand pixels is meant: every one of them costs what a fibrelet costs.

        >>> Fibrelets.pixels((96, 96), 0.72e-6, slice(0, 2), slice(0, 4, 2)).centres.shape
        (4, 2)
        """
        places = [np.arange(n)[s] - (n - 1) / 2 for n, s in zip(frame, (rows, columns), strict=True)]
        centres = np.stack(np.meshgrid(*places, indexing="ij"), -1).reshape(-1, 2)
        if len(centres) == 0:
            raise ValueError(f"rows and columns must select pixels of the frame {frame}, got {rows} and {columns}.")
        # narrow enough to belong to its own pixel alone
        return cls(centres * real_number("pixel_size", pixel_size, above=0), np.array(0.3 * pixel_size))


@dataclass(frozen=True)
class CalibrationFields:
    """Mode amplitudes of every calibration capture, relative to the reference spot.

    fields: complex (captures, 2, m), phase relative to the reference spot; variance: real, the same shape, E|error|^2;
    both in the modes of ``fibrelets``. reference: complex (2, m), the reference spot alone. inflation (of H and V
    alike, or of each), relative_error, stray: what the closure of the illumination states found beyond the image noise
    (1, 0 and 0 = nothing; :class:`fibre.closure.NoiseScale`); ``variance`` contains them. inputs, points, grid,
    registration: as in :class:`Calibration`. status: :class:`RetrievalStatus` of every capture (captures,), None where
    no retrieval was made.
    """

    fields: np.ndarray = array(("capture", "polarisation", "fibrelet"), "sqrt(photo-electrons/s)")
    variance: np.ndarray = array(("capture", "polarisation", "fibrelet"), "photo-electrons/s")
    reference: np.ndarray = array(("polarisation", "fibrelet"), "sqrt(photo-electrons/s)")
    inflation: float | tuple[float, float] = setting()
    relative_error: float = setting()
    fibrelets: Fibrelets = array((), "1")
    inputs: Any = array(("input", "capture"), "1")
    points: np.ndarray = array(("point", "row_column"), "m")
    grid: tuple[int, int] = setting()
    registration: np.ndarray = array(("row_column", "affine"), "1")
    status: np.ndarray | None = array(("capture",), "1", default=None)
    stray: float = setting(default=0.0)

    def select(self, captures: Any) -> CalibrationFields:
        """Only some captures, indices (n,) or bool (captures,): a calibration with others missing, or known to be bad.

        A recovery needs every point lit in two states or more, and says which is not. Captures that fail to close are
        down-weighted by their variance already. ValueError: an index of no capture, or none selected.
        """
        count = len(self.fields)
        chosen = np.asarray(captures)
        if chosen.dtype == bool and chosen.shape == (count,):
            chosen = np.flatnonzero(chosen)
        if chosen.ndim != 1 or chosen.dtype.kind not in "ui" or not np.all((chosen >= 0) & (chosen < count)):
            raise ValueError(f"captures must be indices below {count} or bool ({count},), got {captures!r}.")
        if len(chosen) == 0 or len(np.unique(chosen)) < len(chosen):
            raise ValueError(f"captures must be some of the captures, each once, got {captures!r}.")
        return replace(
            self,
            fields=self.fields[chosen],
            variance=self.variance[chosen],
            inputs=scipy.sparse.csr_array(self.inputs)[:, chosen],
            status=None if self.status is None else self.status[chosen],
        )


@dataclass(frozen=True)
class RecordingFields:
    """Mode amplitudes of a recording: n states with the sample and n without, in the calibration's fibrelets.

    fields, blank: complex (n, 2, m), phase relative to the reference spot; variance, blank_variance: real,
    E|error|^2, ``inflation`` and ``relative_error`` contained. illumination: complex (2, n), nominal. status,
    blank_status: :class:`RetrievalStatus` (n,), or None.
    """

    fields: np.ndarray = array(("state", "polarisation", "fibrelet"), "sqrt(photo-electrons/s)")
    variance: np.ndarray = array(("state", "polarisation", "fibrelet"), "photo-electrons/s")
    blank: np.ndarray = array(("state", "polarisation", "fibrelet"), "sqrt(photo-electrons/s)")
    blank_variance: np.ndarray = array(("state", "polarisation", "fibrelet"), "photo-electrons/s")
    inflation: float | tuple[float, float] = setting()
    relative_error: float = setting()
    fibrelets: Fibrelets = array((), "1")
    illumination: np.ndarray = array(("polarisation", "state"), "1")
    status: np.ndarray | None = array(("state",), "1", default=None)
    blank_status: np.ndarray | None = array(("state",), "1", default=None)


@dataclass(frozen=True)
class Inverse:
    """The inverse transmission matrix A^-1, with the calibration that it was made from.

    matrix: sparse complex (2 p, 2 m): field at the distal points (h of all p, then v) from mode amplitudes (h of all
    m, then v). ridge: the regularisation used, in units of the mean power of a fibrelet in the columns of A.
    calibration: the fields, which say how well A is known.
    """

    matrix: Any = array(("output", "mode"), "1/sqrt(photo-electrons/s)")
    ridge: float = setting()
    calibration: CalibrationFields = array((), "1")
