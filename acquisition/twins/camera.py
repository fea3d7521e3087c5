"""A USB3 Vision camera in software: registers, XML, stream and every fault that we know of.

In: a scene, frames by exposure. Out: what a camera would send. Called through :class:`acquisition.twins.TwinBackend`,
through umockdev by foreign programs, and directly by :class:`acquisition.SimulatedCamera`.
"""

from __future__ import annotations

import hashlib
import io
import struct
import zipfile
from collections import deque
from collections.abc import Callable
from importlib import resources
from string import Template
from typing import Any

import numpy as np

from acquisition.twins.model import NoData, Overflow, Stall, UsbModel, configuration, endpoint, interface

__all__ = ["CONTROL_FAULTS", "STREAM_FAULTS", "CameraTwin", "gradient"]

SBRM, SIRM, FEATURES, MANIFEST, XML = 0x10000, 0x20000, 0x30000, 0x40000, 0x100000
OUT, INTO, STREAM = 0x01, 0x81, 0x82
PACKET = 1024
FORMATS = {0x01080001: (1, 255), 0x01100003: (2, 1023), 0x01100005: (2, 4095), 0x01100007: (2, 65535)}

CONTROL_FAULTS = (
    "no acknowledgement", "late acknowledgement", "pending", "pending for ever", "bad magic", "wrong number",
    "wrong command", "wrong length", "busy", "refused", "short", "truncated", "oversized", "empty", "stall",
    "overflow", "unplug",
)  # fmt: skip
STREAM_FAULTS = (
    "nothing", "bad leader", "bad trailer", "short leader", "short trailer", "stall", "overflow", "gap", "other block",
    "discarded", "truncated payload", "oversized payload", "wrong payload", "absurd size", "other format",
    "chunks", "empty", "unplug",
)  # fmt: skip

Scene = Callable[[float, int], np.ndarray]


def gradient(shape: tuple[int, int], full_scale: int) -> Scene:
    """A scene in which every pixel of every frame is known: a ramp that moves with the frame's number."""
    y, x = np.indices(shape)

    def frame(exposure: float, block: int) -> np.ndarray:
        counts = (3 * x + 5 * y + 7 * block + int(exposure * 1e6)) % (full_scale + 1)
        return counts.astype(np.uint8 if full_scale < 256 else np.uint16)

    return frame


