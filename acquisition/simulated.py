"""Devices without a transport: the contracts alone, for a bench in software and for tests of what is above them.

In: a scene, or declarations. Out: a camera, a modulator, an instrument. Called by users and the simulated bench.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from acquisition.contracts import Camera, Frame, Instrument, PhaseModulator, Shown
from acquisition.errors import DeviceLost, SettingError
from acquisition.settings import Setting
from acquisition.twins.camera import Scene, gradient
from polinfer.checks import integer, real_number

__all__ = ["SimulatedCamera", "SimulatedInstrument", "SimulatedModulator"]


class _Open:
    """What is closed does not answer."""

    _closed = False

    def _check(self) -> None:
        if self._closed:
            raise DeviceLost("this device has been closed; open another.")

    def close(self) -> None:
        """See :class:`acquisition.contracts.Device`."""
        self._closed = True


class SimulatedCamera(_Open, Camera):
    """A camera that looks at ``scene``: counts (y, x) from exposure (seconds) and frame number.

    shape: (y, x). bits: 8 to 16. Exposures are whole microseconds, as on most cameras.

    >>> with SimulatedCamera(shape=(2, 3)) as camera:
    ...     camera.snap(0.01).counts.shape
    (2, 3)
    """

    def __init__(
        self, serial: str = "SIM-CAMERA", shape: tuple[int, int] = (48, 64), bits: int = 8, scene: Scene | None = None
    ) -> None:
        self._serial, self._shape = serial, (integer("shape", shape[0], low=1), integer("shape", shape[1], low=1))
        self._bits = integer("bits", bits, low=8, high=16)
        self.scene = scene or gradient(self._shape, self.full_scale)
        self._exposure, self._block, self._clock = 10_000, 0, 0.0

    @property
    def serial(self) -> str:
        """See :class:`acquisition.contracts.Device`."""
        return self._serial

    @property
    def shape(self) -> tuple[int, int]:
        """See :class:`acquisition.contracts.Camera`."""
        return self._shape

    @property
    def full_scale(self) -> int:
        """See :class:`acquisition.contracts.Camera`."""
        return 2**self._bits - 1

    @property
    def settings(self) -> Mapping[str, Setting]:
        """See :class:`acquisition.contracts.Device`."""
        return {"exposure": Setting("exposure", "number", "s", 10e-6, 10.0)}

    def describe(self) -> dict[str, Any]:
        """See :class:`acquisition.contracts.Device`."""
        return {"device": "simulated camera", "serial": self._serial, "shape": list(self._shape), "bits": self._bits}

    def _read(self, setting: Setting) -> float:
        self._check()
        return self._exposure * 1e-6

    def _write(self, setting: Setting, value: float) -> None:
        self._check()
        self._exposure = round(value * 1e6)

    def snap(self, exposure: float) -> Frame:
        """See :class:`acquisition.contracts.Camera`."""
        actual = self.set("exposure", exposure).actual
        counts = np.asarray(self.scene(actual, self._block))
        if counts.shape != self._shape or counts.dtype.kind != "u" or counts.max(initial=0) > self.full_scale:
            raise SettingError(f"scene must give unsigned counts {self._shape} up to {self.full_scale}, "
                               f"got {counts.dtype} {counts.shape}.")  # fmt: skip
        frame = Frame(counts, self._block, self._clock, actual)
        self._block, self._clock = self._block + 1, self._clock + actual
        return frame


class SimulatedModulator(_Open, PhaseModulator):
    """A modulator that remembers: ``shown`` are the levels (y, x) that are on.

    shape: (y, x). levels: steps round the circle. settle: seconds that are reported, and waited by ``wait`` if given.
    on_show: called with the levels, for a scene that follows them.
    """

    def __init__(
        self,
        serial: str = "SIM-MODULATOR",
        shape: tuple[int, int] = (32, 48),
        levels: int = 256,
        settle: float = 0.1,
        on_show: Callable[[np.ndarray], None] | None = None,
    ) -> None:
        self._serial, self._shape = serial, (integer("shape", shape[0], low=1), integer("shape", shape[1], low=1))
        self._levels = integer("levels", levels, low=2, high=1 << 16)
        self._settle = real_number("settle", settle, low=0)
        self._on_show = on_show
        self.shown = np.zeros(self._shape, np.uint8 if levels <= 256 else np.uint16)

    @property
    def serial(self) -> str:
        """See :class:`acquisition.contracts.Device`."""
        return self._serial

    @property
    def shape(self) -> tuple[int, int]:
        """See :class:`PhaseModulator`."""
        return self._shape

    @property
    def levels(self) -> int:
        """See :class:`PhaseModulator`."""
        return self._levels

    @property
    def settings(self) -> Mapping[str, Setting]:
        """See :class:`acquisition.contracts.Device`."""
        return {"settle": Setting("settle", "number", "s", 0.0, 10.0)}

    def describe(self) -> dict[str, Any]:
        """See :class:`acquisition.contracts.Device`."""
        return {"device": "simulated modulator", "serial": self._serial, "shape": list(self._shape),
                "levels": self._levels}  # fmt: skip

    def _read(self, setting: Setting) -> float:
        self._check()
        return self._settle

    def _write(self, setting: Setting, value: float) -> None:
        self._check()
        self._settle = value

    def show(self, phase: np.ndarray) -> Shown:
        """See :class:`PhaseModulator`."""
        self._check()
        self.shown = self.quantised(phase)
        if self._on_show is not None:
            self._on_show(self.shown)
        return Shown(hashlib.sha256(self.shown.tobytes()).hexdigest(), self._settle)

    def make_safe(self) -> None:
        """See :class:`acquisition.contracts.Device`: a flat phase."""
        if not self._closed:
            self.show(np.zeros(self._shape))


class SimulatedInstrument(_Open, Instrument):
    """An instrument with the ``declared`` settings, which keeps what it is told.

    >>> mount = SimulatedInstrument(declared=(Setting("angle", "number", "rad", 0.0, 6.3),))
    >>> mount.set("angle", 0.5).actual
    0.5
    """

    def __init__(self, serial: str = "SIM-INSTRUMENT", declared: tuple[Setting, ...] = ()) -> None:
        self._serial = serial
        self._declared = {s.name: replace(s) for s in declared or (Setting("angle", "number", "rad", 0.0, 2 * np.pi),)}
        start = {"switch": False, "text": ""}
        self.values = {
            s.name: s.safe if s.safe is not None else start.get(s.kind, s.choices[0] if s.choices else s.low or 0)
            for s in self._declared.values()
        }

    @property
    def serial(self) -> str:
        """See :class:`acquisition.contracts.Device`."""
        return self._serial

    @property
    def settings(self) -> Mapping[str, Setting]:
        """See :class:`acquisition.contracts.Device`."""
        return self._declared

    def describe(self) -> dict[str, Any]:
        """See :class:`acquisition.contracts.Device`."""
        return {"device": "simulated instrument", "serial": self._serial}

    def _read(self, setting: Setting) -> Any:
        self._check()
        return self.values[setting.name]

    def _write(self, setting: Setting, value: Any) -> None:
        self._check()
        self.values[setting.name] = value
