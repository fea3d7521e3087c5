"""Device models behind pyusb itself, in this process: every line of the drivers runs, libusb does not.

In: models. Out: a backend for ``usb.core.find(backend=...)`` and every ``open(serial, backend=...)``. Called by tests,
by the simulated bench, and by whoever tries a program before the device has come.
"""

from __future__ import annotations

import array
import errno
import struct
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

from acquisition.twins.model import Gone, NoData, Overflow, Stall, UsbModel

__all__ = ["TwinBackend"]


def _structure(raw: bytes, layout: str, names: str) -> SimpleNamespace:
    return SimpleNamespace(
        **dict(zip(names.split(), struct.unpack_from(layout, raw), strict=True)), extra_descriptors=[]
    )


def _pieces(raw: bytes) -> Iterator[bytes]:
    """Descriptors one after the other."""
    place = 0
    while place + 2 <= len(raw) and raw[place] >= 2:
        yield raw[place : place + raw[place]]
        place += raw[place]


class TwinBackend(usb.backend.IBackend):
    """A bus with ``models`` on it; plug and unplug by their ``plugged``. Timeouts do not wait: a model that has nothing
    to say now has nothing to say later."""

    def __init__(self, *models: UsbModel) -> None:
        self.models = list(models)

    def enumerate_devices(self) -> Iterator[UsbModel]:
        return (model for model in self.models if model.plugged)

    def get_device_descriptor(self, dev: UsbModel) -> Any:
        found = _structure(dev.descriptor, "<BBHBBBBHHHBBBB",
                           "bLength bDescriptorType bcdUSB bDeviceClass bDeviceSubClass bDeviceProtocol "
                           "bMaxPacketSize0 idVendor idProduct bcdDevice iManufacturer iProduct iSerialNumber "
                           "bNumConfigurations")  # fmt: skip
        found.address, found.bus, found.port_number = 1 + self.models.index(dev), 1, 1
        found.port_numbers, found.speed = (1,), None
        return found

    def get_configuration_descriptor(self, dev: UsbModel, config: int) -> Any:
        if config != 0:
            raise IndexError(f"configuration {config}")
        return _structure(dev.configuration, "<BBHBBBBB", "bLength bDescriptorType wTotalLength bNumInterfaces "
                          "bConfigurationValue iConfiguration bmAttributes bMaxPower")  # fmt: skip

    def get_interface_descriptor(self, dev: UsbModel, intf: int, alt: int, config: int) -> Any:
        return self._interface(dev, intf, alt)[0]

    def get_endpoint_descriptor(self, dev: UsbModel, ep: int, intf: int, alt: int, config: int) -> Any:
        return self._interface(dev, intf, alt)[1][ep]

    def _interface(self, dev: UsbModel, intf: int, alt: int) -> tuple[Any, list[Any]]:
        found: list[tuple[Any, list[Any]]] = []
        for piece in _pieces(dev.configuration[9:]):
            if piece[1] == 4:
                names = ("bLength bDescriptorType bInterfaceNumber bAlternateSetting bNumEndpoints bInterfaceClass "
                         "bInterfaceSubClass bInterfaceProtocol iInterface")  # fmt: skip
                found.append((_structure(piece, "<BBBBBBBBB", names), []))
            elif piece[1] == 5 and found:
                names = "bLength bDescriptorType bEndpointAddress bmAttributes wMaxPacketSize bInterval"
                one = _structure(piece, "<BBBBHB", names)
                one.bRefresh = one.bSynchAddress = 0
                found[-1][1].append(one)
        if alt != 0 or intf >= len(found):
            raise IndexError(f"interface {intf}, alternate {alt}")
        return found[intf]

    def open_device(self, dev: UsbModel) -> UsbModel:
        if not dev.plugged:
            raise _error(errno.ENODEV)
        return dev

    def close_device(self, dev_handle: UsbModel) -> None:
        pass

    def set_configuration(self, dev_handle: UsbModel, config_value: int) -> None:
        self._there(dev_handle)

    def get_configuration(self, dev_handle: UsbModel) -> int:
        self._there(dev_handle)
        return 1

    def set_interface_altsetting(self, dev_handle: UsbModel, intf: int, altsetting: int) -> None:
        self._there(dev_handle)

    def claim_interface(self, dev_handle: UsbModel, intf: int) -> None:
        self._there(dev_handle)

    def release_interface(self, dev_handle: UsbModel, intf: int) -> None:
        self._there(dev_handle)

    def is_kernel_driver_active(self, dev_handle: UsbModel, intf: int) -> bool:
        self._there(dev_handle)
        return False

    def bulk_write(self, dev_handle: UsbModel, ep: int, intf: int, data: Any, timeout: int) -> int:
        with _errors():
            dev_handle.out(ep, bytes(data))
        return len(data)

    def bulk_read(self, dev_handle: UsbModel, ep: int, intf: int, buff: array.array, timeout: int) -> int:
        with _errors():
            return dev_handle.read_into(ep, memoryview(buff))

    intr_write, intr_read = bulk_write, bulk_read

    def ctrl_transfer(
        self, dev_handle: UsbModel, bmRequestType: int, bRequest: int, wValue: int, wIndex: int, data: Any, timeout: int
    ) -> int:
        with _errors():
            if bmRequestType & 0x80:
                found = dev_handle.control(bmRequestType, bRequest, wValue, wIndex, b"", len(data))
                memoryview(data)[: len(found)] = found
                return len(found)
            dev_handle.control(bmRequestType, bRequest, wValue, wIndex, bytes(data), 0)
            return len(data)

    def clear_halt(self, dev_handle: UsbModel, ep: int) -> None:
        with _errors():
            dev_handle.clear_halt(ep)

    def reset_device(self, dev_handle: UsbModel) -> None:
        with _errors():
            dev_handle.reset()

    @staticmethod
    def _there(model: UsbModel) -> None:
        if not model.plugged:
            raise _error(errno.ENODEV)


def _error(number: int) -> usb.core.USBError:
    kind = usb.core.USBTimeoutError if number == errno.ETIMEDOUT else usb.core.USBError
    return kind(errno.errorcode[number], None, number)


class _errors:
    """What a model raises, as the USB library would."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        number = {Stall: errno.EPIPE, NoData: errno.ETIMEDOUT, Overflow: errno.EOVERFLOW, Gone: errno.ENODEV}
        if kind in number:
            raise _error(number[kind]) from error
