"""Our own drivers over the real libusb: prints JSON. Argument: the device's kind."""

import hashlib
import json
import sys

from acquisition import Dlpc900Modulator, RotationMount, Usb3VisionCamera, list_devices

kind = sys.argv[1]
found = {"listed": [[f.kind, f.serial, f.problem] for f in list_devices()]}
if kind == "camera":
    with Usb3VisionCamera.open("TWIN-0001") as camera:
        frames = [camera.snap(exposure) for exposure in (0.005, 0.002, 0.002)]
        frames += list(camera.frames(20))
    found["frames"] = [[f.block, f.exposure, hashlib.sha256(f.counts.tobytes()).hexdigest()] for f in frames]
elif kind == "instrument":
    with RotationMount.open("TMC-0001") as mount:
        found["angle"] = mount.set("angle", 0.5).actual
        found["identity"] = mount.identity
else:
    with Dlpc900Modulator.open("DLP-0001") as modulator:
        found["mode"] = modulator.set("mode", "video pattern").actual
        found["firmware"] = modulator.firmware
print(json.dumps(found))
