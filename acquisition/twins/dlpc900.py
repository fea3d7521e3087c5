"""A DLPC900 controller in software, with faults. Called as :mod:`acquisition.twins.camera` is."""

from __future__ import annotations

import struct
from collections import deque
from typing import Any

from acquisition.twins.model import NoData, Overflow, Stall, UsbModel, configuration, interface

__all__ = ["DLPC_FAULTS", "Dlpc900Twin"]

OUT, INTO, REPORT = 0x01, 0x81, 64
DLPC_FAULTS = ("no reply", "wrong number", "short", "absurd length", "refused", "stale first", "empty", "stall",
               "overflow", "unplug")  # fmt: skip


class Dlpc900Twin(UsbModel):
    """A controller whose ``values`` hold what was set, by command.

    faults: what goes wrong, by the number of the command, each once.
    """

    vendor, product, kind, speed = 0x0451, 0xC900, (0, 0, 0), "high"

    def __init__(self, serial: str = "DLP-0001", faults: dict[int, str] | None = None) -> None:
        hid = struct.pack("<BBHBBBH", 9, 0x21, 0x0111, 0, 1, 0x22, 34)
        ends = [struct.pack("<BBBBHB", 7, 5, address, 3, REPORT, 1) for address in (OUT, INTO)]
        super().__init__(("Texas Instruments", "DLPC900", serial), configuration(1, interface(0, (3, 0, 0), ends, hid)))
        self.faults = dict(faults or {})
        self.values = {0x0200: 1, 0x1A1B: 0, 0x1A24: 0}
        self.commands = 0
        self._sent: deque[Any] = deque()

    def received(self, address: int, data: bytes) -> None:
        """See :class:`UsbModel`."""
        if address != OUT or len(data) != REPORT:
            raise Stall
        flags, sequence, length, command = struct.unpack_from("<BBHH", data)
        payload = data[6 : 6 + max(length - 2, 0)]
        number, self.commands = self.commands, self.commands + 1
        refused = 0
        answer = b""
        if flags & 0x80:
            known = {0x0206: struct.pack("<HBB", 3, 2, 4) + bytes(12), 0x1A0A: b"\x01", 0x1A0C: b"\x00"}
            known |= {key: bytes([value]) for key, value in self.values.items()}
            refused = 0 if command in known else 0x20
            answer = known.get(command, b"")
        elif command in self.values and len(payload) == 1:
            self.values[command] = payload[0]
        else:
            refused = 0x20
        self._sent.extend(self._replies(self.faults.pop(number, None), flags & 0xC0 | refused, sequence, answer))

    def _replies(self, fault: str | None, flags: int, sequence: int, answer: bytes) -> list[Any]:
        def reply(one: int = sequence, length: int = len(answer), state: int = flags) -> bytes:
            return (struct.pack("<BBH", state, one, length) + answer).ljust(REPORT, b"\0")

        if fault == "unplug":
            self.plugged = False
        answers: dict[str | None, list[Any]] = {
            None: [reply()],
            "no reply": [],
            "wrong number": [reply(one=sequence ^ 0x55)],
            "short": [reply()[:9]],
            "absurd length": [reply(length=0xFFFF)],
            "refused": [reply(state=flags | 0x20)],
            "stale first": [reply(one=(sequence + 200) % 256), reply()],
            "empty": [b""],
            "stall": [Stall],
            "overflow": [Overflow],
            "unplug": [NoData],
        }
        return answers[fault]

    def answer(self, address: int, length: int) -> bytes:
        """See :class:`UsbModel`."""
        if address != INTO or not self._sent:
            raise NoData
        what = self._sent.popleft()
        if isinstance(what, type):
            if what is Stall:
                self.halted.add(address)
            raise what
        return bytes(what)
