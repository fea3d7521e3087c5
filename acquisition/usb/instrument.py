"""USBTMC: instruments that take text and give text; rotation mounts, retarders and power meters in their SI units.

In: messages, or settings with a unit. Out: answers, every header checked. Called by benches and users.

From public sources: python-usbtmc, pyvisa-py and the kernel's usbtmc driver, which this does not copy.
"""

from __future__ import annotations

import contextlib
import math
import struct
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from acquisition.contracts import Instrument
from acquisition.errors import (
    AcquisitionError,
    DeviceLost,
    DeviceRefused,
    DeviceStalled,
    DeviceTimeout,
    ProtocolError,
    SettingError,
)
from acquisition.settings import Kind, Setting
from acquisition.usb.discovery import find
from acquisition.usb.port import UsbPort

__all__ = ["PowerMeter", "Retarder", "RotationMount", "Scpi", "UsbtmcInstrument"]

CLASS = (0xFE, 0x03)
OUT_MESSAGE, IN_MESSAGE = 1, 2
SUCCESS, PENDING = 0x01, 0x02
LARGEST = 1 << 20  # bytes of one answer
CHUNK = 1 << 16
DEGREE = math.pi / 180


@dataclass(frozen=True)
class Scpi:
    """A setting that is a command of the instrument: ``command?`` reads it, ``command value`` writes it.

    scale: what one unit of the instrument is in ``unit``: pi/180 for degrees where the unit is rad. limits: whether
    ``command? MIN`` and ``command? MAX`` tell the range. safe: in ``unit``.
    """

    name: str
    command: str
    unit: str = ""
    kind: Kind = "number"
    scale: float = 1.0
    limits: bool = True
    access: Any = "rw"
    safe: float | None = None


