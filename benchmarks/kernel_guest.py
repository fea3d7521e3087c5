"""Drivers and models under a real kernel: plugged into its virtual USB controller, in a guest, under emulation.

``python -m benchmarks.kernel_guest FOLDER``: FOLDER holds the files of Debian's packages linux-image-amd64 and
busybox-static, unpacked (``apt-get download``, ``dpkg-deb -x``); qemu-system-x86_64 must be installed. The guest starts
from a small archive in memory, sees this machine's files read-only, and runs this script's second half: a camera at
SuperSpeed is enumerated, opened through a worker process, unplugged in the middle of a series and plugged in again; an
instrument answers the kernel's own usbtmc driver, then ours. Slow: some minutes, and no time of it means anything.
"""

from __future__ import annotations

import gzip
import json
import lzma
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MODULES = ("vhci-hcd", "usbtmc", "virtio_pci", "9pnet_virtio", "9p")
MARK = "GUEST:"
LIMIT = 900  # seconds


def host(folder: Path) -> int:
    """Start the guest and print what it says; 0 if all is well."""
    kernel = next(folder.glob("**/vmlinuz*"))
    with tempfile.TemporaryDirectory() as made:
        archive = Path(made) / "initramfs.gz"
        archive.write_bytes(gzip.compress(_archive(folder)))
        command = [
            "qemu-system-x86_64", "-accel", "tcg", "-cpu", "max", "-smp", "2", "-m", "2048", "-nographic", "-no-reboot",
            "-kernel", str(kernel), "-initrd", str(archive), "-append", "console=ttyS0 quiet panic=-1",
            "-virtfs", "local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap",
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, stdin=subprocess.DEVNULL)
    lines = [line.split(MARK, 1)[1].strip() for line in done.stdout.splitlines() if MARK in line]
    for line in lines:
        print(line)
    if not lines or lines[-1] != "all well":
        print(done.stdout[-4000:])
        return 1
    return 0


def _modules(folder: Path) -> dict[str, bytes]:
    """The modules that are wanted and all that they depend on, in the order in which they can be loaded."""
    paths = {path.name.split(".")[0].replace("_", "-"): path for path in folder.glob("**/*.ko*")}
    found: dict[str, bytes] = {}

    def add(name: str) -> None:
        name = name.replace("_", "-")
        if name in found or name not in paths:  # the latter are built in
            return
        raw = paths[name].read_bytes()
        raw = lzma.decompress(raw) if paths[name].suffix == ".xz" else raw
        depends = re.search(rb"\0depends=([^\0]*)\0", raw)
        for other in filter(None, depends[1].decode().split(",") if depends else []):
            add(other)
        found[name] = raw

    for name in MODULES:
        add(name)
    return found


def _archive(folder: Path) -> bytes:
    """A cpio archive with busybox, the modules and the first program."""
    files = {"bin/busybox": (next(folder.glob("**/bin/busybox")).read_bytes(), 0o755)}
    for name, raw in _modules(folder).items():
        files[f"modules/{name}.ko"] = (raw, 0o644)
    order = [name.split("/")[1].removesuffix(".ko") for name in files if name.startswith("modules/")]
    mounts = "; ".join(f"mount -o bind /{name} /host/{name}" for name in ("proc", "sys", "dev"))
    files["init"] = (
        f"""#!/bin/busybox sh
/bin/busybox mkdir -p /proc /sys /dev /host /tmp
/bin/busybox --install -s /bin
mount -t proc none /proc; mount -t sysfs none /sys; mount -t devtmpfs none /dev
for m in {" ".join(order)}; do insmod /modules/$m.ko || echo "{MARK} no module $m"; done
mount -t 9p -o trans=virtio,version=9p2000.L,ro,cache=loose,msize=262144 host /host || echo "{MARK} no host"
{mounts}; mount -t tmpfs none /host/tmp
cd /host; chroot /host /usr/bin/env -C {ROOT} HOME=/tmp PYTHONDONTWRITEBYTECODE=1 JAX_PLATFORMS=cpu MPLCONFIGDIR=/tmp \\
  {sys.executable} -m benchmarks.kernel_guest --guest 2>&1
poweroff -f
""".encode(),
        0o755,
    )
    out = bytearray()
    folders = sorted({str(parent) for name in files for parent in Path(name).parents if str(parent) != "."})
    entries = [(name, b"", 0o040755) for name in folders] + [(n, d, 0o100000 | m) for n, (d, m) in files.items()]
    for number, (name, data, mode) in enumerate([*entries, ("TRAILER!!!", b"", 0)]):
        fields = (number + 1, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(name) + 1, 0)
        head = b"070701" + b"".join(b"%08X" % f for f in fields) + name.encode() + b"\0"
        out += head + bytes(-len(head) % 4) + data + bytes(-len(data) % 4)
    return bytes(out)


