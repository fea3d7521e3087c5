"""A USBTMC instrument in software: a rotation mount, a retarder and a power meter in one, with faults.

In: messages. Out: answers. Called as :mod:`acquisition.twins.camera` is.
"""

from __future__ import annotations

import struct
from collections import deque
from typing import Any

from acquisition.twins.model import NoData, Overflow, Stall, UsbModel, configuration, endpoint, interface

__all__ = ["INSTRUMENT_FAULTS", "InstrumentTwin"]

OUT, INTO, EVENTS, PACKET = 0x02, 0x86, 0x87, 512
INSTRUMENT_FAULTS = (
    "no answer", "wrong tag", "wrong complement", "wrong kind", "short", "size too large", "absurd size", "split",
    "in packets", "not text", "no number", "endless", "empty", "stall", "overflow", "unplug",
)  # fmt: skip


class InstrumentTwin(UsbModel):
    """An instrument with an angle (0 to 360 degrees), a voltage (0 to 10 V), a power that follows Malus' law, and a
    wavelength (400 to 1000 nm).

    faults: what goes wrong, by the number of the answer, each once.
    """

    vendor, product, kind, speed = 0x1209, 0x0002, (0, 0, 0), "high"

    def __init__(self, serial: str = "TMC-0001", faults: dict[int, str] | None = None) -> None:
        ends = [endpoint(OUT, PACKET, False), endpoint(INTO, PACKET, False),
                struct.pack("<BBBBHB", 7, 5, EVENTS, 3, 2, 9)]  # fmt: skip
        body = interface(0, (0xFE, 0x03, 0x01), ends)
        super().__init__(("polinfer", "Instrument twin", serial), configuration(1, body))
        self.serial = serial
        self.faults = dict(faults or {})
        self.values = {"ANGL": 0.0, "VOLT": 0.0, "SENS:CORR:WAV": 850.0}
        self.ranges = {"ANGL": (0.0, 360.0), "VOLT": (0.0, 10.0), "SENS:CORR:WAV": (400.0, 1000.0)}
        self.errors: deque[str] = deque()
        self.answers = 0
        self._message = bytearray()
        self._text: deque[bytes] = deque()
        self._sent: deque[Any] = deque()
        self._events: deque[bytes] = deque()
        self._aborted = False

    def received(self, address: int, data: bytes) -> None:
        """See :class:`UsbModel`."""
        if address != OUT or len(data) < 12:
            raise Stall
        kind, tag, complement, size, attributes = struct.unpack_from("<BBBxIB", data)
        if tag == 0 or complement != ~tag & 0xFF or len(data) % 4:
            self.halted.add(OUT)
            raise Stall
        if kind == 1:
            self._message += data[12 : 12 + size]
            if attributes & 1:
                message, self._message = bytes(self._message).decode("ascii", "replace").strip(), bytearray()
                for part in message.split(";"):
                    self._do(part.strip())
        elif kind == 2:
            self._answer(tag, size)
        else:
            self.halted.add(OUT)
            raise Stall

    def _do(self, message: str) -> None:
        head, _, rest = message.partition(" ")
        known = head.upper().rstrip("?")
        if head.upper() == "*IDN?":
            self._say(f"polinfer,Instrument twin,{self.serial},1.0")
        elif head.upper() == "*OPC?":
            self._say("1")
        elif head.upper() in ("*CLS", "*RST"):
            self.errors.clear()
        elif head.upper() == "SYST:ERR?":
            self._say(self.errors.popleft() if self.errors else '0,"No error"')
        elif head.upper() == "MEAS:POW?":
            from math import cos, radians

            self._say(f"{1e-3 * cos(radians(self.values['ANGL'])) ** 2:.9e}")
        elif known in self.values and head.endswith("?"):
            ends = dict(zip(("MIN", "MAX"), self.ranges[known], strict=True))
            self._say(f"{ends.get(rest.strip().upper(), self.values[known]):.6f}")
        elif known in self.values:
            self._write(known, rest)
        else:
            self.errors.append('-113,"Undefined header"')

    def _write(self, name: str, text: str) -> None:
        try:
            value = float(text)
        except ValueError:
            self.errors.append('-104,"Data type error"')
            return
        low, high = self.ranges[name]
        if not low <= value <= high:
            self.errors.append('-222,"Data out of range"')
            return
        self.values[name] = round(value, 6)

    def _say(self, text: str) -> None:
        self._text.append(text.encode() + b"\n")

    def _answer(self, tag: int, size: int) -> None:
        if not self._text:
            return
        number, self.answers = self.answers, self.answers + 1
        fault = self.faults.pop(number, None)
        text = self._text.popleft()
        if len(text) > size:
            self._text.appendleft(text[size:])
            text, last = text[:size], 0
        else:
            last = 1
        self._sent.extend(self._wrong(fault, tag, text, last))

    def _wrong(self, fault: str | None, tag: int, text: bytes, last: int) -> list[Any]:
        def header(
            kind: int = 2, one: int = tag, other: int | None = None, size: int = len(text), end: int = last
        ) -> bytes:
            return struct.pack("<BBBxIBxxx", kind, one, ~one & 0xFF if other is None else other, size, end)

        if fault == "unplug":
            self.plugged = False
        if fault == "split":
            self._text.appendleft(text[len(text) // 2 :])
            text = text[: len(text) // 2]
            return [header(size=len(text), end=0) + text]
        answers: dict[str | None, list[Any]] = {
            None: [header() + text],
            "no answer": [],
            "wrong tag": [header(one=tag % 255 + 1) + text],
            "wrong complement": [header(other=tag) + text],
            "wrong kind": [header(kind=7) + text],
            "short": [header()[:5]],
            "size too large": [header(size=len(text) + 40) + text],
            "absurd size": [header(size=0xFFFFFFF0) + text],
            "in packets": [header() + text[:1], text[1:]],
            "not text": [header() + bytes(range(len(text)))],
            "no number": [header(size=4) + b"abc\n"],
            "endless": [header(end=0) + text],
            "empty": [b""],
            "stall": [Stall],
            "overflow": [Overflow],
            "unplug": [],
        }
        return answers[fault]

    def answer(self, address: int, length: int) -> bytes:
        """See :class:`UsbModel`."""
        if address == EVENTS and self._events:
            return self._events.popleft()
        if address != INTO or not self._sent:
            raise NoData
        what = self._sent.popleft()
        if isinstance(what, type):
            if what is Stall:
                self.halted.add(address)
            raise what
        if len(what) > length:
            # a bulk endpoint goes on with the rest: USBTMC answers may be read packet by packet
            if length % PACKET:
                raise Overflow
            self._sent.appendleft(what[length:])
            what = what[:length]
        return bytes(what)

    def request(self, request_type: int, request: int, value: int, index: int, data: bytes) -> bytes:
        """See :class:`UsbModel`: aborts, clearing, capabilities and the status byte."""
        if request_type not in (0xA1, 0xA2):
            raise Stall
        if request in (1, 3):
            self._aborted = True
            self._sent.clear()
            self._text.clear()
            return bytes([1, value & 0xFF])
        if request in (2, 4):
            return bytes([1 if self._aborted else 0x81]) + bytes(7)
        if request == 5:
            self._sent.clear()
            self._text.clear()
            self._message.clear()
            return b"\x01"
        if request == 6:
            return b"\x01\0"
        if request == 7:
            return struct.pack("<BxHBB6xHBB8x", 1, 0x0100, 0, 0, 0x0100, 4, 0)
        if request == 128:
            # with an interrupt endpoint the byte comes there
            self._events.append(bytes([0x80 | value & 0x7F, 0]))
            return bytes([1, value & 0x7F, 0])
        if request in (64, 160, 161, 162):
            return b"\x01"
        raise Stall
