"""Device models as USB/IP devices: plugged into a kernel's virtual host controller, they are enumerated like real ones.

In: a model. Out: a device in the kernel of this (guest) machine. Called by ``benchmarks/kernel_guest.py``; needs root
and the modules usbip-core and vhci-hcd.

Source: the kernel's Documentation/usb/usbip_protocol.rst.
"""

from __future__ import annotations

import errno
import select
import socket
import struct
import threading
import time
from collections import deque
from pathlib import Path

from acquisition.twins.model import Gone, NoData, Overflow, Stall, UsbModel

__all__ = ["Plugged"]

CONTROLLER = Path("/sys/devices/platform/vhci_hcd.0")
SUBMIT, UNLINK, RET_SUBMIT, RET_UNLINK = 1, 2, 3, 4
HEAD = struct.Struct(">IIIII")
SPEEDS = {"super": (5, "ss"), "high": (3, "hs")}
IDLE = 0.002  # seconds between questions to a model that has nothing to say


class Plugged:
    """``model`` in a port of the virtual controller, until it is unplugged."""

    def __init__(self, model: UsbModel) -> None:
        self.model = model
        ours, theirs = socket.socketpair()
        number, hub = SPEEDS[model.speed]
        self.port = self._free(hub)
        (CONTROLLER / "attach").write_text(f"{self.port} {theirs.fileno()} 5 {number}")
        theirs.close()  # the kernel has it now
        self._socket = ours
        self._waiting: dict[int, deque[tuple[int, int]]] = {}
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    @staticmethod
    def _free(hub: str) -> int:
        for line in (CONTROLLER / "status").read_text().splitlines()[1:]:
            kind, port, state, *_ = line.split()
            if kind == hub and int(state) == 4:
                return int(port)
        raise OSError(errno.EBUSY, "no port of the virtual controller is free")

    def unplug(self) -> None:
        """As pulling the cable."""
        self.model.plugged = False
        (CONTROLLER / "detach").write_text(str(self.port))
        self._socket.close()
        self._thread.join(5.0)

    def _exactly(self, count: int) -> bytes:
        found = bytearray()
        while len(found) < count:
            part = self._socket.recv(count - len(found))
            if not part:
                raise EOFError
            found += part
        return bytes(found)

    def _serve(self) -> None:
        try:
            while self.model.plugged:
                waiting = any(self._waiting.values())
                if select.select([self._socket], [], [], IDLE if waiting else 0.5)[0]:
                    self._take()
                self._answer_waiting()
        except (EOFError, OSError, ValueError):
            return

    def _take(self) -> None:
        command, number, _, direction, end = HEAD.unpack(self._exactly(HEAD.size))
        rest = self._exactly(28)
        if command == UNLINK:
            self._unlink(number, struct.unpack_from(">I", rest)[0])
            return
        if command != SUBMIT:
            raise EOFError
        length = struct.unpack_from(">i", rest, 4)[0]
        data = self._exactly(length) if direction == 0 and length > 0 else b""
        if end == 0:
            self._control(number, rest[20:28], data, direction)
        elif direction == 0:
            status = self._status(lambda: self.model.out(end, data))
            self._return(number, status, length if status == 0 else 0)
        else:
            self._waiting.setdefault(end | 0x80, deque()).append((number, length))

    def _control(self, number: int, setup: bytes, data: bytes, direction: int) -> None:
        request_type, request, value, index, count = struct.unpack("<BBHHH", setup)
        found = b""

        def act() -> None:
            nonlocal found
            found = self.model.control(request_type, request, value, index, data, count)

        status = self._status(act)
        self._return(number, status, len(found) if direction else len(data), found if direction else b"")

    @staticmethod
    def _status(action: object) -> int:
        try:
            action()  # type: ignore[operator]
        except Stall:
            return -errno.EPIPE
        except Overflow:
            return -errno.EOVERFLOW
        except (Gone, NoData):
            return -errno.ENODEV
        return 0

    def _answer_waiting(self) -> None:
        for end, queue in self._waiting.items():
            while queue:
                number, length = queue[0]
                try:
                    data, status = bytes(self.model.read(end, length)), 0
                except NoData:
                    break
                except Stall:
                    data, status = b"", -errno.EPIPE
                except Overflow:
                    data, status = b"", -errno.EOVERFLOW
                except Gone:
                    return
                queue.popleft()
                self._return(number, status, len(data), data)

    def _unlink(self, number: int, which: int) -> None:
        status = 0
        for queue in self._waiting.values():
            for one in list(queue):
                if one[0] == which:
                    queue.remove(one)
                    status = -errno.ECONNRESET
        self._socket.sendall(HEAD.pack(RET_UNLINK, number, 0, 0, 0) + struct.pack(">i24x", status))

    def _return(self, number: int, status: int, actual: int, data: bytes = b"") -> None:
        head = HEAD.pack(RET_SUBMIT, number, 0, 0, 0) + struct.pack(">iiiii8x", status, actual, 0, 0, 0)
        self._socket.sendall(head + data)


def wait_for(seen: object, seconds: float) -> bool:
    """Until ``seen()`` is true; whether it became so in time."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if seen():  # type: ignore[operator]
            return True
        time.sleep(0.1)
    return False
