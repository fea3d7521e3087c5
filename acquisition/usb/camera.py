"""A USB3 Vision camera: opened by its serial number, its features read from its own XML, its frames checked whole.

In: exposures. Out: raw frames. Called by benches and the command line.
"""

from __future__ import annotations

import array
import contextlib
import time
from collections.abc import Iterator, Mapping
from typing import Any, Self

import numpy as np

from acquisition.contracts import Camera, Frame
from acquisition.errors import (
    AcquisitionError,
    DeviceLost,
    DeviceRefused,
    DeviceStalled,
    DeviceTimeout,
    FrameLost,
    ProtocolError,
    SettingError,
)
from acquisition.genicam import Features
from acquisition.settings import Setting
from acquisition.usb import u3v
from acquisition.usb.discovery import find
from acquisition.usb.gencp import CarefulPort, Control
from acquisition.usb.port import LONGEST_TRANSFER, UsbPort

__all__ = ["Usb3VisionCamera"]

CLASS = (0xEF, 0x05)  # of the interfaces; protocol 0 controls, 1 tells events, 2 streams
ATTEMPTS = 3
MARGIN = 1.0  # seconds that a frame may take beyond its exposure
OLD = 16  # frames that may be older than the call that asks for a new one
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "\u00b5s": 1e-6, "\u03bcs": 1e-6, "ns": 1e-9}
# ours, the camera's, and whether the stream must stand still to write it
_NAMES = {
    "exposure": ("ExposureTime", False),
    "gain": ("Gain", False),
    "pixel_format": ("PixelFormat", True),
    "width": ("Width", True),
    "height": ("Height", True),
    "offset_x": ("OffsetX", True),
    "offset_y": ("OffsetY", True),
}


