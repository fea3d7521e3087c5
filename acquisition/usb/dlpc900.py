"""TI's DLPC900 controller over USB HID: power, display mode, start and stop of a phase light modulator.

In: settings. Out: reports of 64 bytes. The pixels themselves go over a video cable, so that showing a phase needs the
:class:`acquisition.DisplayModulator` on that cable too. Called by benches and users.

Source: DLPC900 Programmer's Guide (TI DLPU018), as public drivers cite it; never tried on hardware.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Mapping
from typing import Any, Self

import numpy as np

from acquisition.contracts import PhaseModulator, Shown
from acquisition.errors import AcquisitionError, DeviceLost, DeviceRefused, DeviceTimeout, ProtocolError, SettingError
from acquisition.settings import Setting
from acquisition.usb.discovery import find
from acquisition.usb.port import UsbPort

__all__ = ["Dlpc900Modulator", "reports"]

REPORT = 64
READ, WRITE = 0xC0, 0x00
REFUSED = 0x20  # of the flags of a reply
POWER, VERSION, HARDWARE, MAIN, MODE, RUN = 0x0200, 0x0206, 0x1A0A, 0x1A0C, 0x1A1B, 0x1A24
CHOICES = {
    "power": (POWER, {"normal": 0, "standby": 1}),
    "mode": (MODE, {"video": 0, "stored pattern": 1, "video pattern": 2, "pattern on the fly": 3}),
    "pattern": (RUN, {"stop": 0, "pause": 1, "start": 2}),
}
ATTEMPTS = 3


def reports(flags: int, sequence: int, command: int, payload: bytes = b"") -> list[bytes]:
    """A command as reports of 64 bytes: six bytes of header and 58 of payload, then 64 of payload each.

    >>> reports(READ, 1, VERSION)[0][:6].hex(" ")
    'c0 01 02 00 06 02'
    """
    whole = struct.pack("<BBHH", flags, sequence, len(payload) + 2, command) + payload
    return [whole[i : i + REPORT].ljust(REPORT, b"\0") for i in range(0, len(whole), REPORT)]


class Dlpc900Modulator(PhaseModulator):
    """A phase light modulator behind a DLPC900, by ``Dlpc900Modulator.open(serial, display=...)``.

    ``display``: the modulator on the video cable, which shows the pixels. Settings: "power" ("standby" is safe), "mode"
    and "pattern" ("stop" is safe).
    """

    def __init__(self, port: UsbPort, serial: str, display: PhaseModulator | None = None) -> None:
        self._port, self._serial, self._display = port, serial, display
        self._sequence, self._closed = 0, False
        self.timeout = 1.0
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    @classmethod
    def open(cls, serial: str, backend: Any = None, display: PhaseModulator | None = None) -> Self:
        """The controller with this serial number; ``backend``: a pyusb backend, None for libusb.

        Raises DeviceAbsent, DeviceForbidden (with what to do), DeviceBusy, ProtocolError.
        """
        return cls(UsbPort(find("modulator", serial, backend), f"modulator {serial}"), serial, display)

    def _open(self) -> None:
        ends: dict[int, int] = {}
        try:
            one = self._port.device.get_active_configuration()[(0, 0)]
            ends = {e.bEndpointAddress & 0x80: e.bEndpointAddress for e in one}
        except (ValueError, AttributeError, IndexError) as error:
            raise DeviceLost(f"{self._port.name} has no configuration: {error}.") from error
        if set(ends) != {0, 0x80}:
            raise ProtocolError(f"{self._port.name} has not the two endpoints of its HID interface.")
        self._port.claim(one.bInterfaceNumber)
        self._out, self._into = ends[0], ends[0x80]
        version = self._ask(VERSION, 16)
        patch, minor, major = struct.unpack_from("<HBB", version)
        self.firmware = f"{major}.{minor}.{patch}"

    @property
    def serial(self) -> str:
        """See :class:`acquisition.contracts.Device`."""
        return self._serial

    def describe(self) -> dict[str, Any]:
        """See :class:`acquisition.contracts.Device`."""
        shown = None if self._display is None else self._display.describe()
        return {"device": "DLPC900", "serial": self._serial, "firmware": self.firmware, "display": shown}

    def status(self) -> tuple[int, int]:
        """The controller's hardware and main status, bits as in the programmer's guide."""
        return self._ask(HARDWARE, 1)[0], self._ask(MAIN, 1)[0]

    @property
    def settings(self) -> Mapping[str, Setting]:
        """See :class:`acquisition.contracts.Device`."""
        safe = {"power": "standby", "pattern": "stop"}
        return {
            name: Setting(name, "choice", choices=tuple(values), safe=safe.get(name))
            for name, (_, values) in CHOICES.items()
        }

    def _read(self, setting: Setting) -> Any:
        command, values = CHOICES[setting.name]
        found = self._ask(command, 1)[0]
        for name, value in values.items():
            if value == found:
                return name
        raise ProtocolError(f"{self._port.name} states {setting.name} {found}, which is none of its choices.")

    def _write(self, setting: Setting, value: Any) -> None:
        command, values = CHOICES[setting.name]
        self._transact(WRITE | 0x40, command, bytes([values[value]]))

    @property
    def shape(self) -> tuple[int, int]:
        """See :class:`PhaseModulator`: that of the display."""
        return self._shown_on().shape

    @property
    def levels(self) -> int:
        """See :class:`PhaseModulator`: those of the display."""
        return self._shown_on().levels

    def show(self, phase: np.ndarray) -> Shown:
        """See :class:`PhaseModulator`."""
        return self._shown_on().show(phase)

    def _shown_on(self) -> PhaseModulator:
        if self._display is None:
            raise SettingError("display must be given to show phases: open(serial, display=DisplayModulator(...)).")
        return self._display

    def _ask(self, command: int, count: int) -> bytes:
        found = self._transact(READ, command, b"")
        if len(found) < count:
            raise ProtocolError(f"{self._port.name} gave {len(found)} bytes for {count} of command {command:#06x}.")
        return found[:count]

    def _transact(self, flags: int, command: int, payload: bytes) -> bytes:
        """The reply's payload; asked again, three times at most, where it is missing or foreign."""
        failed: AcquisitionError = DeviceTimeout(f"{self._port.name}: no reply.")
        for _ in range(ATTEMPTS):
            self._sequence = self._sequence % 255 + 1
            try:
                for report in reports(flags, self._sequence, command, payload):
                    self._port.write(self._out, report, self.timeout)
                return self._reply(command)
            except DeviceLost:
                raise
            except (DeviceTimeout, ProtocolError) as error:
                failed = error
                with contextlib.suppress(DeviceTimeout, ProtocolError):
                    self._port.clear_halt(self._into)
        raise failed

    def _reply(self, command: int) -> bytes:
        for _ in range(8):
            raw = self._port.read(self._into, REPORT, self.timeout)
            if len(raw) != REPORT:
                raise ProtocolError(f"{self._port.name}: a report of {len(raw)} bytes where {REPORT} must be.")
            flags, sequence, length = struct.unpack_from("<BBH", raw)
            if sequence != self._sequence:
                continue  # of an earlier command
            if flags & REFUSED:
                raise DeviceRefused(f"{self._port.name} refused command {command:#06x}.", flags)
            if length > REPORT - 4:
                raise ProtocolError(f"{self._port.name}: a reply of one report states {length} bytes.")
            return raw[4 : 4 + length]
        raise DeviceTimeout(f"{self._port.name}: only replies to earlier commands.")

    def make_safe(self) -> None:
        """See :class:`acquisition.contracts.Device`: the display too."""
        try:
            super().make_safe()
        finally:
            if self._display is not None:
                self._display.make_safe()

    def close(self) -> None:
        """See :class:`acquisition.contracts.Device`."""
        if not self._closed:
            self._closed = True
            self._port.close()