class UsbtmcInstrument(Instrument):
    """Any instrument that speaks USBTMC, by ``UsbtmcInstrument.open(serial)``.

    ``commands``: its settings. ``write``, ``read`` and ``query`` exchange text with it. A read that runs into its
    timeout (seconds) is aborted as the class demands, endpoint emptied, so that the instrument answers again.
    """

    commands: ClassVar[tuple[Scpi, ...]] = ()

    def __init__(
        self, port: UsbPort, serial: str, commands: tuple[Scpi, ...] | None = None, timeout: float = 2.0
    ) -> None:
        self._port, self._serial, self.timeout = port, serial, timeout
        self._commands = {c.name: c for c in (self.commands if commands is None else commands)}
        self._declared: dict[str, Setting] | None = None
        self._tag, self._closed = 0, False
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    @classmethod
    def open(cls, serial: str, backend: Any = None, commands: tuple[Scpi, ...] | None = None) -> Self:
        """The instrument with this serial number; ``backend``: a pyusb backend, None for libusb.

        Raises DeviceAbsent, DeviceForbidden (with what to do), DeviceBusy, ProtocolError.
        """
        return cls(UsbPort(find("instrument", serial, backend), f"instrument {serial}"), serial, commands)

    def _open(self) -> None:
        ends: dict[int, Any] = {}
        try:
            for one in self._port.device.get_active_configuration():
                if (one.bInterfaceClass, one.bInterfaceSubClass) == CLASS:
                    self._port.claim(one.bInterfaceNumber)
                    self._interface = one.bInterfaceNumber
                    ends = {e.bEndpointAddress & 0x80: e for e in one if e.bmAttributes & 3 == 2}
                    break
        except (ValueError, AttributeError) as error:
            raise DeviceLost(f"{self._port.name} has no configuration: {error}.") from error
        if set(ends) != {0, 0x80}:
            raise ProtocolError(f"{self._port.name} has not the endpoints of USBTMC.")
        self._out, self._into = (ends[side].bEndpointAddress for side in (0, 0x80))
        self._packet = max(int(ends[0x80].wMaxPacketSize), 1)
        self.identity = self.query("*IDN?")

    @property
    def serial(self) -> str:
        """See :class:`acquisition.contracts.Device`."""
        return self._serial

    def describe(self) -> dict[str, Any]:
        """See :class:`acquisition.contracts.Device`."""
        return {"device": "USBTMC instrument", "serial": self._serial, "identity": self.identity}

    # messages

    def write(self, message: str) -> None:
        """Send a line of text."""
        if not isinstance(message, str) or not message or not message.isascii() or not message.isprintable():
            raise SettingError(f"message must be a line of printable ASCII, got {message!r}.")
        raw = message.encode() + b"\n"
        tag = self._next()
        packet = struct.pack("<BBBxIBxxx", OUT_MESSAGE, tag, ~tag & 0xFF, len(raw), 1) + raw
        try:
            self._port.write(self._out, packet + bytes(-len(packet) % 4), self.timeout)
        except DeviceStalled:
            self._port.clear_halt(self._out)
            raise
        except DeviceTimeout:
            self._abort(1, tag, self._out)
            raise

    def read(self) -> str:
        """The instrument's answer, without the line's end."""
        found = bytearray()
        deadline = time.monotonic() + 2 * self.timeout
        while time.monotonic() < deadline:
            part, last = self._message()
            found += part
            if len(found) > LARGEST:
                raise ProtocolError(f"{self._port.name} answers with more than {LARGEST} bytes.")
            if last:
                return self._text(bytes(found))
        raise DeviceTimeout(f"{self._port.name}: an answer without end.")

    def query(self, message: str) -> str:
        """Send, and read the answer."""
        self.write(message)
        return self.read()

    def clear(self) -> None:
        """Throw away whatever is under way on both sides."""
        self._checked(5, self._interface, 1, 0xA1, 0)
        for _ in range(50):
            status = self._port.ask(0xA1, 6, 0, self._interface, 2, self.timeout)
            if status[0] != PENDING:
                break
            if status[1] & 1:
                self._empty()
        self._port.clear_halt(self._out)

    def _text(self, raw: bytes) -> str:
        text = raw.decode("ascii", "replace").rstrip("\r\n")
        if not text.isprintable() and text:
            raise ProtocolError(f"{self._port.name} answers with {raw[:40]!r}, which is no text.")
        return text

    def _next(self) -> int:
        self._tag = self._tag % 255 + 1
        return self._tag

    def _message(self) -> tuple[bytes, bool]:
        """One transfer's text, and whether it is the last of the message."""
        tag = self._next()
        self._port.write(self._out, struct.pack("<BBBxIBBxx", IN_MESSAGE, tag, ~tag & 0xFF, CHUNK, 0, 0), self.timeout)
        try:
            return self._response(tag)
        except DeviceStalled:
            self._port.clear_halt(self._into)
            raise
        except DeviceLost:
            raise
        except (DeviceTimeout, ProtocolError):
            with contextlib.suppress(DeviceTimeout, ProtocolError, DeviceRefused):
                self._abort(3, tag, self._into)
            raise

    def _response(self, tag: int) -> tuple[bytes, bool]:
        size = -(-(CHUNK + 16) // self._packet) * self._packet
        raw = self._port.read(self._into, size, self.timeout)
        if len(raw) < 12:
            raise ProtocolError(f"{self._port.name}: an answer of {len(raw)} bytes is shorter than its header.")
        kind, one, other, length, attributes = struct.unpack_from("<BBBxIB", raw)
        if (kind, one, other) != (IN_MESSAGE, tag, ~tag & 0xFF):
            raise ProtocolError(f"{self._port.name}: an answer of kind {kind} to {one}, not {IN_MESSAGE} to {tag}.")
        if length > CHUNK:
            raise ProtocolError(f"{self._port.name}: an answer states {length} bytes where {CHUNK} were asked for.")
        text = bytearray(raw[12:])
        # the size in the header counts, not the first short packet alone
        while len(text) < length:
            more = self._port.read(self._into, size, self.timeout)
            if not more:
                raise ProtocolError(f"{self._port.name}: {len(text)} of {length} bytes came.")
            text += more
        return bytes(text[:length]), bool(attributes & 1)

    def _abort(self, request: int, tag: int, endpoint: int) -> None:
        """End a transfer: tell the instrument, empty the endpoint, wait until it says that it is done."""
        status = self._port.ask(0xA2, request, tag, endpoint, 2, self.timeout)[0]
        if status != SUCCESS:
            return
        if endpoint == self._into:
            self._empty()
        for _ in range(50):
            found = self._port.ask(0xA2, request + 1, 0, endpoint, 8, self.timeout)
            if found[0] != PENDING:
                break
            if endpoint == self._into and found[1] & 1:
                self._empty()
            time.sleep(0.01)
        if endpoint == self._out:
            self._port.clear_halt(endpoint)

    def _empty(self) -> None:
        """Read to a short packet."""
        for _ in range(64):
            try:
                if len(self._port.read(self._into, self._packet, 0.1)) < self._packet:
                    return
            except DeviceTimeout:
                return

    def _checked(self, request: int, index: int, count: int, kind: int, value: int) -> None:
        status = self._port.ask(kind, request, value, index, count, self.timeout)[0]
        if status != SUCCESS:
            raise DeviceRefused(f"{self._port.name} refused request {request} (status {status:#04x}).", status)

    # settings

    @property
    def settings(self) -> Mapping[str, Setting]:
        """See :class:`acquisition.contracts.Device`; limits are asked for once."""
        if self._declared is None:
            self._declared = {name: self._asked(c) for name, c in self._commands.items()}
        return self._declared

    def _asked(self, c: Scpi) -> Setting:
        ends: list[float | None] = [None, None]
        if c.limits and c.kind in ("number", "integer"):
            ends = [self._number(f"{c.command}? {end}") * c.scale for end in ("MIN", "MAX")]
        return Setting(c.name, c.kind, c.unit, ends[0], ends[1], access=c.access, safe=c.safe)

    def _number(self, query: str) -> float:
        answer = self.query(query)
        try:
            value = float(answer)
        except ValueError as error:
            raise ProtocolError(
                f"{self._port.name} answers {answer[:40]!r} to {query!r}, which is no number."
            ) from error
        if not math.isfinite(value):
            raise ProtocolError(f"{self._port.name} answers {value} to {query!r}.")
        return value

    def _read(self, setting: Setting) -> Any:
        c = self._commands[setting.name]
        if c.kind in ("number", "integer"):
            value = self._number(f"{c.command}?") * c.scale
            return round(value) if c.kind == "integer" else value
        answer = self.query(f"{c.command}?")
        return answer.strip() not in ("0", "OFF") if c.kind == "switch" else answer

    def _write(self, setting: Setting, value: Any) -> None:
        c = self._commands[setting.name]
        if c.kind == "action":
            self.write(c.command)
        elif c.kind in ("number", "integer"):
            self.write(f"{c.command} {value / c.scale:.12g}")
        else:
            self.write(f"{c.command} {int(value) if c.kind == 'switch' else value}")
        self._settle()

    def _settle(self) -> None:
        """Until the instrument has done what it was told: it answers ``*OPC?`` then, and has no error to report."""
        self.query("*OPC?")
        error = self.query("SYST:ERR?")
        number = error.split(",")[0].strip()
        if number not in ("0", "+0"):
            raise DeviceRefused(f"{self._port.name} reports {error[:80]}.", -1)

    def close(self) -> None:
        """See :class:`acquisition.contracts.Device`."""
        if not self._closed:
            self._closed = True
            with contextlib.suppress(AcquisitionError):
                self._port.close()


class RotationMount(UsbtmcInstrument):
    """A rotation mount whose "angle" (rad) is set by ``ANGL`` in degrees."""

    commands = (Scpi("angle", "ANGL", "rad", scale=DEGREE),)


class Retarder(UsbtmcInstrument):
    """A liquid-crystal retarder whose "voltage" (V) is set by ``VOLT``; 0 V is safe."""

    commands = (Scpi("voltage", "VOLT", "V", safe=0.0),)


class PowerMeter(UsbtmcInstrument):
    """A power meter: "power" (W) by ``MEAS:POW``, its "wavelength" (m) by ``SENS:CORR:WAV`` in nanometres."""

    commands = (
        Scpi("power", "MEAS:POW", "W", limits=False, access="ro"),
        Scpi("wavelength", "SENS:CORR:WAV", "m", scale=1e-9),
    )
