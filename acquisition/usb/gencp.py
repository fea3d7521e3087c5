"""GenCP over USB3 Vision: registers of a camera by commands and acknowledgements.

In: addresses and bytes. Out: bytes whose every length, number and magic was checked. Called by the camera and, as the
port of its features, by :mod:`acquisition.genicam`.

From public sources (aravis, cameleon); the standard itself is licensed and was not at hand.
"""

from __future__ import annotations

import struct
import time
from dataclasses import dataclass

from acquisition.errors import (
    AcquisitionError,
    DeviceRefused,
    DeviceStalled,
    DeviceTimeout,
    ProtocolError,
    SettingError,
)
from acquisition.usb.port import UsbPort

__all__ = ["Acknowledge", "Control", "acknowledge", "command"]

MAGIC = 0x43563355  # "U3VC"
READ, WRITE, PENDING = 0x0800, 0x0802, 0x0805
HEADER = 12
UNTIL_KNOWN = 128  # bytes of a command or acknowledgement, before the device has said how many it can take
LARGEST_PACKET = 1 << 16
SHORTEST, LONGEST = 0.05, 10.0  # seconds that an answer may take, whatever the device says
ATTEMPTS, STALE = 3, 16
AGAIN = {0x8007, 0x800B, 0xA001}  # busy, timeout, no resend: worth a repetition
MEANING = {
    0x8001: "not implemented", 0x8002: "bad parameter", 0x8003: "bad address", 0x8004: "write-protected",
    0x8005: "bad alignment", 0x8006: "access denied", 0x8007: "busy", 0x800B: "timeout", 0x800E: "bad header",
    0x800F: "wrong configuration", 0x8FFF: "error without a name", 0xA001: "no resend",
    0xA002: "stream endpoint halted", 0xA003: "payload size not aligned", 0xA004: "stream registers inconsistent",
    0xA005: "event endpoint halted",
}  # fmt: skip


@dataclass(frozen=True)
class Acknowledge:
    """An acknowledgement: status, command number (that of the command + 1), number of the request, payload."""

    status: int
    command: int
    request: int
    payload: bytes


def command(kind: int, request: int, payload: bytes) -> bytes:
    """A command that wants an acknowledgement.

    >>> command(READ, 1, bytes(12)).hex(" ")[:35]
    '55 33 56 43 00 40 00 08 0c 00 01 00'
    """
    return struct.pack("<IHHHH", MAGIC, 0x4000, kind, len(payload), request) + payload


def acknowledge(raw: bytes) -> Acknowledge:
    """What came from a device; ProtocolError where magic or length are wrong."""
    if len(raw) < HEADER:
        raise ProtocolError(f"an acknowledgement of {len(raw)} bytes is shorter than its header.")
    magic, status, kind, length, request = struct.unpack_from("<IHHHH", raw)
    if magic != MAGIC:
        raise ProtocolError(f"an acknowledgement begins with {magic:#010x}, not {MAGIC:#010x}.")
    if len(raw) != HEADER + length:
        raise ProtocolError(f"an acknowledgement of {len(raw)} bytes states {HEADER + length}.")
    return Acknowledge(status, kind, request, raw[HEADER:])