def say(**what: object) -> None:
    """A line that the host looks for."""
    print(MARK, json.dumps(what), flush=True)


def guest() -> None:
    """In the guest: everything with models that the kernel believes to be devices."""
    import numpy as np

    import acquisition.worker
    from acquisition import AcquisitionError, RotationMount
    from acquisition.twins.camera import CameraTwin
    from acquisition.twins.instrument import InstrumentTwin
    from acquisition.twins.usbip import Plugged, wait_for
    from acquisition.worker import WorkerCamera

    acquisition.worker.OPENING = acquisition.worker.MARGIN = 400.0  # under emulation
    start = time.monotonic()
    twin = CameraTwin()
    plugged = Plugged(twin)
    speeds = Path("/sys/bus/usb/devices")

    def cameras() -> list[Path]:
        products = [p / "idProduct" for p in speeds.iterdir() if (p / "idProduct").exists()]
        return [p.parent for p in products if p.read_text().strip() == f"{twin.product:04x}"]

    assert wait_for(cameras, 30)
    device = cameras()[0]
    say(step="camera enumerated", speed=device.joinpath("speed").read_text().strip(),
        serial=device.joinpath("serial").read_text().strip())  # fmt: skip
    losses, frames, replugged = 0, 0, 0.0
    with WorkerCamera.open("acquisition.usb.camera:Usb3VisionCamera", "TWIN-0001") as camera:
        say(step="camera opened", seconds=round(time.monotonic() - start, 1))
        while frames < 12:
            if frames == 6 and losses == 0 and plugged.model is twin:
                plugged.unplug()
                replugged = time.monotonic()
            try:
                frame = camera.snap(0.002)
            except AcquisitionError as error:
                losses += 1
                say(step="lost", error=type(error).__name__, text=str(error)[:120])
                assert losses < 5
                if plugged.model is twin:
                    twin2 = CameraTwin()
                    plugged = Plugged(twin2)
                    time.sleep(1.0)
                continue
            np.testing.assert_array_equal(frame.counts, twin.scene(0.002, frame.block))
            frames += 1
        say(
            step="camera resumed",
            frames=frames,
            losses=losses,
            seconds_after_loss=round(time.monotonic() - replugged, 1),
        )
    plugged.unplug()
    instrument = Plugged(InstrumentTwin())
    assert wait_for(lambda: Path("/dev/usbtmc0").exists(), 30)
    node = os.open("/dev/usbtmc0", os.O_RDWR)
    os.write(node, b"*IDN?\n")
    say(step="kernel's usbtmc", answer=os.read(node, 200).decode().strip())
    os.close(node)
    with RotationMount.open("TMC-0001") as mount:
        say(step="our driver", angle=round(mount.set("angle", 0.5).actual, 6), identity=mount.identity)
    assert wait_for(lambda: Path("/dev/usbtmc0").exists(), 10)  # the kernel has its driver back
    instrument.unplug()
    print(MARK, "all well", flush=True)


if __name__ == "__main__":
    if sys.argv[1:] == ["--guest"]:
        guest()
    else:
        sys.exit(host(Path(sys.argv[1])))
