"""A bench of devices: what a plan asks for, shown on modulators and seen by a camera.

In: devices, and what to show for a step and a view. Out: frames, behind the contract that the simulated bench has too.
Called by ``calibrate`` and ``capture``.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from acquisition.contracts import Camera, Device, Frame, PhaseModulator, leave_safely
from acquisition.errors import AcquisitionError, SettingError
from acquisition.exposure import MergeRule
from acquisition.plan import Step, Views
from polinfer.checks import one_of_types, real_array, real_number

__all__ = ["Bench"]

Illuminate = Callable[[Step, np.ndarray, np.ndarray | None], np.ndarray]
Analyse = Callable[[int, Views], np.ndarray]


class Bench:
    """A camera, an illuminating modulator and an analysing one, and whatever else must be set.

    Parameters
    ----------
    camera: where the frames come from. modulators: {"illumination": ..., "analysis": ...}, the first before the
    fibre, the second before the camera; either may be absent where nothing has to be shown on it. illuminate: the
    phase of the first, radians (y, x), from a step, the states (2, n) and the distal points (p, 2) or None. analyse:
    the phase of the second from the number of a view and the views: lenses of the defocused images, then the steps
    between the polarisations. ``fibre.holograms`` has the parts of both. wavelength, pixel_size (at the facet):
    metres. merge_rule: with the camera's gain and read noise (:func:`acquisition.photon_transfer`). registration: (2,
    3) affine map from distal to camera coordinates. place: called with the kind of a step before it, to bring the
    sample in or out; None: nothing has to be moved. others: devices that belong to the run and are made safe with it.

    A context manager: all devices are made safe and closed at its end.
    """

    def __init__(
        self,
        camera: Camera,
        modulators: Mapping[str, PhaseModulator],
        illuminate: Illuminate | None = None,
        analyse: Analyse | None = None,
        *,
        wavelength: float,
        pixel_size: float,
        merge_rule: MergeRule,
        registration: Any = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
        place: Callable[[str], None] | None = None,
        others: tuple[Device, ...] = (),
    ) -> None:
        one_of_types("camera", camera, (Camera,), "open one, for instance Usb3VisionCamera.open(serial).")
        one_of_types("merge_rule", merge_rule, (MergeRule,), "pass InverseVariance(...) or LongestUnsaturated(...).")
        shown = {"illumination": illuminate, "analysis": analyse}
        for name, modulator in modulators.items():
            if name not in shown:
                raise ValueError(f"modulators must be named illumination and analysis, got {name!r}.")
            one_of_types(name, modulator, (PhaseModulator,), "pass an open modulator.")
            if shown[name] is None:
                raise ValueError(f"modulators has {name!r}, but there is no function that says what to show on it.")
        for other in others:
            one_of_types("others", other, (Device,), "pass open devices.")
        self.camera, self.modulators, self.others = camera, dict(modulators), tuple(others)
        self._illuminate, self._analyse, self._place = illuminate, analyse, place
        self.wavelength = real_number("wavelength", wavelength, above=0)
        self.pixel_size = real_number("pixel_size", pixel_size, above=0)
        self.merge_rule = merge_rule
        self.registration = real_array("registration", registration, shape=(2, 3), finite=True)
        self.full_scale = camera.full_scale
        self._start = time.monotonic()
        self._view: int | None = None
        self._views: Views | None = None

    @property
    def devices(self) -> tuple[Device, ...]:
        """All of them, what brings light first: it is made safe first."""
        return (*self.modulators.values(), *self.others, self.camera)

    def describe(self) -> dict[str, Any]:
        """See :class:`acquisition.contracts.AnyBench`."""
        described = {
            "bench": "devices",
            "camera": self.camera.describe(),
            "modulators": {name: m.describe() for name, m in self.modulators.items()},
            "others": [device.describe() for device in self.others],
            "wavelength": self.wavelength,
            "pixel_size": self.pixel_size,
            "merge_rule": repr(self.merge_rule),
            "registration": self.registration.tolist(),
        }
        return json.loads(json.dumps(described))

    def prepare(self, step: Step, views: Views, illumination: np.ndarray, points: np.ndarray | None) -> None:
        """See :class:`acquisition.contracts.AnyBench`."""
        if self._place is not None:
            self._place(step.kind)
        if "illumination" in self.modulators:
            assert self._illuminate is not None
            self.modulators["illumination"].show(self._illuminate(step, illumination, points))
        self._view, self._views = None, views

    def expose(self, view: int, exposure: float) -> Frame:
        """See :class:`acquisition.contracts.AnyBench`."""
        if self._views is None:
            raise SettingError("prepare a step before exposing.")
        if view != self._view and "analysis" in self.modulators:
            assert self._analyse is not None
            self.modulators["analysis"].show(self._analyse(view, self._views))
        self._view = view
        return self.camera.snap(exposure)

    def time(self) -> float:
        """See :class:`acquisition.contracts.AnyBench`."""
        return time.monotonic() - self._start

    def continue_from(self, seconds: float) -> None:
        """See :class:`acquisition.contracts.AnyBench`."""
        self._start = min(self._start, time.monotonic() - seconds)

    def make_safe(self) -> None:
        """See :class:`acquisition.contracts.AnyBench`: every device, even if one fails; then the first failure."""
        first: AcquisitionError | None = None
        for device in self.devices:
            try:
                device.make_safe()
            except AcquisitionError as error:
                first = first or error
        if first is not None:
            raise first

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        try:
            leave_safely(self.make_safe, error)
        finally:
            for device in self.devices:
                device.close()