class Control:
    """The control channel of one camera: reads and writes registers, repeats what can be repeated.

    Every call ends in bounded time: at most three attempts, each of at most ``response_time`` (clamped to 50 ms to
    10 s), extended by acknowledgements of "pending" to 10 s in all.
    """

    def __init__(self, port: UsbPort, out: int, into: int, packet: int, response_time: float = 1.0) -> None:
        self.port, self._out, self._into, self._packet = port, out, into, max(packet, 1)
        self.largest_command = self.largest_acknowledge = UNTIL_KNOWN
        self.response_time = response_time
        self._request = 0

    def limits(self, largest_command: int, largest_acknowledge: int, response_time: float) -> None:
        """What the device says that it can take; ProtocolError for sizes that no packet fits into."""
        for name, size in (("command", largest_command), ("acknowledgement", largest_acknowledge)):
            if not 32 <= size <= LARGEST_PACKET:
                raise ProtocolError(f"{self.port.name} states a largest {name} of {size} bytes.")
        self.largest_command, self.largest_acknowledge = largest_command, largest_acknowledge
        self.response_time = min(max(response_time, SHORTEST), LONGEST)

    def read(self, address: int, count: int) -> bytes:
        """``count`` bytes, in as many commands as it takes."""
        block = (self.largest_acknowledge - HEADER) & ~3
        found = bytearray()
        while len(found) < count:
            part = min(block, count - len(found))
            payload = struct.pack("<QHH", address + len(found), 0, part)
            answer = self._transact(READ, payload, True)
            if len(answer) != part:
                raise ProtocolError(f"{self.port.name} gave {len(answer)} bytes for {part} at {address:#x}.")
            found += answer
        return bytes(found)

    def write(self, address: int, data: bytes, repeat: bool = True) -> None:
        """All of ``data``. repeat: False for what must not be done twice, such as a trigger."""
        block = (self.largest_command - HEADER - 8) & ~3
        for start in range(0, len(data), block):
            part = data[start : start + block]
            answer = self._transact(WRITE, struct.pack("<Q", address + start) + part, repeat)
            written = struct.unpack_from("<HH", answer)[1] if len(answer) >= 4 else -1
            # some devices leave the count out; one that is there must be right
            if answer and written != len(part):
                raise ProtocolError(f"{self.port.name} wrote {written} of {len(part)} bytes at {address:#x}.")

    def number(self, address: int, size: int) -> int:
        """An unsigned register."""
        return int.from_bytes(self.read(address, size), "little")

    def text(self, address: int, size: int = 64) -> str:
        """A register of text, without what could disturb a terminal or a path."""
        raw = self.read(address, size).split(b"\0")[0].decode("utf-8", "replace")
        return "".join(c for c in raw if c.isprintable())[:size]

    def _transact(self, kind: int, payload: bytes, repeat: bool) -> bytes:
        failed: AcquisitionError = DeviceTimeout(f"{self.port.name}: no acknowledgement.")
        for _ in range(ATTEMPTS):
            self._request = self._request % 0xFFFF + 1
            try:
                self.port.write(self._out, command(kind, self._request, payload), self.response_time)
                return self._answer(kind)
            except DeviceRefused as error:
                if error.status not in AGAIN:
                    raise
                failed = error
            except (DeviceTimeout, ProtocolError) as error:
                failed = error
                if isinstance(error, DeviceStalled):
                    self.port.clear_halt(self._out)
                    self.port.clear_halt(self._into)
                if not repeat:  # it may have been done: only what was refused as busy is certain not to have been
                    break
        raise failed

    def _answer(self, kind: int) -> bytes:
        """The payload of the acknowledgement of the last request; what belongs to earlier ones is thrown away."""
        size = -(-self.largest_acknowledge // self._packet) * self._packet
        now = time.monotonic()
        last, deadline = now + LONGEST, now + self.response_time
        for _ in range(STALE):
            left = min(deadline, last) - time.monotonic()
            if left <= 0:
                break
            found = acknowledge(self.port.read(self._into, size, left))
            if found.request != self._request:
                continue
            if found.command == PENDING:
                if len(found.payload) < 4:
                    raise ProtocolError(f"{self.port.name}: a pending acknowledgement of {len(found.payload)} bytes.")
                wait = struct.unpack_from("<HH", found.payload)[1] / 1000
                deadline = time.monotonic() + min(max(wait, SHORTEST), LONGEST)
                continue
            if found.status:
                meaning = MEANING.get(found.status, "an unknown status")
                raise DeviceRefused(f"{self.port.name} refused: {meaning} ({found.status:#06x}).", found.status)
            if found.command != kind + 1:
                raise ProtocolError(f"{self.port.name} acknowledged {found.command:#06x}, not {kind + 1:#06x}.")
            return found.payload
        raise DeviceTimeout(f"{self.port.name}: no acknowledgement in time.")


class CarefulPort:
    """Registers for features: a refused access is a setting that cannot be used now."""

    def __init__(self, control: Control) -> None:
        self.control = control

    def read(self, address: int, count: int) -> bytes:
        """See :meth:`Control.read`."""
        return self.control.read(address, count)

    def write(self, address: int, data: bytes) -> None:
        """See :meth:`Control.write`; SettingError where the device refuses the value."""
        try:
            self.control.write(address, data)
        except DeviceRefused as error:
            if error.status in (0x8002, 0x8004, 0x8006):
                raise SettingError(str(error)) from error
            raise
