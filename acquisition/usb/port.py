"""Transfers to one USB device through pyusb, with every length checked and every error one of ours.

In: a pyusb device. Out: bytes. Called by the protocols; nothing above this file imports ``usb``.
"""

from __future__ import annotations

import array
import contextlib
import errno
from collections.abc import Iterator
from typing import Any

import usb.core
import usb.util

from acquisition.errors import (
    AcquisitionError,
    DeviceBusy,
    DeviceForbidden,
    DeviceLost,
    DeviceStalled,
    DeviceTimeout,
    ProtocolError,
)

__all__ = ["LONGEST_TRANSFER", "UsbPort", "translated"]

LONGEST_TRANSFER = 1 << 20  # bytes: usbfs has 16 MB for all devices together

# numbers of libusb where a backend states no errno
_LIBUSB = {-3: errno.EACCES, -4: errno.ENODEV, -6: errno.EBUSY, -7: errno.ETIMEDOUT, -8: errno.EOVERFLOW,
           -9: errno.EPIPE, -11: errno.ENOMEM}  # fmt: skip
_KINDS: dict[int, type[AcquisitionError]] = {
    errno.ENODEV: DeviceLost,
    errno.ENXIO: DeviceLost,
    errno.ESHUTDOWN: DeviceLost,
    errno.EACCES: DeviceForbidden,
    errno.EPERM: DeviceForbidden,
    errno.EBUSY: DeviceBusy,
    errno.ENOMEM: DeviceBusy,
    errno.ETIMEDOUT: DeviceTimeout,
    errno.EPIPE: DeviceStalled,
    errno.EOVERFLOW: ProtocolError,
}
_ADVICE = {
    DeviceLost: "check cable and power, then open it again.",
    DeviceForbidden: "install the udev rule that list_devices prints.",
    DeviceBusy: "close the program that holds it, or allow usbfs more memory.",
    DeviceTimeout: "no answer in time.",
    DeviceStalled: "the endpoint has halted.",
    ProtocolError: "it sent more than was asked for.",
}


@contextlib.contextmanager
def translated(what: str) -> Iterator[None]:
    """Errors of pyusb as ours; ``what`` was being done."""
    try:
        yield
    except usb.core.USBTimeoutError as error:
        raise DeviceTimeout(f"{what}: no answer in time.") from error
    except usb.core.USBError as error:
        number = error.errno or _LIBUSB.get(int(error.backend_error_code or 0), 0)
        kind = _KINDS.get(number, AcquisitionError)
        raise kind(f"{what}: {error}; {_ADVICE.get(kind, 'see the message of the USB library.')}") from error
    except (NotImplementedError, ValueError) as error:
        # a device that is half gone has no strings and no configuration any more
        raise DeviceLost(f"{what}: {error}; {_ADVICE[DeviceLost]}") from error


class UsbPort:
    """A device that is open. Interfaces are claimed, and a kernel driver that held them gets them back at the end."""

    def __init__(self, device: Any, name: str) -> None:
        self.device, self.name = device, name
        self._claimed: list[int] = []
        self._detached: list[int] = []

    def claim(self, number: int) -> None:
        """Take an interface, from the kernel's driver if need be."""
        with translated(f"{self.name}: claiming interface {number}"):
            with contextlib.suppress(NotImplementedError):
                if self.device.is_kernel_driver_active(number):
                    self.device.detach_kernel_driver(number)
                    self._detached.append(number)
            usb.util.claim_interface(self.device, number)
        self._claimed.append(number)

    def write(self, endpoint: int, data: bytes, timeout: float) -> None:
        """All of ``data``, in ``timeout`` seconds."""
        with translated(f"{self.name}: writing {len(data)} bytes"):
            written = self.device.write(endpoint, data, _milliseconds(timeout))
        if written != len(data):
            raise ProtocolError(f"{self.name}: {written} of {len(data)} bytes were written.")

    def read(self, endpoint: int, size: int, timeout: float) -> bytes:
        """At most ``size`` bytes, which must be a multiple of the endpoint's packets."""
        buffer = array.array("B", bytes(size))
        return bytes(memoryview(buffer)[: self.read_into(endpoint, buffer, timeout)])

    def read_into(self, endpoint: int, buffer: array.array, timeout: float) -> int:
        """At most the buffer's size, into it; the number of bytes."""
        with translated(f"{self.name}: reading up to {len(buffer)} bytes"):
            count = self.device.read(endpoint, buffer, _milliseconds(timeout))
        if not 0 <= count <= len(buffer):
            raise ProtocolError(f"{self.name}: {count} bytes came where {len(buffer)} were asked for.")
        return int(count)

    def ask(self, kind: int, request: int, value: int, index: int, count: int, timeout: float) -> bytes:
        """A control transfer to the host: exactly ``count`` bytes."""
        with translated(f"{self.name}: control request {request}"):
            data = bytes(self.device.ctrl_transfer(kind, request, value, index, count, _milliseconds(timeout)))
        if len(data) != count:
            raise ProtocolError(f"{self.name}: control request {request} gave {len(data)} bytes, not {count}.")
        return data

    def tell(self, kind: int, request: int, value: int, index: int, timeout: float) -> None:
        """A control transfer without data."""
        with translated(f"{self.name}: control request {request}"):
            self.device.ctrl_transfer(kind, request, value, index, None, _milliseconds(timeout))

    def clear_halt(self, endpoint: int) -> None:
        """Let a halted endpoint go on."""
        with translated(f"{self.name}: clearing endpoint {endpoint:#x}"):
            self.device.clear_halt(endpoint)

    def halt(self, endpoint: int, timeout: float = 1.0) -> None:
        """Halt an endpoint, as USB3 Vision asks for before a stream begins."""
        self.tell(0x02, 3, 0, endpoint, timeout)

    def close(self) -> None:
        """Give everything back; a device that is gone has nothing to give back to."""
        for number in self._claimed:
            with contextlib.suppress(usb.core.USBError, ValueError):
                usb.util.release_interface(self.device, number)
        for number in self._detached:
            with contextlib.suppress(usb.core.USBError, ValueError, NotImplementedError):
                self.device.attach_kernel_driver(number)
        with contextlib.suppress(usb.core.USBError, ValueError):
            usb.util.dispose_resources(self.device)
        self._claimed, self._detached = [], []


def _milliseconds(timeout: float) -> int:
    """Never 0, which would mean for ever."""
    return max(1, min(int(timeout * 1000), 60_000))
