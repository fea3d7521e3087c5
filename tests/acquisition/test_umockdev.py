"""The real libusb on an emulated bus: aravis drives our model of a camera, and our own drivers theirs.

Where umockdev or aravis are absent these tests are skipped with the reason; .ci/run installs both.
"""

import hashlib
import json
import shutil
import subprocess
from pathlib import Path

import pytest

from acquisition.twins.camera import CameraTwin
from acquisition.twins.umockdev import command

HERE = Path(__file__).parent
SYSTEM = "/usr/bin/python3"


def on_the_bus(kind, folder, *program):
    if shutil.which("umockdev-run") is None:
        pytest.skip("umockdev is not installed (.ci/run installs it)")
    done = subprocess.run(
        command(kind, folder, *program), capture_output=True, text=True, timeout=120, cwd=HERE.parents[1]
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def digest(exposure, block, region=None):
    counts = CameraTwin().scene(exposure, block)
    if region is not None:
        counts = counts[: region[0], : region[1]]
    return hashlib.sha256(counts.tobytes()).hexdigest()


def aravis():
    check = "import gi; gi.require_version('Aravis', '0.8'); from gi.repository import Aravis"
    if not Path(SYSTEM).exists() or subprocess.run([SYSTEM, "-c", check], capture_output=True).returncode:
        pytest.skip("aravis is not installed (.ci/run installs it)")


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_aravis_lists_configures_and_streams_our_camera_bit_by_bit(mode, tmp_path):
    aravis()
    found = json.loads(on_the_bus("camera", tmp_path, SYSTEM, str(HERE / "peer_aravis.py"), mode, "100"))
    assert (found["model"], found["serial"]) == ("Camera twin", "TWIN-0001")
    assert found["exposure"] == [10, 10_000_000]
    assert found["set exposure"] == 2500
    assert found["region"] == [0, 0, 48, 40]
    assert found["failures"] == 0
    assert found["frames"] == [[block, digest(0.0025, block, (40, 48))] for block in range(100)]


def test_aravis_tool_prints_and_sets_features(tmp_path):
    if shutil.which("arv-tool-0.8") is None:
        pytest.skip("arv-tool is not installed (.ci/run installs it)")
    said = on_the_bus("camera", tmp_path, "arv-tool-0.8", "control", "Width=32", "PixelFormat=Mono12", "PayloadSize",
                      "ReverseX=true", "DeviceTemperature")  # fmt: skip
    assert "Width = 32" in said
    assert f"PayloadSize = {32 * 48 * 2}" in said
    assert "ReverseX = true" in said
    assert "DeviceTemperature = 31.25" in said


def test_our_camera_driver_over_libusb(tmp_path):
    import sys

    found = json.loads(on_the_bus("camera", tmp_path, sys.executable, str(HERE / "peer_ours.py"), "camera"))
    assert found["listed"] == [["camera", "TWIN-0001", ""]]
    assert len(found["frames"]) == 23
    for block, exposure, one in found["frames"]:
        assert one == digest(round(exposure, 6), block)
    assert [block for block, *_ in found["frames"]] == [0, 1, 2, *range(20)]


@pytest.mark.parametrize(
    ("kind", "name", "value"), [("instrument", "angle", 0.5), ("modulator", "mode", "video pattern")]
)
def test_our_other_drivers_over_libusb(kind, name, value, tmp_path):
    import sys

    found = json.loads(on_the_bus(kind, tmp_path, sys.executable, str(HERE / "peer_ours.py"), kind))
    assert found[name] == (pytest.approx(value, abs=1e-7) if isinstance(value, float) else value)
    assert found["listed"][0][2] == ""
