"""What the simulated bench contains. Every effect is absent unless it is declared here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acquisition.bench.modulators import ModulatorModel
from fibre import Bundle
from polinfer.checks import integer, one_of_types, real_array, real_number
from polinfer.phantoms import Phantom

__all__ = ["CameraModel", "Scene"]


@dataclass(frozen=True)
class CameraModel:
    """A camera. shape: (y, x) pixels. pixel_size: metres at the facet. gain: photo-electrons per count. read_noise:
    photo-electrons. bits: of the converter; counts saturate at 2^bits - 1 and are rounded. shot_noise: False for an
    ideal camera. quantum_efficiency: photo-electrons per photon, in (0, 1]."""

    shape: tuple[int, int] = (200, 200)
    pixel_size: float = 0.72e-6
    gain: float = 40.0
    read_noise: float = 5.0
    bits: int = 8
    shot_noise: bool = True
    quantum_efficiency: float = 1.0

    def __post_init__(self) -> None:
        integer("bits", self.bits, low=1, high=16)
        real_number("gain", self.gain, above=0)
        real_number("read_noise", self.read_noise, low=0)
        real_number("pixel_size", self.pixel_size, above=0)
        real_number("quantum_efficiency", self.quantum_efficiency, above=0, high=1)

    @property
    def full_scale(self) -> int:
        """The count at saturation."""
        return 2**self.bits - 1


@dataclass(frozen=True)
class Scene:
    """A bundle, a sample behind it, the light, and a camera.

    bundle, camera: as they are. phantom: the sample, on the plan's grid of distal points; pitch: metres between them.
    spot_power: photons per second that one spot puts on the camera. spot_waist: metres, 1/e field radius of a
    calibration spot. illumination: amplitude of the broad beam at its centre, as the amplitude of the calibration
    spots that would make the same field; illumination_waist: its 1/e field radius, metres. reference: (row, column)
    metres of the reference spot; reference_amplitude relative to a calibration spot.

    Mismatch between bench and recovery, absent by default: focus_error, relative error of every defocus distance;
    focus_offset, metres; step_error, radians (standard deviation of the phase steps); oversampling, samples of the
    camera field per pixel and axis; sample_oversampling, points of the sample per distal point and axis (1: the
    sample's field lies in the span of the calibration).

    Drift, absent by default: piston_walk, rad/sqrt(s), and tilt_walk, rad/m/sqrt(s) for each axis, of random walks of
    the phase at the camera and of its slope over the facet, held still during a capture; image_time, seconds of an
    image beyond its exposures (the paper's 8.3 s a capture: 0.75), in which the fibre walks.

    The instrument's own, absent by default: misalignment, (radians, radians a metre along rows, along columns), the
    phase of the second arm over the first at a distal point, which the calibration meets too, so that
    :math:`T^{-1} J T` is measured; hologram and lens, the :class:`ModulatorModel` before the sample, for the spots of a
    calibration (the broad beam is taken as it is), and of the one before the camera, for lenses and phase steps. Both
    have ``image_time`` to settle before an image.

    TypeError, ValueError for wrong kinds, numbers out of range, and a phantom with a tilt of its own: here that is
    ``misalignment``.
    """

    bundle: Bundle
    phantom: Phantom
    camera: CameraModel = CameraModel()
    pitch: float = 4.2e-6
    spot_power: float = 2e8
    spot_waist: float = 2.5e-6
    illumination: float = 0.2
    illumination_waist: float = 60e-6
    reference: tuple[float, float] = (0.0, 49e-6)
    reference_amplitude: float = 1.0
    focus_error: float = 0.0
    focus_offset: float = 0.0
    step_error: float = 0.0
    oversampling: int = 1
    sample_oversampling: int = 1
    piston_walk: float = 0.0
    tilt_walk: float = 0.0
    image_time: float = 0.0
    misalignment: tuple[float, float, float] = (0.0, 0.0, 0.0)
    hologram: ModulatorModel | None = None
    lens: ModulatorModel | None = None

    def __post_init__(self) -> None:
        one_of_types("bundle", self.bundle, (Bundle,), "for instance Bundle.hexagonal().")
        one_of_types("phantom", self.phantom, (Phantom,), "for instance phantoms.lesion((18, 18)).")
        for name in ("pitch", "spot_power", "spot_waist", "illumination_waist"):
            real_number(name, getattr(self, name), above=0)
        for name in ("illumination", "reference_amplitude", "step_error", "piston_walk", "tilt_walk", "image_time"):
            real_number(name, getattr(self, name), low=0)
        for name in ("hologram", "lens"):
            if getattr(self, name) is not None:
                one_of_types(name, getattr(self, name), (ModulatorModel,), "pass ModulatorModel(levels=256) or None.")
                if getattr(self, name).settling > 0 and not self.image_time > 0:
                    raise ValueError(f"{name} settles, but image_time is 0: it would never show anything new; set "
                                     "image_time to the seconds it is given.")  # fmt: skip
        real_array("misalignment", self.misalignment, shape=(3,), finite=True)
        if self.phantom.tilt is not None:
            raise ValueError("phantom has a tilt of its own; leave it out and declare the scene's misalignment.")
        if np.ndim(self.phantom.parameters.retardance) != 2:
            raise ValueError("phantom must be a frame (y, x); give its parameters two axes.")
        integer("oversampling", self.oversampling, low=1)
        integer("sample_oversampling", self.sample_oversampling, low=1)

    def between_arms(self, points: np.ndarray) -> np.ndarray:
        """Phase of the second arm over the first at distal points (p, 2), radians (p,)."""
        piston, *slopes = self.misalignment
        return np.asarray(piston + points @ np.array(slopes))
