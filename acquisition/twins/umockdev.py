"""Device models behind the real libusb: foreign programs open them as if they were plugged in. No root, no kernel USB.

In: a model and a program. Out: the program's run, with the device on its bus. Called by the tests, as
``python -m acquisition.twins.umockdev camera -- arv-tool-0.8 control Width``. Needs umockdev, of which the private
protocol between preload library and server is spoken here, as of its version 0.17.
"""

from __future__ import annotations

import errno
import os
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import threading
from collections import deque
from dataclasses import dataclass
from pathlib import Path

from acquisition.twins.camera import CameraTwin
from acquisition.twins.dlpc900 import Dlpc900Twin
from acquisition.twins.instrument import InstrumentTwin
from acquisition.twins.model import Gone, NoData, Overflow, Stall, UsbModel

__all__ = ["UmockdevServer", "command", "description", "main"]

MODELS = {"camera": CameraTwin, "instrument": InstrumentTwin, "modulator": Dlpc900Twin}
NODE = "bus/usb/001/002"
SPEEDS = {"super": "5000", "high": "480"}
# of the preload library: a request from the client, and what the server answers
IOCTL, DONE, READ_MEMORY, WRITE_MEMORY = 1, 3, 5, 6
# of usbdevfs, by the low byte of the request
(CONTROL, BULK, SET_INTERFACE, SET_CONFIGURATION, GET_DRIVER, SUBMIT, DISCARD, REAP, REAP_NOW, CLAIM, RELEASE, KERNEL,
 RESET, CLEAR_HALT, CAPABILITIES, DISCONNECT_CLAIM, SPEED) = (
    0, 2, 4, 5, 8, 10, 11, 12, 13, 15, 16, 18, 20, 21, 26, 27, 31)  # fmt: skip
URB = struct.Struct("<BBxxiIxxxxQiiiiiIQ")
ABILITIES = 0x01 | 0x04 | 0x10  # zero packets, transfers of any size, reaping after a disconnect


def description(model: UsbModel) -> str:
    """The device as umockdev's text of a device tree."""
    descriptors = (model.descriptor + model.configuration).hex().upper()
    root = bytes.fromhex("12010003090003016B1D0300000503020101") + bytes.fromhex(
        "09021F0001010" "0E000" "0904000001090000000705810304000C063000000200")  # fmt: skip
    triple = f"{model.vendor:x}/{model.product:x}/100"
    return f"""P: /devices/pci0000:00/0000:00:14.0/usb1
N: bus/usb/001/001
E: DEVNAME=/dev/bus/usb/001/001
E: DEVTYPE=usb_device
E: SUBSYSTEM=usb
E: MAJOR=189
E: MINOR=0
E: BUSNUM=001
E: DEVNUM=001
A: busnum=1\\n
A: devnum=1\\n
A: speed=5000\\n
A: bConfigurationValue=1\\n
A: idVendor=1d6b\\n
A: idProduct=0003\\n
H: descriptors={root.hex().upper()}

P: /devices/pci0000:00/0000:00:14.0/usb1/1-1
N: {NODE}
E: DEVNAME=/dev/{NODE}
E: DEVTYPE=usb_device
E: SUBSYSTEM=usb
E: MAJOR=189
E: MINOR=1
E: BUSNUM=001
E: DEVNUM=002
E: PRODUCT={triple}
A: busnum=1\\n
A: devnum=2\\n
A: speed={SPEEDS[model.speed]}\\n
A: bConfigurationValue=1\\n
A: bNumConfigurations=1\\n
A: idVendor={model.vendor:04x}\\n
A: idProduct={model.product:04x}\\n
A: manufacturer={model.strings[0]}\\n
A: product={model.strings[1]}\\n
A: serial={model.strings[2]}\\n
H: descriptors={descriptors}
"""


@dataclass
class _Urb:
    """A transfer that the client has submitted: where its structure and buffer are in the client's memory."""

    place: int
    kind: int
    endpoint: int
    buffer: int
    length: int
    setup: bytes = b""
    status: int = 0
    actual: int = 0


