"""Which devices are connected, and which of them this user may open.

In: nothing. Out: a list, and the udev rule where one is missing. Called by users, the drivers and ``polinfer devices``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import usb.backend
import usb.core

from acquisition.errors import AcquisitionError, DeviceAbsent, DeviceBusy, DeviceForbidden
from acquisition.usb.port import translated

__all__ = ["RULE", "Found", "find", "list_devices", "serial_of"]

RULE = """\
# /etc/udev/rules.d/70-polinfer.rules: cameras, instruments and modulators for whoever sits at the machine, and for the
# group plugdev where nobody does. Then: udevadm control --reload && udevadm trigger
SUBSYSTEM=="usb", ENV{ID_USB_INTERFACES}=="*:ef0500:*", TAG+="uaccess", GROUP="plugdev", MODE="0660"
SUBSYSTEM=="usb", ENV{ID_USB_INTERFACES}=="*:fe03*", TAG+="uaccess", GROUP="plugdev", MODE="0660"
SUBSYSTEM=="usb", ATTRS{idVendor}=="0451", ATTRS{idProduct}=="c900", TAG+="uaccess", GROUP="plugdev", MODE="0660"
"""
DLPC900 = (0x0451, 0xC900)


@dataclass(frozen=True)
class Found:
    """A device. kind: "camera", "instrument" or "modulator". serial: "" where it could not be read. problem: "" if it
    can be opened, else why not and what to do."""

    kind: str
    serial: str
    vendor: int
    product: int
    name: str
    problem: str


def list_devices(backend: Any = None) -> list[Found]:
    """All devices that this package has a driver for; ``backend``: a pyusb backend, None for libusb.

    One that is there but may not be opened is listed too, with its ``problem``; the rule that mends it is
    ``acquisition.usb.discovery.RULE``. Raises AcquisitionError where there is no libusb.
    """
    found = []
    for device in _all(backend):
        kind = _kind(device)
        if kind is None:
            continue
        serial, name, problem = "", "", ""
        try:
            serial, name = serial_of(device), _text(device, "product")
        except DeviceForbidden:
            problem = "this user may not open it; install the udev rule (polinfer devices --rule)"
        except AcquisitionError as error:
            problem = str(error)
        found.append(Found(kind, serial, device.idVendor, device.idProduct, name, problem))
    return found


def find(kind: str, serial: str, backend: Any = None) -> Any:
    """The pyusb device of this kind and serial number; DeviceAbsent or DeviceForbidden with what to do."""
    if not isinstance(serial, str) or not serial:
        raise DeviceAbsent(
            f"serial must be the serial number of a {kind}, got {serial!r}; polinfer devices lists them."
        )
    seen, forbidden, gone = [], 0, None
    for device in _all(backend):
        if _kind(device) != kind:
            continue
        try:
            one = serial_of(device)
        except DeviceForbidden:
            forbidden += 1
            continue
        except AcquisitionError as error:
            gone = error
            continue
        if one == serial:
            return device
        seen.append(one)
    if forbidden:
        raise DeviceForbidden(
            f"no {kind} {serial!r} can be seen, but {forbidden} that this user may not open; install this rule:\n{RULE}"
        )
    there = f"; connected are {', '.join(map(repr, seen))}" if seen else f"; no {kind} is connected"
    raise DeviceAbsent(f"no {kind} with serial number {serial!r}{there}.") from gone


def serial_of(device: Any) -> str:
    """The serial number, printable characters only."""
    return _text(device, "serial_number")


def _text(device: Any, name: str) -> str:
    # ValueError, not USBError, on a device that is half gone, and where the strings may not be read
    try:
        with translated("reading the device's strings"):
            text = getattr(device, name)
    except AcquisitionError as error:
        raise _without_strings(device, error) from error
    return "".join(c for c in text or "" if c.isprintable())[:128]


def _without_strings(device: Any, error: AcquisitionError) -> AcquisitionError:
    if isinstance(error, DeviceForbidden | DeviceBusy):
        return error
    try:
        with translated("opening the device"):
            device.is_kernel_driver_active(0)
    except DeviceForbidden as other:
        return other
    except (AcquisitionError, NotImplementedError):
        pass
    return error


def _all(backend: Any) -> list[Any]:
    try:
        with translated("listing devices"):
            return list(usb.core.find(find_all=True, backend=backend))
    except usb.core.NoBackendError as error:
        raise AcquisitionError(
            "no USB library was found; install libusb (Debian: libusb-1.0-0, or pip install libusb-package)."
        ) from error


def _kind(device: Any) -> str | None:
    if (device.idVendor, device.idProduct) == DLPC900:
        return "modulator"
    try:
        kinds = {(i.bInterfaceClass, i.bInterfaceSubClass) for configuration in device for i in configuration}
    except (usb.core.USBError, ValueError, AttributeError, IndexError, TypeError):
        return None
    if (0xEF, 0x05) in kinds:
        return "camera"
    if (0xFE, 0x03) in kinds:
        return "instrument"
    return None