class CameraTwin(UsbModel):
    """A camera with ``shape`` (y, x) pixels of ``bits`` 8, 10, 12 or 16, looking at ``scene``.

    scene: counts (y, x) from the exposure in seconds and the frame's number. zipped: the XML travels as a zip archive.
    trigger: whether it has a software trigger; without one it runs freely. faults: what goes wrong, by the number of
    the command (0, 1, ...) for :data:`CONTROL_FAULTS` and of the frame for :data:`STREAM_FAULTS`, each once.
    """

    vendor, product, kind, speed = 0x1209, 0x0001, (0xEF, 0x02, 0x01), "super"

    def __init__(
        self,
        serial: str = "TWIN-0001",
        shape: tuple[int, int] = (48, 64),
        bits: int = 8,
        scene: Scene | None = None,
        zipped: bool = False,
        trigger: bool = True,
        xml: bytes | None = None,
        alignment: int = 1024,
    ) -> None:
        # GenCP 1.0, USB3 Vision 1.0; GUID, vendor, model, family, version, information, serial, user: strings
        device = struct.pack("<BBBHHHHBBBBBBBBB", 20, 0x24, 0x01, 0, 1, 0, 1, 5, 1, 2, 2, 4, 1, 3, 0, 0x08)
        body = struct.pack("<BBBBBBBB", 8, 11, 0, 2, 0xEF, 0x05, 0, 0)
        body += interface(0, (0xEF, 0x05, 0x00), [endpoint(OUT, PACKET), endpoint(INTO, PACKET)], extra=device)
        body += interface(1, (0xEF, 0x05, 0x02), [endpoint(STREAM, PACKET)])
        guid = hashlib.sha1(serial.encode(), usedforsecurity=False).hexdigest()[:12].upper()
        super().__init__(("polinfer", "Camera twin", serial, "1.0", guid), configuration(2, body))
        self.serial, self.sensor, self.trigger, self.alignment = serial, shape, trigger, alignment
        code = {8: 0x01080001, 10: 0x01100003, 12: 0x01100005, 16: 0x01100007}[bits]
        self.scene = scene or gradient(shape, FORMATS[code][1])
        self.control_faults: dict[int, str] = {}
        self.stream_faults: dict[int, str] = {}
        self.commands = self.frames_begun = self.triggers = self.acquisitions = 0
        self.block = 0
        self.clock = 0.0
        self._answers: deque[Any] = deque()
        self._late: deque[bytes] = deque()
        self._frame: deque[Any] = deque()
        self._pending_triggers = 0
        self.acquiring = False
        self.memory: dict[int, int] = {}
        self._fill(code, xml, zipped)

    def _fill(self, code: int, xml: bytes | None, zipped: bool) -> None:
        self._put(0x000, struct.pack("<I", 0x00010000))
        for address, name in ((0x004, "polinfer"), (0x044, "Camera twin"), (0x084, "twins"), (0x0C4, "1.0"),
                              (0x104, "in software"), (0x144, self.serial), (0x184, "")):  # fmt: skip
            self._put(address, name.encode().ljust(64, b"\0"))
        self._put(0x1C4, struct.pack("<QIQQ", 0, 200, MANIFEST, SBRM))
        self._put(0x1E0, bytes(0x30))
        self._put(0x1FC, struct.pack("<QI", 1, 0))
        self._put(SBRM, struct.pack("<IQQIIIQIQIQI", 0x00010000, 1, 0, 1024, 1024, 1, SIRM, 0x30, 0, 0, 0, 0x08))
        exponent = self.alignment.bit_length() - 1
        self._put(SIRM, struct.pack("<IIQIIIIIIII", exponent << 24, 0, 0, 52, 32, 0, 0, 0, 0, 0, 0))
        rows, columns = self.sensor
        # width, height, x, y, format, exposure/us, start, stop, mode, trigger mode, trigger, locked, flags
        for name, value in (("width", columns), ("height", rows), ("x", 0), ("y", 0), ("format", code),
                            ("exposure", 10_000), ("mode", 0), ("trigger_mode", 0), ("locked", 0), ("flags", 0),
                            ("source", 0), ("selector", 0)):  # fmt: skip
            self._put(REGISTERS[name], struct.pack("<I", value))
        self._put(REGISTERS["gain"], struct.pack("<f", 0.0))
        self._put(REGISTERS["user"], b"none".ljust(16, b"\0"))
        self._put(REGISTERS["temperature"], struct.pack("<i", 3125))
        text = camera_xml(self.sensor, self.trigger) if xml is None else xml
        if zipped:
            packed = io.BytesIO()
            with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr("twin.xml", text)
            text = packed.getvalue()
        self._xml = text
        entry = struct.pack("<HBBIQQ", 0, 0, 1, (int(zipped) << 10) | (1 << 16) | (1 << 24), XML, len(text))
        entry += hashlib.sha1(text, usedforsecurity=False).digest()
        self._put(MANIFEST, struct.pack("<Q", 1) + entry.ljust(64, b"\0"))

    # registers

    def _put(self, address: int, data: bytes) -> None:
        self.memory.update(zip(range(address, address + len(data)), data, strict=True))

    def _get(self, address: int, count: int) -> bytes:
        if XML <= address < XML + len(self._xml):
            return self._xml[address - XML : address - XML + count]
        return bytes(map(self.memory.__getitem__, range(address, address + count)))

    def register(self, name: str) -> int:
        """A register of the features, by its name here."""
        return int.from_bytes(self._get(REGISTERS[name], 4), "little")

    def _readable(self, address: int, count: int) -> bool:
        if XML <= address < XML + len(self._xml):
            return address + count <= XML + len(self._xml)
        return all(address + i in self.memory for i in range(count))

    def _written(self, address: int, data: bytes) -> int:
        """The status of a write, done if it is 0."""
        if not self._readable(address, len(data)) and address not in (REGISTERS["start"], REGISTERS["stop"],
                                                                      REGISTERS["trigger"]):  # fmt: skip
            return 0x8003
        if address < 0x184 or MANIFEST <= address < MANIFEST + 72 or address >= XML or SBRM <= address < SBRM + 0x3C:
            return 0x8004
        value = int.from_bytes(data[:4], "little")
        rows, columns = self.sensor
        if address == REGISTERS["start"]:
            if not self._get(SIRM + 4, 1)[0] & 1:
                return 0x800F
            self.acquiring, self.block, self._pending_triggers = True, 0, 0
            self.acquisitions += 1
            self._frame.clear()
            return 0
        if address == REGISTERS["stop"]:
            self.acquiring = False
            self._frame.clear()
            return 0
        if address == REGISTERS["trigger"]:
            self.triggers += 1
            if self.acquiring:
                self._pending_triggers += 1
            return 0
        if self.acquiring and address in (REGISTERS[n] for n in ("width", "height", "x", "y", "format")):
            return 0x8006
        bad = (
            (address == REGISTERS["width"] and not (16 <= value <= columns - self.register("x") and value % 16 == 0))
            or (address == REGISTERS["height"] and not 2 <= value <= rows - self.register("y"))
            or (address == REGISTERS["format"] and value not in FORMATS)
            or (address == REGISTERS["exposure"] and not 10 <= value <= 10_000_000)
        )
        if bad:
            return 0x8002
        if address == 0x1F8:
            self._put(0x1F0, struct.pack("<Q", int(self.clock * 1e9)))
            return 0
        self._put(address, data)
        if address == SIRM + 4 and not value & 1:
            self._frame.clear()
        self._sizes()
        return 0

    def _sizes(self) -> None:
        payload = self.register("width") * self.register("height") * FORMATS[self.register("format")][0]
        self._put(SIRM + 8, struct.pack("<Q", payload))

    # control

    def received(self, address: int, data: bytes) -> None:
        """See :class:`UsbModel`."""
        if address != OUT:
            raise Stall
        if len(data) < 12:
            return
        magic, _, kind, length, request = struct.unpack_from("<IHHHH", data)
        if magic != 0x43563355 or len(data) != 12 + length:
            self._answers.append(_acknowledge(0x800E, kind, request, b""))
            return
        self._sizes()
        status, payload = self._done(kind, data[12:])
        number, self.commands = self.commands, self.commands + 1
        fault = self.control_faults.pop(number, None)
        answer = _acknowledge(status, kind, request, payload)
        if fault is None:
            self._answers.append(answer)
        else:
            self._answers.extend(self._wrong(fault, answer, kind, request, payload))

    def _done(self, kind: int, payload: bytes) -> tuple[int, bytes]:
        if kind == 0x0800 and len(payload) == 12:
            address, _, count = struct.unpack("<QHH", payload)
            if count > 1024 - 12:
                return 0x8002, b""
            if not self._readable(address, count):
                return 0x8003, b""
            return 0, self._get(address, count)
        if kind == 0x0802 and len(payload) > 8:
            address = struct.unpack_from("<Q", payload)[0]
            status = self._written(address, payload[8:])
            return status, struct.pack("<HH", 0, len(payload) - 8) if status == 0 else b""
        return 0x8001, b""

    def _wrong(self, fault: str, answer: bytes, kind: int, request: int, payload: bytes) -> list[Any]:
        """What is sent instead of an acknowledgement; an exception is raised in its turn."""
        pending = struct.pack("<IHHHHHH", 0x43563355, 0, 0x0805, 4, request, 0, 100)
        if fault == "late acknowledgement":
            self._late.append(answer)
        changed: dict[str, list[Any]] = {
            "no acknowledgement": [],
            "late acknowledgement": [],
            "pending": [pending, answer],
            "pending for ever": [pending] * 40,
            "bad magic": [b"XXXX" + answer[4:]],
            "wrong number": [answer[:10] + struct.pack("<H", request ^ 0x55AA) + answer[12:]],
            "wrong command": [_acknowledge(0, kind + 2, request, payload)],
            "wrong length": [answer[:8] + struct.pack("<H", len(payload) + 7) + answer[10:]],
            "busy": [_acknowledge(0x8007, kind, request, b"")],
            "refused": [_acknowledge(0x8006, kind, request, b"")],
            "short": [answer[:7]],
            "truncated": [_acknowledge(0, kind, request, payload[:-1])],
            "oversized": [_acknowledge(0, kind, request, payload + b"\0" * 5)],
            "empty": [b""],
            "stall": [Stall],
            "overflow": [Overflow],
            "unplug": [],
        }
        if fault == "unplug":
            self.plugged = False
        return changed[fault]

    def answer(self, address: int, length: int) -> bytes:
        """See :class:`UsbModel`."""
        if address == STREAM:
            return bytes(self._streamed(length))
        if address != INTO:
            raise Stall
        if not self._answers:
            # one that is late comes when nobody waits for it any more
            while self._late:
                self._answers.append(self._late.popleft())
            raise NoData
        return self._checked(self._answers.popleft(), address, length)

    def _checked(self, what: Any, address: int, length: int) -> Any:
        if isinstance(what, type) and issubclass(what, Exception):
            if what is Stall:
                self.halted.add(address)
            raise what
        if len(what) > length:
            raise Overflow
        return what

    # stream

    def read_into(self, address: int, buffer: memoryview) -> int:
        """See :class:`UsbModel`: pixels are copied once."""
        if address != STREAM:
            return super().read_into(address, buffer)
        self._check(address)
        part = self._streamed(len(buffer))
        buffer[: len(part)] = part
        return len(part)

    def clear_halt(self, address: int) -> None:
        """See :class:`UsbModel`."""
        super().clear_halt(address)
        if address == INTO:
            self._answers.clear()

    def _streamed(self, length: int) -> Any:
        if not self._frame:
            self._begin()
        return self._checked(self._frame.popleft(), STREAM, length)

    def _begin(self) -> None:
        """The transfers of the next frame."""
        if not self.acquiring or not self._get(SIRM + 4, 1)[0] & 1:
            raise NoData
        if self.trigger and self.register("trigger_mode") == 1:
            if not self._pending_triggers:
                raise NoData
            self._pending_triggers -= 1
        number, self.frames_begun = self.frames_begun, self.frames_begun + 1
        fault = self.stream_faults.pop(number, None)
        self._frame.extend(self._transfers(fault))

    def _transfers(self, fault: str | None) -> list[Any]:
        exposure = self.register("exposure") * 1e-6
        block, self.block = self.block, self.block + (2 if fault == "gap" else 1)
        rows, columns, y, x, code = (self.register(n) for n in ("height", "width", "y", "x", "format"))
        counts = self.scene(exposure, block)[y : y + rows, x : x + columns]
        raw = np.ascontiguousarray(counts, dtype="u1" if FORMATS[code][0] == 1 else "<u2")
        pixels = raw.data.cast("B")
        began = int(self.clock * 1e9)
        self.clock += exposure
        kind, height = (0x4001 if fault == "chunks" else 1), (0x7FFFFFFF if fault == "absurd size" else rows)
        sent = (code ^ 6) if fault == "other format" else code
        leader = struct.pack("<IHHQHHQIIIIIHH", 0x4C563355, 0, 52, block, 0, kind, began, sent, columns, height, x, y,
                             0, 0)  # fmt: skip
        status = 0xA100 if fault == "discarded" else 0
        size = len(pixels) + (4096 if fault == "wrong payload" else 0)
        trailer = struct.pack("<IHHQHHQI", 0x54563355, 0, 32, block + (fault == "other block"), status, 0, size, rows)
        if fault == "bad leader":
            leader = b"U3VX" + leader[4:]
        if fault == "bad trailer":
            trailer = b"U3VX" + trailer[4:]
        leader = leader[:20] if fault == "short leader" else leader
        trailer = trailer[:20] if fault == "short trailer" else trailer
        parts = self._payload(pixels, fault)
        if fault == "nothing":
            return [NoData]
        if fault == "stall":
            return [leader, Stall, trailer]
        if fault == "overflow":
            return [leader, Overflow, trailer]
        if fault == "empty":
            return [b"", leader, *parts, trailer]
        if fault == "unplug":
            self.plugged = False
            return [NoData]
        return [leader, *parts, trailer]

    def _payload(self, pixels: memoryview, fault: str | None) -> list[memoryview]:
        """Pixels in transfers of the sizes that the host has written."""
        size, count, first, second = (
            int.from_bytes(self._get(SIRM + offset, 4), "little") for offset in (0x1C, 0x20, 0x24, 0x28)
        )
        sizes = [size] * count + [n for n in (first, second) if n]
        if fault == "truncated payload":
            pixels = pixels[: len(pixels) // 2]
        if fault == "oversized payload":
            pixels = memoryview(bytes(pixels) + bytes(sizes[-1] if sizes else 4096))
            sizes = [*sizes, 1 << 20]
        parts, place = [], 0
        for n in sizes:
            if place >= len(pixels):
                break
            parts.append(pixels[place : place + n])
            place += n
        return parts


def _acknowledge(status: int, kind: int, request: int, payload: bytes) -> bytes:
    return struct.pack("<IHHHH", 0x43563355, status, kind + 1, len(payload), request) + payload


REGISTERS = {
    name: FEATURES + 0x10 * i
    for i, name in enumerate((
        "width", "height", "x", "y", "format", "exposure", "start", "stop", "mode", "trigger_mode", "trigger",
        "locked", "flags", "gain", "user", "temperature", "source", "selector",
    ))
}  # fmt: skip


def camera_xml(sensor: tuple[int, int], trigger: bool) -> bytes:
    """The camera's own description of its features, with every node type that we read."""
    folder = resources.files("acquisition.twins")
    rows, columns = sensor
    names = ("TriggerSelector", "TriggerMode", "TriggerSource", "TriggerSoftware") if trigger else ()
    text = Template(folder.joinpath("camera.xml").read_text()).substitute(
        rows=rows,
        columns=columns,
        trigger_features="".join(f"<pFeature>{name}</pFeature>" for name in names),
        triggers=folder.joinpath("camera-trigger.xml").read_text() if trigger else "",
    )
    return text.encode()
