"""A USB device without a wire: descriptors, and answers to transfers. Adapters put it behind a transport.

In: what a host would send. Out: what the device would. Called by the in-process backend, the umockdev server, and the
USB/IP server, which know nothing of what the device is.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable

__all__ = ["Gone", "NoData", "Overflow", "Stall", "UsbModel", "configuration", "endpoint", "interface"]


class Stall(Exception):
    """The endpoint halts."""


class NoData(Exception):
    """The device has nothing to say now: the host's transfer runs into its timeout."""


class Overflow(Exception):
    """The device sends more than the host has asked for."""


class Gone(Exception):
    """The device has been unplugged."""


def endpoint(address: int, size: int, companion: bool = True) -> bytes:
    """A bulk endpoint's descriptor, with the companion that SuperSpeed asks for."""
    one = struct.pack("<BBBBHB", 7, 5, address, 2, size, 0)
    return one + (struct.pack("<BBBBH", 6, 0x30, 0, 0, 0) if companion else b"")


def interface(number: int, kind: tuple[int, int, int], endpoints: Iterable[bytes] = (), extra: bytes = b"") -> bytes:
    """An interface's descriptor with class, subclass and protocol, what belongs to it, and its endpoints."""
    parts = list(endpoints)
    return struct.pack("<BBBBBBBBB", 9, 4, number, 0, len(parts), *kind, 0) + extra + b"".join(parts)


def configuration(interfaces: int, body: bytes) -> bytes:
    """A configuration's descriptor around everything in it."""
    return struct.pack("<BBHBBBBB", 9, 2, 9 + len(body), interfaces, 1, 0, 0x80, 50) + body


class UsbModel(ABC):
    """Vendor, product, strings and configuration, and what the endpoints do.

    strings: manufacturer, product, serial number, then any others; their indices are 1, 2, 3, ... speed: "super" or
    "high". plugged: whether the device is there; a transfer to one that is not raises :class:`Gone`.
    """

    vendor: int
    product: int
    kind: tuple[int, int, int] = (0, 0, 0)
    speed: str = "high"

    def __init__(self, strings: tuple[str, ...], configuration: bytes) -> None:
        self.strings = strings
        self.configuration = configuration
        self.plugged = True
        self.halted: set[int] = set()
        self.watcher: Callable[[str, bytes], None] | None = None

    @property
    def descriptor(self) -> bytes:
        """The device descriptor, 18 bytes."""
        version, packet = (0x0300, 9) if self.speed == "super" else (0x0200, 64)
        return struct.pack("<BBHBBBBHHHBBBB", 18, 1, version, *self.kind, packet, self.vendor, self.product, 0x0100,
                           1, 2, 3, 1)  # fmt: skip

    def control(self, request_type: int, request: int, value: int, index: int, data: bytes, length: int) -> bytes:
        """A control transfer: ``data`` goes out, or at most ``length`` bytes come back."""
        self._check()
        if request_type == 0x80 and request == 6:
            return self._descriptor_of(value)[:length]
        if request_type == 0x02 and request == 1 and value == 0:
            self.clear_halt(index & 0xFF)
            return b""
        if request_type == 0x02 and request == 3 and value == 0:  # SET_FEATURE(ENDPOINT_HALT)
            self.halted.add(index & 0xFF)
            return b""
        if request_type in (0x00, 0x01) and request in (1, 3, 5, 9, 11, 0x30, 0x31):
            return b""
        if request_type == 0x80 and request == 8:
            return b"\x01"
        if request_type in (0x80, 0x81, 0x82) and request == 0:
            return b"\0\0"
        return self.request(request_type, request, value, index, data)[:length]

    def request(self, request_type: int, request: int, value: int, index: int, data: bytes) -> bytes:
        """A class or vendor request."""
        raise Stall

    def out(self, address: int, data: bytes) -> None:
        """A bulk or interrupt transfer to the device."""
        self._check(address)
        self.received(address, data)

    def read(self, address: int, length: int) -> bytes:
        """A bulk or interrupt transfer from the device."""
        self._check(address)
        return self.answer(address, length)

    def read_into(self, address: int, buffer: memoryview) -> int:
        """As :meth:`read`, without a copy where the device can; the number of bytes."""
        data = self.read(address, len(buffer))
        buffer[: len(data)] = data
        return len(data)

    @abstractmethod
    def received(self, address: int, data: bytes) -> None:
        """What the device does with data."""

    @abstractmethod
    def answer(self, address: int, length: int) -> bytes:
        """What the device says; raises NoData, Stall or Overflow."""

    def clear_halt(self, address: int) -> None:
        """The host has cleared an endpoint."""
        self._check()
        self.halted.discard(address)

    def reset(self) -> None:
        """The host has reset the device."""
        self._check()
        self.halted.clear()

    def _check(self, address: int | None = None) -> None:
        if not self.plugged:
            raise Gone
        if address in self.halted:
            raise Stall

    def _descriptor_of(self, value: int) -> bytes:
        kind, index = value >> 8, value & 0xFF
        if kind == 1:
            return self.descriptor
        if kind == 2 and index == 0:
            return self.configuration
        if kind == 3 and index == 0:
            return struct.pack("<BBH", 4, 3, 0x0409)
        if kind == 3 and index <= len(self.strings):
            text = self.strings[index - 1].encode("utf-16-le")
            return struct.pack("<BB", len(text) + 2, 3) + text
        if kind == 15 and self.speed == "super":
            return (struct.pack("<BBHB", 5, 15, 22, 2) + struct.pack("<BBBI", 7, 16, 2, 2)
                    + struct.pack("<BBBBHBBH", 10, 16, 3, 0, 0x0E, 3, 10, 0x7FF))  # fmt: skip
        raise Stall
