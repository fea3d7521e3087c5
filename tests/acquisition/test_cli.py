"""The commands devices and acquire: what they say, what they make, and what they refuse."""

import sys

import numpy as np
import pytest
import usb.backend.libusb1
from click.testing import CliRunner

from acquisition import DeviceLost
from acquisition.cli import acquire_command, devices_command
from acquisition.planfile import open_bench, read_plan
from acquisition.twins.backend import TwinBackend
from acquisition.twins.camera import CameraTwin
from acquisition.twins.instrument import InstrumentTwin
from fibre import Calibration, Recording, load
from tests.acquisition.test_devices import Linked, direct

PLAN = """
[plan]
kind = "calibration"
grid = [3, 4]
pitch = 6e-6
stride = 3
states = 2
[plan.views]
diversity = [-3e-5, 0.0, 3e-5]
steps = [0.0, 1.5, 3.0]
bracket = {longest = 16e-3, factor = 4.0, stop = 1e-3}
[bench]
kind = "simulated"
seed = 5
"""


def said(command, *arguments, code=0):
    found = CliRunner().invoke(command, [str(a) for a in arguments])
    assert found.exit_code == code, (found.output, found.exception)
    return found.output


@pytest.fixture
def plan(tmp_path):
    path = tmp_path / "plan.toml"
    path.write_text(PLAN)
    return path


def test_a_dry_run_opens_and_makes_nothing(plan, tmp_path):
    output = said(acquire_command, plan, tmp_path / "run", "--dry-run")
    assert "22 captures (4 reference, 18 spots) of 6 images" in output
    assert "minutes" in output
    assert not (tmp_path / "run").exists()


def test_a_calibration_is_captured_exported_and_not_taken_twice(plan, tmp_path):
    run, out, picture = tmp_path / "run", tmp_path / "calibration.nc", tmp_path / "first.png"
    output = said(acquire_command, plan, run, "--export", out, "--preview", picture)
    assert "22 captures" in output
    assert picture.stat().st_size > 5000
    record = load(out)
    assert isinstance(record, Calibration)
    assert record.images.radiance.shape == (18, 6, 200, 200)
    assert np.all(np.isfinite(record.images.radiance[0]))
    before = {p.name: p.stat().st_mtime_ns for p in run.glob("*.npz")}
    said(acquire_command, plan, run)
    assert {p.name: p.stat().st_mtime_ns for p in run.glob("*.npz")} == before
    plan.write_text(PLAN.replace("seed = 5", "seed = 6"))
    assert "belongs to another run" in said(acquire_command, plan, run, code=1)


def test_a_sample_is_captured(tmp_path):
    path = tmp_path / "sample.toml"
    path.write_text('[plan]\nkind = "sample"\nstates = 2\nviews = {diversity = [0.0, 3e-5], steps = [0.0, 2.0, 4.0]}\n')
    said(acquire_command, path, tmp_path / "run", "--export", tmp_path / "sample.nc", "--reference-seconds", "100")
    assert isinstance(load(tmp_path / "sample.nc"), Recording)


@pytest.mark.parametrize(("change", "text"), [
    (("stride = 3", "stride = 0"), "stride"),
    (("stride = 3", "strides = 3"), "has no 'strides'"),
    (('kind = "calibration"', 'kind = "movie"'), "plan.kind"),
    (("factor = 4.0", "ratio = 4.0"), "has no 'ratio'"),
    (("[bench]", "[table]"), "must hold the tables"),
    (("grid = [3, 4]", "grid = [3, "), "no TOML"),
    (('kind = "simulated"', 'kind = "real"'), "bench.kind"),
    (('kind = "simulated"\nseed = 5', 'kind = "devices"'), "bench.camera"),
])  # fmt: skip
def test_mistakes_in_a_plan_are_named(change, text, plan, tmp_path):
    assert change[0] in PLAN
    plan.write_text(PLAN.replace(*change))
    assert text in said(acquire_command, plan, tmp_path / "run", code=1)
    assert not (tmp_path / "run").exists()


def test_a_bench_of_devices_is_made_by_a_function_of_the_laboratory(tmp_path, monkeypatch):
    """The file names it; it gets the camera that has the serial number, and closes it where it fails."""
    (tmp_path / "my_lab.py").write_text(
        "def bench(camera):\n    return ('bench', camera)\ndef broken(camera):\n    1 / 0\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    opened = []

    class Camera:
        closed = False

        @classmethod
        def open(cls, opener, serial):
            opened.append((opener, serial, cls()))
            return opened[-1][2]

        def close(self):
            self.closed = True

    monkeypatch.setattr("acquisition.worker.WorkerCamera", Camera)
    path = tmp_path / "p.toml"
    path.write_text('[plan]\n[bench]\nkind = "devices"\ncamera = "C-1"\nfactory = "my_lab:bench"\n')
    plan, devices = read_plan(path)
    assert open_bench(devices, plan) == ("bench", opened[0][2])
    assert opened[0][:2] == ("acquisition.usb.camera:Usb3VisionCamera", "C-1")
    with pytest.raises(ZeroDivisionError):
        open_bench(devices | {"factory": "my_lab:broken"}, plan)
    assert opened[1][2].closed
    with pytest.raises(ValueError, match="module:function"):
        open_bench(devices | {"factory": "my_lab"}, plan)
    sys.modules.pop("my_lab", None)


def test_devices_are_listed_with_what_to_do(monkeypatch):
    backend = TwinBackend(CameraTwin(), InstrumentTwin())
    monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda *a, **k: backend)
    output = said(devices_command)
    assert "camera     TWIN-0001" in output
    assert "instrument TMC-0001" in output
    backend.models.clear()
    assert "no device" in said(devices_command)
    assert "uaccess" in said(devices_command, "--rule")


def test_a_bench_of_devices_is_captured_exported_and_closed(tmp_path, monkeypatch):
    """Everything that needs the devices is asked before they are closed; afterwards they are."""
    linked = Linked(direct)
    monkeypatch.setattr("acquisition.planfile.open_bench", lambda devices, plan: linked.bench)
    path = tmp_path / "sample.toml"
    path.write_text("""[plan]
kind = "sample"
references = 1
[plan.views]
diversity = [-4e-5, 0.0, 4e-5]
steps = [0.0, 2.0, 4.0]
bracket = {longest = 64e-3, factor = 4.0, stop = 1e-3}
""")
    output = said(acquire_command, path, tmp_path / "run", "--export", tmp_path / "sample.nc")
    assert "7 captures" in output
    assert isinstance(load(tmp_path / "sample.nc"), Recording)
    with pytest.raises(DeviceLost, match="closed"):
        linked.bench.camera.snap(0.01)
