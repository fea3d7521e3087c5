"""What aravis sees of a camera on the bus: run by the system's Python, which has its bindings. Prints JSON.

Arguments: "sync" or "async", number of frames.
"""

import hashlib
import json
import sys

import gi

gi.require_version("Aravis", "0.8")
from gi.repository import Aravis  # noqa: E402

mode, count = sys.argv[1], int(sys.argv[2])
camera = Aravis.Camera.new(None)
camera.uv_set_usb_mode(Aravis.UvUsbMode.SYNC if mode == "sync" else Aravis.UvUsbMode.ASYNC)
found = {
    "model": camera.get_model_name(),
    "serial": camera.get_device_serial_number(),
    "exposure": list(camera.get_exposure_time_bounds()),
}
camera.set_region(0, 0, 48, 40)
camera.set_exposure_time(2500)
found["region"] = list(camera.get_region())
found["set exposure"] = camera.get_exposure_time()
stream = camera.create_stream(None, None)
payload = camera.get_payload()
for _ in range(count + 20):  # the model has no rate: a busy machine must not run out of buffers
    stream.push_buffer(Aravis.Buffer.new_allocate(payload))
camera.start_acquisition()
frames, failures = [], 0
while len(frames) < count and failures < 5:
    buffer = stream.timeout_pop_buffer(3_000_000)
    if buffer is None or buffer.get_status() != Aravis.BufferStatus.SUCCESS:
        failures += 1
    else:
        frames.append([buffer.get_frame_id(), hashlib.sha256(buffer.get_data()).hexdigest()])
    if buffer is not None:
        stream.push_buffer(buffer)
camera.stop_acquisition()
print(json.dumps(found | {"frames": frames, "failures": failures}))
