"""What cameras, modulators, instruments and benches must be able to do, whether real or simulated.

In: nothing. Out: the classes that drivers and twins derive from, and the protocol that plans are executed against. One
suite of tests runs on every implementation.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np

from acquisition.errors import AcquisitionError, SettingError
from acquisition.exposure import Bracket, MergeRule
from acquisition.plan import Step, Views
from acquisition.settings import Setting, Written

__all__ = [
    "AnyBench",
    "Camera",
    "Device",
    "Frame",
    "Instrument",
    "PhaseModulator",
    "Shown",
    "bracketed",
    "leave_safely",
]


def leave_safely(make_safe: Callable[[], None], error: BaseException | None) -> None:
    """Make safe on the way out: its failure is raised, but never in place of ``error``, which takes it as a note."""
    try:
        make_safe()
    except AcquisitionError as failed:
        if error is None:
            raise
        error.add_note(f"and it could not be made safe: {failed}")


class Device(ABC):
    """A device that is opened by its serial number and left in a safe state, whatever happens.

    A context manager: leaving it makes the device safe and closes it; an error on the way out never hides the first.
    """

    @property
    @abstractmethod
    def serial(self) -> str:
        """The serial number that it was opened by."""

    @property
    @abstractmethod
    def settings(self) -> Mapping[str, Setting]:
        """What can be set, with the limits that the device states now."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Make, model, serial number and firmware, as JSON: what must not change within a run."""

    @abstractmethod
    def close(self) -> None:
        """Give the device back. Closing twice does nothing."""

    @abstractmethod
    def _read(self, setting: Setting) -> Any: ...

    @abstractmethod
    def _write(self, setting: Setting, value: Any) -> None: ...

    def setting(self, name: str) -> Setting:
        """The declaration; SettingError for a name that the device does not have."""
        known = self.settings
        if name not in known:
            raise SettingError(f"name must be one of {', '.join(sorted(known))}, got {name!r}.")
        return known[name]

    def get(self, name: str) -> Any:
        """The value that the device states now."""
        setting = self.setting(name)
        if setting.access == "wo":
            raise SettingError(f"{name} can only be written.")
        return self._read(setting)

    def set(self, name: str, value: Any = None) -> Written:
        """Write and read back. SettingError for a value out of the range that the device states."""
        setting = self.setting(name)
        checked = setting.checked(value)
        self._write(setting, checked)
        actual = checked if setting.access == "wo" or setting.kind == "action" else self._read(setting)
        return Written(checked, actual)

    def make_safe(self) -> None:
        """Set everything that has a safe value to it, all of it even if one fails; then the first failure is raised."""
        first: AcquisitionError | None = None
        for setting in self.settings.values():
            if setting.safe is not None:
                try:
                    self.set(setting.name, setting.safe)
                except AcquisitionError as error:
                    first = first or error
        if first is not None:
            raise first

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        try:
            leave_safely(self.make_safe, error)
        finally:
            self.close()


@dataclass(frozen=True)
class Frame:
    """One exposure. counts: unsigned integers (y, x). block: the device's number of it, rising. time: seconds of the
    device's clock when it began. exposure: seconds, as the device says it was."""

    counts: np.ndarray
    block: int
    time: float
    exposure: float


class Camera(Device):
    """A camera with linear counts. Its settings hold "exposure", seconds."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """(y, x) pixels of a frame."""

    @property
    @abstractmethod
    def full_scale(self) -> int:
        """The count at which a pixel saturates."""

    @abstractmethod
    def snap(self, exposure: float) -> Frame:
        """A frame of this exposure (seconds) that began after the call; never an older one.

        Raises SettingError for an exposure out of range, FrameLost, DeviceTimeout and DeviceLost.
        """


@dataclass(frozen=True)
class Shown:
    """A pattern that is on: hash of the pixel levels, seconds that were waited for the device to settle."""

    digest: str
    settled: float


class PhaseModulator(Device):
    """A screen of phases."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """(y, x) pixels, all of which every pattern must have: nothing is scaled."""

    @property
    @abstractmethod
    def levels(self) -> int:
        """Number of phases from 0 to just below 2 pi."""

    @abstractmethod
    def show(self, phase: np.ndarray) -> Shown:
        """Show a phase, radians real (y, x), and return when it has settled.

        Raises SettingError for another shape or values that are not finite.
        """

    def quantised(self, phase: Any) -> np.ndarray:
        """Levels (y, x), integers, of a phase in radians: the nearest of ``levels`` steps round the circle."""
        phase = np.asarray(phase)
        if phase.shape != self.shape or phase.dtype.kind not in "fiu":
            raise SettingError(
                f"phase must be real with the modulator's shape {self.shape}, got {phase.dtype} {phase.shape}; "
                "nothing is scaled."
            )
        if not np.all(np.isfinite(phase)):
            raise SettingError("phase must be finite.")
        steps = np.rint(phase.astype(float) * self.levels / (2 * np.pi)).astype(np.int64) % self.levels
        return steps.astype(np.uint8 if self.levels <= 256 else np.uint16)


class Instrument(Device):
    """A device that has only settings: a rotation mount, a liquid-crystal retarder, a power meter."""


@runtime_checkable
class AnyBench(Protocol):
    """A camera, the modulators in front of it, and a sample that can be put in or left out.

    wavelength, pixel_size (at the facet): metres. full_scale: count at saturation. merge_rule: how this camera's
    exposures are merged. registration: (2, 3) affine map from distal to camera coordinates.
    """

    wavelength: float
    pixel_size: float
    full_scale: int
    merge_rule: MergeRule
    registration: np.ndarray

    def describe(self) -> dict[str, Any]:
        """Everything that must not change within a run, as JSON: serial numbers, settings, frame size."""

    def prepare(self, step: Step, views: Views, illumination: np.ndarray, points: np.ndarray | None) -> None:
        """Show the step's pattern and place the sample; returns when both have settled."""

    def expose(self, view: int, exposure: float) -> Frame:
        """One raw frame of the given view of the prepared step, begun after the call; exposure in seconds."""

    def time(self) -> float:
        """Seconds on a monotonic clock."""

    def continue_from(self, seconds: float) -> None:
        """A run that is resumed was at this time when it was cut off: the clock goes on from there, not before it."""

    def make_safe(self) -> None:
        """Light to safe values. Called on every way out of a run; calling it twice does nothing more."""


def bracketed(bench: AnyBench, view: int, bracket: Bracket) -> list[Frame]:
    """Frames of a view of the step that ``bench`` was prepared for: from the longest exposure of the bracket to the
    first that does not saturate."""
    frames: list[Frame] = []
    for exposure in bracket.times():
        frames.append(bench.expose(view, exposure))
        if frames[-1].counts.max() < bench.full_scale:
            break
    return frames
