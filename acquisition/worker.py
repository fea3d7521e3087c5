"""A device in a process of its own, which is replaced when the device is lost or its driver hangs.

In: how to open a device. Out: a device that answers as the original does. Called by benches that must outlive a cable.

A USB library that meets a device which is gone may crash or hang its process, and does not see the device again when it
is back. So the driver runs in a worker: what is asked of it goes there as JSON, and what comes back is JSON and the
pixels of frames as plain bytes; nothing is unpickled. A worker that does not answer in time is killed.
"""

from __future__ import annotations

import atexit
import importlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Self

import numpy as np

from acquisition import errors
from acquisition.contracts import Camera, Device, Frame, Instrument
from acquisition.errors import AcquisitionError, DeviceLost, DeviceTimeout, ProtocolError
from acquisition.settings import Setting, Written

__all__ = ["WorkerCamera", "WorkerInstrument"]

LARGEST = 1 << 29  # bytes of one answer
OPENING = 30.0  # seconds, with the interpreter's start
MARGIN = 20.0


class _Process:
    """A worker and the pipe to it. ``opener``: "module:Class" with a class method open(serial)."""

    def __init__(self, opener: str, serial: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "acquisition.worker", opener, serial], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        atexit.register(self.kill)
        self.ask({"call": "describe"}, OPENING)

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def ask(self, request: dict[str, Any], seconds: float) -> tuple[Any, bytes]:
        """What the worker answers; its own errors are raised here."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
            self._process.stdin.flush()
            size, raw_size = (int(n) for n in self._exactly(24, seconds).decode().split())
            if not 0 <= size <= LARGEST or not 0 <= raw_size <= LARGEST:
                raise ProtocolError(f"a worker states an answer of {size} + {raw_size} bytes.")
            answer = json.loads(self._exactly(size, seconds))
            raw = self._exactly(raw_size, seconds)
        except (OSError, ValueError) as error:
            self.kill()
            raise DeviceLost(
                f"the device's process has ended ({error}); it is opened again by the next call."
            ) from error
        except AcquisitionError:
            self.kill()
            raise
        if "error" in answer:
            raise _raised(answer["error"], answer["text"], answer.get("status", 0))
        return answer["value"], raw

    def _exactly(self, count: int, seconds: float) -> bytes:
        import select

        assert self._process.stdout is not None
        pipe, found, deadline = self._process.stdout.fileno(), bytearray(), time.monotonic() + seconds
        while len(found) < count:
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([pipe], [], [], left)[0]:
                raise DeviceTimeout(f"the device's process has not answered for {seconds:.0f} s; it has been ended.")
            part = os.read(pipe, min(count - len(found), 1 << 20))
            if not part:
                raise OSError("no answer")
            found += part
        return bytes(found)

    def kill(self) -> None:
        """End it, whatever it does."""
        atexit.unregister(self.kill)
        if self.alive:
            self._process.send_signal(signal.SIGKILL)
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                try:
                    pipe.close()
                except OSError:
                    continue

    def close(self) -> None:
        """Ask it to close the device and to end; kill it if it does not."""
        try:
            self.ask({"call": "close"}, 5.0)
            self._process.wait(5.0)
        except (AcquisitionError, subprocess.TimeoutExpired):
            pass
        self.kill()


def _raised(name: str, text: str, status: int) -> Exception:
    kind = getattr(errors, name, AcquisitionError)
    if not (isinstance(kind, type) and issubclass(kind, AcquisitionError)):
        kind = AcquisitionError
    return kind(text, status) if kind is errors.DeviceRefused else kind(text)


class _Worker(Device):
    """A device in another process. After a loss the next call opens it again in a new one, and writes all settings
    that were written before."""

    def __init__(self, opener: str, serial: str) -> None:
        self._opener, self._serial, self._closed = opener, serial, False
        self._written: dict[str, Any] = {}
        self._process: _Process | None = _Process(opener, serial)

    @classmethod
    def open(cls, opener: str, serial: str) -> Self:
        """``opener``: module and class of the driver, "acquisition.usb.camera:Usb3VisionCamera"; serial number.

        Raises what the driver's own ``open`` raises.
        """
        return cls(opener, serial)

    def _ask(self, call: str, seconds: float = MARGIN, **more: Any) -> tuple[Any, bytes]:
        if self._closed:
            raise DeviceLost("this device has been closed; open another.")
        if self._process is None or not self._process.alive:
            self._process = _Process(self._opener, self._serial)
            for name, value in self._written.items():
                self._process.ask({"call": "set", "name": name, "value": value}, MARGIN)
        try:
            return self._process.ask({"call": call, **more}, seconds)
        except DeviceLost:
            # what the library knows of a device that is gone dies with its process
            self._process.kill()
            raise

    @property
    def serial(self) -> str:
        """See :class:`acquisition.contracts.Device`."""
        return self._serial

    def describe(self) -> dict[str, Any]:
        """See :class:`acquisition.contracts.Device`."""
        return dict(self._ask("describe")[0])

    @property
    def settings(self) -> Mapping[str, Setting]:
        """See :class:`acquisition.contracts.Device`."""
        found = self._ask("settings")[0]
        return {name: Setting(**(one | {"choices": tuple(one["choices"])})) for name, one in found.items()}

    def get(self, name: str) -> Any:
        """See :class:`acquisition.contracts.Device`."""
        return self._ask("get", name=name)[0]

    def set(self, name: str, value: Any = None) -> Written:
        """See :class:`acquisition.contracts.Device`."""
        if isinstance(value, np.generic):
            value = value.item()
        written = Written(**self._ask("set", name=name, value=value)[0])
        self._written[name] = written.requested
        return written

    def _read(self, setting: Setting) -> Any:
        return self.get(setting.name)

    def _write(self, setting: Setting, value: Any) -> None:
        self.set(setting.name, value)

    def make_safe(self) -> None:
        """See :class:`acquisition.contracts.Device`."""
        if not self._closed:
            self._ask("make_safe")

    def close(self) -> None:
        """See :class:`acquisition.contracts.Device`."""
        if not self._closed:
            self._closed = True
            if self._process is not None:
                self._process.close()


class WorkerInstrument(_Worker, Instrument):
    """An instrument in a process of its own: ``WorkerInstrument.open("acquisition.usb.instrument:RotationMount",
    serial)``."""


class WorkerCamera(_Worker, Camera):
    """A camera in a process of its own: ``WorkerCamera.open("acquisition.usb.camera:Usb3VisionCamera", serial)``.

    A camera that is lost in an exposure raises DeviceLost; the next call finds it again once it is back.
    """

    @property
    def shape(self) -> tuple[int, int]:
        """See :class:`acquisition.contracts.Camera`."""
        rows, columns = self._ask("shape")[0]
        return int(rows), int(columns)

    @property
    def full_scale(self) -> int:
        """See :class:`acquisition.contracts.Camera`."""
        return int(self._ask("full_scale")[0])

    def snap(self, exposure: float) -> Frame:
        """See :class:`acquisition.contracts.Camera`."""
        if isinstance(exposure, np.generic):
            exposure = exposure.item()
        known = isinstance(exposure, int | float) and 0 < exposure < 1e4
        about, raw = self._ask("snap", seconds=MARGIN + (3 * exposure if known else 0), exposure=exposure)
        dtype, shape = np.dtype(about["dtype"]), tuple(int(n) for n in about["shape"])
        if dtype.kind != "u" or len(shape) != 2 or len(raw) != dtype.itemsize * shape[0] * shape[1]:
            raise ProtocolError(f"a worker gave {len(raw)} bytes for a frame {shape} of {dtype}.")
        return Frame(
            np.frombuffer(bytearray(raw), dtype).reshape(shape), about["block"], about["time"], about["exposure"]
        )


def _served(device: Any, request: dict[str, Any]) -> tuple[Any, bytes]:
    call = request["call"]
    if call == "snap":
        frame = device.snap(request["exposure"])
        counts = np.ascontiguousarray(frame.counts)
        about = {"dtype": counts.dtype.str, "shape": list(counts.shape), "block": frame.block, "time": frame.time,
                 "exposure": frame.exposure}  # fmt: skip
        return about, counts.tobytes()
    if call == "settings":
        return {name: asdict(setting) for name, setting in device.settings.items()}, b""
    if call == "get":
        return device.get(request["name"]), b""
    if call == "set":
        return asdict(device.set(request["name"], request["value"])), b""
    if call in ("shape", "full_scale"):
        return getattr(device, call), b""
    if call in ("describe", "make_safe", "close"):
        return getattr(device, call)(), b""
    raise ProtocolError(f"a worker does not know {call!r}.")


def main() -> None:
    """The worker: opens a device, then answers requests, a line each, until its input ends."""
    opener, serial = sys.argv[1:3]
    module, name = opener.split(":")
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # nothing that a library prints may come between the answers
    device: Any = None
    try:
        for line in sys.stdin.buffer:
            raw = b""
            try:
                if device is None:
                    device = getattr(importlib.import_module(module), name).open(serial)
                value, raw = _served(device, json.loads(line))
                answer = {"value": value}
            except AcquisitionError as error:
                text = "\n".join([str(error), *getattr(error, "__notes__", [])])
                answer = {"error": type(error).__name__, "text": text, "status": getattr(error, "status", 0)}
                raw = b""
            body = json.dumps(answer).encode()
            out.write(f"{len(body):11d} {len(raw):11d} ".encode() + body + raw)
            out.flush()
            if json.loads(line)["call"] == "close":
                break
    finally:
        # the pipe has ended: whoever asked is gone, and the light must not stay on
        if device is not None:
            try:
                device.make_safe()
            finally:
                device.close()


if __name__ == "__main__":
    main()