class _Client:
    """One file descriptor that a client has opened."""

    def __init__(self, connection: socket.socket, model: UsbModel, lock: threading.Lock) -> None:
        self.connection, self.model, self.lock = connection, model, lock
        self.waiting: dict[int, deque[_Urb]] = {}
        self.finished: deque[_Urb] = deque()

    def serve(self) -> None:
        with self.connection:
            while True:
                try:
                    kind, request, argument = struct.unpack("<QQQ", self._exactly(24))
                except EOFError:
                    return
                if kind != IOCTL:
                    self._send(DONE, (1 << 64) - 1, errno.ENOTTY)
                    continue
                with self.lock:
                    self._answer(request & 0xFF, argument)

    def _answer(self, request: int, argument: int) -> None:
        try:
            result = self._done(request, argument)
            self._send(DONE, result, 0)
        except OSError as error:
            if error.errno is None:
                raise
            self._send(DONE, (1 << 64) - 1, error.errno)

    def _exactly(self, count: int) -> bytes:
        found = bytearray()
        while len(found) < count:
            part = self.connection.recv(count - len(found))
            if not part:
                raise EOFError
            found += part
        return bytes(found)

    def _send(self, *words: int) -> None:
        self.connection.sendall(struct.pack("<QQQ", *words))

    def _read(self, place: int, count: int) -> bytes:
        if count == 0:
            return b""
        self._send(READ_MEMORY, place, count)
        return self._exactly(count)

    def _write(self, place: int, data: bytes) -> None:
        if data:
            self._send(WRITE_MEMORY, place, len(data))
            self.connection.sendall(data)

    def _done(self, request: int, argument: int) -> int:
        if not self.model.plugged and request not in (REAP, REAP_NOW, DISCARD):
            raise OSError(errno.ENODEV, "")
        if request == CAPABILITIES:
            self._write(argument, struct.pack("<I", ABILITIES))
            return 0
        if request in (CLAIM, RELEASE, DISCONNECT_CLAIM, SET_INTERFACE, SET_CONFIGURATION):
            return 0
        if request == GET_DRIVER:
            raise OSError(errno.ENODATA, "")
        if request == SPEED:
            return {"super": 5, "high": 3}[self.model.speed]
        if request == CLEAR_HALT:
            self.model.clear_halt(struct.unpack("<I", self._read(argument, 4))[0])
            return 0
        if request == RESET:
            self.model.reset()
            return 0
        if request == SUBMIT:
            return self._submit(argument)
        if request == DISCARD:
            return self._discard(argument)
        if request in (REAP, REAP_NOW):
            return self._reap(argument)
        raise OSError(errno.ENOTTY, "")

    def _submit(self, place: int) -> int:
        kind, end, _, _, buffer, length, *_ = URB.unpack(self._read(place, URB.size))
        one = _Urb(place, kind, end, buffer, length)
        if kind == 2:  # control: eight bytes of set-up before the data
            one.setup = self._read(buffer, 8)
            self._control(one)
            self.finished.append(one)
        elif end & 0x80:
            self.waiting.setdefault(end, deque()).append(one)
        else:
            data = self._read(buffer, length)
            one.status = self._tried(lambda: self.model.out(end, data))
            one.actual = length if one.status == 0 else 0
            self.finished.append(one)
        return 0

    def _control(self, one: _Urb) -> None:
        request_type, request, value, index, count = struct.unpack("<BBHHH", one.setup)
        data = b"" if request_type & 0x80 else self._read(one.buffer + 8, count)
        answer = b""

        def act() -> None:
            nonlocal answer
            answer = self.model.control(request_type, request, value, index, data, count)

        one.status = self._tried(act)
        if one.status == 0 and request_type & 0x80:
            self._write(one.buffer + 8, answer)
            one.actual = len(answer)
        elif one.status == 0:
            one.actual = count

    @staticmethod
    def _tried(action: object) -> int:
        try:
            action()  # type: ignore[operator]
        except Stall:
            return -errno.EPIPE
        except Overflow:
            return -errno.EOVERFLOW
        except Gone:
            return -errno.ENODEV
        return 0

    def _serve_waiting(self) -> None:
        """Transfers to the host, in their order, as far as the model has something to say."""
        for end, queue in self.waiting.items():
            while queue:
                one = queue[0]
                data = b""

                def act(end: int = end, one: _Urb = one) -> None:
                    nonlocal data
                    data = self.model.read(end, one.length)

                try:
                    one.status = self._tried(act)
                except NoData:
                    break
                if one.status == 0:
                    self._write(one.buffer, bytes(data))
                    one.actual = len(data)
                self.finished.append(queue.popleft())

    def _discard(self, place: int) -> int:
        for queue in self.waiting.values():
            for one in queue:
                if one.place == place:
                    queue.remove(one)
                    one.status = -errno.ENOENT
                    self.finished.append(one)
                    return 0
        raise OSError(errno.EINVAL, "")

    def _reap(self, argument: int) -> int:
        self._serve_waiting()
        if not self.finished:
            raise OSError(errno.EAGAIN if self.model.plugged else errno.ENODEV, "")
        one = self.finished.popleft()
        self._write(one.place + 4, struct.pack("<i", one.status))
        self._write(one.place + 28, struct.pack("<i", one.actual))
        self._write(argument, struct.pack("<Q", one.place))
        return 0


class UmockdevServer:
    """Answers for ``model`` on the socket that umockdev's preload library looks for in ``folder``."""

    def __init__(self, model: UsbModel, folder: str | Path) -> None:
        self.model = model
        self.path = Path(folder) / "ioctl" / "dev" / NODE
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.unlink(missing_ok=True)
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.bind(str(self.path))
        self._socket.listen()
        self._lock = threading.Lock()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            client = _Client(connection, self.model, self._lock)
            threading.Thread(target=client.serve, daemon=True).start()

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()


def command(kind: str, folder: str | Path, *program: str) -> list[str]:
    """The command line that runs ``program`` with a device of ``kind`` on its bus; ``folder`` for the description.

    Raises FileNotFoundError without umockdev.
    """
    if shutil.which("umockdev-run") is None:
        raise FileNotFoundError("umockdev-run is not installed.")
    path = Path(folder) / f"{kind}.umockdev"
    path.write_text(description(MODELS[kind]()))
    return ["umockdev-run", "--device", str(path), "--", sys.executable, "-m", "acquisition.twins.umockdev", kind, "--",
            *program]  # fmt: skip


def main() -> None:
    """Run a program with a device: the first argument is its kind, after ``--`` comes the program."""
    kind, _, *program = sys.argv[1:]
    root = os.environ.get("UMOCKDEV_DIR")
    if root is None:
        with tempfile.TemporaryDirectory() as folder:
            sys.exit(subprocess.call(command(kind, folder, *program)))
    UmockdevServer(MODELS[kind](), root)
    sys.exit(subprocess.call(program))


if __name__ == "__main__":
    main()