class Usb3VisionCamera(Camera):
    """A camera that speaks USB3 Vision, by ``Usb3VisionCamera.open(serial)``.

    A frame is triggered by software where the camera has such a trigger, and otherwise taken from its free run, those
    that began before the call thrown away by the camera's own clock. Leader, payload and trailer of each frame must
    agree in block number, size and format; what does not is taken again, three times at most.
    """

    def __init__(self, port: UsbPort, serial: str) -> None:
        self._port, self._serial = port, serial
        self._closed = self._streaming = self._lost = False
        self._exposure: float | None = None
        self._block: int | None = None
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    @classmethod
    def open(cls, serial: str, backend: Any = None) -> Self:
        """The camera with this serial number; ``backend``: a pyusb backend, None for libusb.

        Raises DeviceAbsent, DeviceForbidden (with what to do), DeviceBusy, ProtocolError.
        """
        return cls(UsbPort(find("camera", serial, backend), f"camera {serial}"), serial)

    def _open(self) -> None:
        control, stream = self._interfaces()
        self._port.claim(control.bInterfaceNumber)
        self._port.claim(stream.bInterfaceNumber)
        ends = {e.bEndpointAddress & 0x80: e for e in control}
        if set(ends) != {0, 0x80} or stream.bNumEndpoints < 1:
            raise ProtocolError(f"{self._port.name} has not the endpoints of USB3 Vision.")
        self._stream = next(iter(stream)).bEndpointAddress
        self._packet = max(int(next(iter(stream)).wMaxPacketSize), 1)
        self.control = Control(
            self._port, ends[0].bEndpointAddress, ends[0x80].bEndpointAddress, int(ends[0x80].wMaxPacketSize)
        )
        response = self.control.number(u3v.ABRM["response"], 4) / 1000
        sbrm = self.control.number(u3v.ABRM["sbrm"], 8)
        largest = [self.control.number(sbrm + u3v.SBRM[name], 4) for name in ("command", "acknowledge")]
        self.control.limits(largest[0], largest[1], response)
        if not self.control.number(sbrm + u3v.SBRM["capability"], 8) & 1:
            raise ProtocolError(f"{self._port.name} states no stream.")
        self._sirm = self.control.number(sbrm + u3v.SBRM["sirm"], 8)
        self._about = {name: self.control.text(u3v.ABRM[name]) for name in ("manufacturer", "model", "version")}
        self.features = Features(self._xml(), CarefulPort(self.control))
        for name in ("ExposureTime", "Width", "Height", "PixelFormat", "AcquisitionStart", "AcquisitionStop"):
            if name not in self.features:
                raise ProtocolError(f"{self._port.name} has no feature {name}.")
        # a program that was killed may have left it running
        self._halt()
        with contextlib.suppress(SettingError):
            if "AcquisitionMode" in self.features:
                self.features.set("AcquisitionMode", "Continuous")
        self._triggered = self._arm()

    def _interfaces(self) -> tuple[Any, Any]:
        found: dict[int, Any] = {}
        try:
            for one in self._port.device.get_active_configuration():
                if (one.bInterfaceClass, one.bInterfaceSubClass) == CLASS:
                    found.setdefault(one.bInterfaceProtocol, one)
        except (ValueError, AttributeError) as error:
            raise DeviceLost(f"{self._port.name} has no configuration: {error}.") from error
        if 0 not in found or 2 not in found:
            raise ProtocolError(f"{self._port.name} has no control and stream interfaces of USB3 Vision.")
        return found[0], found[2]

    def _arm(self) -> bool:
        """Software trigger on, where the camera has one."""
        if not all(name in self.features for name in ("TriggerMode", "TriggerSoftware")):
            return False
        try:
            for name, value in (("TriggerSelector", "FrameStart"), ("TriggerSource", "Software")):
                if name in self.features:
                    self.features.set(name, value)
            self.features.set("TriggerMode", "On")
        except SettingError:
            return False
        return True

    def _xml(self) -> bytes:
        table = self.control.number(u3v.ABRM["manifest"], 8)
        count = self.control.number(table, 8)
        if not 0 < count <= u3v.MOST_ENTRIES:
            raise ProtocolError(f"{self._port.name} states {count} manifest entries; 1 to {u3v.MOST_ENTRIES} are read.")
        entries = u3v.manifest(self.control.read(table + 8, 64 * count))
        newest = max(entries, key=lambda entry: entry.schema)
        return u3v.camera_xml(newest, self.control.read(newest.address, newest.size))

    @property
    def serial(self) -> str:
        """See :class:`acquisition.contracts.Device`."""
        return self._serial

    def describe(self) -> dict[str, Any]:
        """See :class:`acquisition.contracts.Device`."""
        shape = self.shape
        return {"device": "USB3 Vision camera", "serial": self._serial, **self._about, "shape": list(shape),
                "pixel_format": self.features.get("PixelFormat"),
                "trigger": "software" if self._triggered else "free run"}  # fmt: skip

    @property
    def shape(self) -> tuple[int, int]:
        """See :class:`acquisition.contracts.Camera`."""
        return int(self.features.get("Height")), int(self.features.get("Width"))

    @property
    def _format(self) -> u3v.PixelFormat:
        name = self.features.get("PixelFormat")
        for known in u3v.FORMATS.values():
            if known.name == name:
                return known
        raise SettingError(f"pixel_format {name} cannot be read; set one of "
                           f"{', '.join(f.name for f in u3v.FORMATS.values())}.")  # fmt: skip

    @property
    def full_scale(self) -> int:
        """See :class:`acquisition.contracts.Camera`."""
        return self._format.full_scale

    @property
    def settings(self) -> Mapping[str, Setting]:
        """See :class:`acquisition.contracts.Device`."""
        return {ours: self._declared(ours) for ours, (theirs, _) in _NAMES.items() if theirs in self.features}

    def setting(self, name: str) -> Setting:
        """See :class:`acquisition.contracts.Device`."""
        if name not in _NAMES or _NAMES[name][0] not in self.features:
            known = [ours for ours, (theirs, _) in _NAMES.items() if theirs in self.features]
            raise SettingError(f"name must be one of {', '.join(known)}, got {name!r}.")
        return self._declared(name)

    def _declared(self, ours: str) -> Setting:
        feature = self.features.feature(_NAMES[ours][0])
        access: Any = feature.access or "ro"
        if ours != "exposure":
            kind: Any = feature.kind
            if _NAMES[ours][1] and access == "ro":
                access = "rw"  # locked by the stream, which is stopped to write it
            return Setting(ours, kind, "pixel" if kind == "integer" else feature.unit, feature.low, feature.high,
                           feature.step, feature.choices, access)  # fmt: skip
        second = self._second(feature.unit)
        low, high = (None if end is None else end * second for end in (feature.low, feature.high))
        return Setting("exposure", "number", "s", low, high, access=access)

    def _second(self, unit: str) -> float:
        """Seconds in the camera's unit; the naming convention asks for microseconds."""
        if unit and unit not in _UNITS:
            raise ProtocolError(f"{self._port.name} states exposure in {unit!r}, an unknown unit.")
        return _UNITS.get(unit, 1e-6)

    def _read(self, setting: Setting) -> Any:
        value = self.features.get(_NAMES[setting.name][0])
        if setting.name == "exposure":
            return float(value) * self._second(self.features.feature("ExposureTime").unit)
        return value

    def _write(self, setting: Setting, value: Any) -> None:
        theirs, still = _NAMES[setting.name]
        if still:
            self._halt()
        if setting.name == "exposure":
            self._exposure = None
            value = value / self._second(self.features.feature(theirs).unit)
            low, high, _ = self.features.limits(theirs)
            # a limit that went through seconds and back may have lost its last digit
            value = min(max(value, value if low is None else low), value if high is None else high)
        self.features.set(theirs, value)

    def snap(self, exposure: float) -> Frame:
        """See :class:`acquisition.contracts.Camera`."""
        if exposure != self._exposure:
            self._actual = float(self.set("exposure", exposure).actual)
            self._exposure = exposure
        failed: AcquisitionError | None = None
        for _ in range(ATTEMPTS):
            try:
                self._start()
                return self._triggered_frame() if self._triggered else self._new_frame()
            except DeviceLost:
                self._lost = True
                raise
            except (FrameLost, DeviceTimeout, ProtocolError) as error:
                failed = error
                self._halt()
        assert failed is not None
        raise failed

    def frames(self, count: int) -> Iterator[Frame]:
        """``count`` frames in a row at the camera's own rate, none missing: a gap in the numbers raises FrameLost.

        The stream is stopped at the end, also if it is left before.
        """
        if self._triggered:
            self._halt()
            self.features.set("TriggerMode", "Off")
        try:
            self._actual = self.get("exposure")
            self._start()
            for _ in range(count):
                yield self._frame()
        except DeviceLost:
            self._lost = True
            raise
        finally:
            self._exposure = None
            if not self._lost:
                with contextlib.suppress(AcquisitionError):
                    self._halt()
                    if self._triggered:
                        self.features.set("TriggerMode", "On")

    def _triggered_frame(self) -> Frame:
        # an acknowledgement that is lost says nothing: whether the camera was triggered, its frame tells
        with contextlib.suppress(DeviceTimeout, ProtocolError):
            self._once("TriggerSoftware")
        return self._frame()

    def _once(self, name: str) -> None:
        """Execute a command that must not be repeated."""
        careful = self.features.port
        self.features.port = _Once(self.control)
        try:
            self.features.execute(name)
        finally:
            self.features.port = careful

    def _new_frame(self) -> Frame:
        """The first frame of the free run that began after now."""
        now = self._clock()
        for past in range(OLD):
            frame = self._frame()
            if frame.time >= now if now is not None else past >= 2:
                return frame
        raise FrameLost(f"{self._port.name}: {OLD} frames in a row began before they were asked for.")

    def _clock(self) -> float | None:
        """Seconds of the camera's clock, None where it has none that can be read."""
        try:
            self.control.write(0x1F8, (1).to_bytes(4, "little"))
            return self.control.number(0x1F0, 8) * 1e-9
        except DeviceRefused:
            return None

    def _start(self) -> None:
        """Sizes agreed on, stream open, camera acquiring."""
        if self._streaming:
            return
        form, (rows, columns) = self._format, self.shape
        expected = rows * columns * form.dtype.itemsize
        info, payload = self.control.number(self._sirm, 4), self.control.number(self._sirm + u3v.SIRM["payload"], 8)
        if not 0 < expected <= payload <= min(2 * expected + (1 << 20), u3v.LARGEST_PAYLOAD):
            raise ProtocolError(f"{self._port.name} states a payload of {payload} bytes for frames of {expected}.")
        alignment = 1 << min(info >> 24, 16)
        step = max(alignment, self._packet)
        ends = [self.control.number(self._sirm + u3v.SIRM[name], 4) for name in ("leader", "trailer")]
        if not all(0 < end <= 1 << 16 for end in ends):
            raise ProtocolError(f"{self._port.name} states leaders and trailers of {ends} bytes.")
        ends = [-(-end // step) * step for end in ends]
        whole = LONGEST_TRANSFER // step * step
        count, left = divmod(payload, whole)
        last = -(-left // step) * step
        for name, value in (("max_leader", ends[0]), ("transfer", whole), ("count", count), ("final1", last),
                            ("final2", 0), ("max_trailer", ends[1])):  # fmt: skip
            self.control.write(self._sirm + u3v.SIRM[name], value.to_bytes(4, "little"))
        self._ends = [array.array("B", bytes(end)) for end in ends]
        self._parts = [array.array("B", bytes(n)) for n in {whole: whole if count else 0, last: last} if n]
        self._plan = [whole] * count + ([last] if last else [])
        self._payload, self._size, self._pixels = payload, (rows, columns), form
        self._port.halt(self._stream)
        self._port.clear_halt(self._stream)
        self.control.write(self._sirm + u3v.SIRM["control"], (1).to_bytes(4, "little"))
        self._lock(1)
        self.features.execute("AcquisitionStart")
        self._streaming, self._block = True, None

    def _halt(self) -> None:
        """Camera idle, stream closed, whatever was under way."""
        self._streaming = False
        with contextlib.suppress(SettingError):
            self.features.execute("AcquisitionStop")
        self.control.write(self._sirm + u3v.SIRM["control"], bytes(4))
        self._lock(0)

    def _lock(self, value: int) -> None:
        with contextlib.suppress(SettingError):
            if "TLParamsLocked" in self.features:
                self.features.set("TLParamsLocked", value)

    def _frame(self) -> Frame:
        """The next frame of the stream, whole or not at all."""
        deadline = time.monotonic() + self._actual + MARGIN + 2 * self.control.response_time
        first = u3v.leader(self._part(self._ends[0], deadline))
        rows, columns = self._size
        row = columns * self._pixels.dtype.itemsize + first.padding
        if (first.height, first.width, first.format) != (rows, columns, self._pixels.code):
            raise FrameLost(f"a frame of {first.height} x {first.width} in format {first.format:#010x} where "
                            f"{rows} x {columns} in {self._pixels.name} was agreed on.")  # fmt: skip
        if rows * row > self._payload:
            raise FrameLost(f"rows of {row} bytes do not fit into the payload of {self._payload}.")
        pixels = np.empty(self._payload, np.uint8)
        filled = 0
        for size in self._plan:
            buffer = next(b for b in self._parts if len(b) == size)
            part = self._part(buffer, deadline)
            if filled + len(part) > self._payload:
                raise FrameLost(f"more than the agreed {self._payload} bytes of payload came.")
            pixels[filled : filled + len(part)] = part
            filled += len(part)
            if len(part) < size:
                break
        last = u3v.trailer(self._part(self._ends[1], deadline))
        if last.status:
            raise FrameLost(f"the camera discarded frame {last.block} (status {last.status:#06x}).")
        if last.block != first.block or last.payload != filled or last.height != rows or filled < rows * row:
            raise FrameLost(
                f"frame {first.block} ends as {last.block} with {last.payload} bytes of which {filled} came."
            )
        expected, self._block = self._block, first.block
        if expected is not None and first.block != expected + 1:
            raise FrameLost(f"frame {first.block} came after frame {expected}: those between are lost.")
        return Frame(self._image(pixels, row), first.block, first.time * 1e-9, self._actual)

    def _image(self, pixels: np.ndarray, row: int) -> np.ndarray:
        rows, columns = self._size
        used = columns * self._pixels.dtype.itemsize
        image = pixels[: rows * row].reshape(rows, row)[:, :used]
        return np.ascontiguousarray(image).view(self._pixels.dtype).reshape(rows, columns)

    def _part(self, buffer: array.array, deadline: float) -> memoryview:
        left = deadline - time.monotonic()
        if left <= 0:
            raise DeviceTimeout(f"{self._port.name}: no whole frame in time.")
        try:
            return memoryview(buffer)[: self._port.read_into(self._stream, buffer, left)]
        except DeviceStalled:
            self._port.clear_halt(self._stream)
            raise

    def close(self) -> None:
        """See :class:`acquisition.contracts.Device`."""
        if self._closed:
            return
        self._closed = True
        if hasattr(self, "features") and not self._lost:
            # a device that is gone cannot be stopped, and says so with an error that would hide the first
            with contextlib.suppress(AcquisitionError):
                self._halt()
        self._port.close()


class _Once:
    """Registers for a command that is sent once, whether or not it is acknowledged."""

    def __init__(self, control: Control) -> None:
        self.control = control

    def read(self, address: int, count: int) -> bytes:
        """See :meth:`Control.read`."""
        return self.control.read(address, count)

    def write(self, address: int, data: bytes) -> None:
        """See :meth:`Control.write`."""
        self.control.write(address, data, repeat=False)
