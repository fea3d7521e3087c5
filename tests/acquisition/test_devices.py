"""A bench of devices executes plans as the simulated bench does, and through USB every byte is the same."""

import numpy as np
import pytest

from acquisition import (
    Bench,
    DeviceLost,
    InverseVariance,
    SimulatedCamera,
    SimulatedInstrument,
    SimulatedModulator,
    Usb3VisionCamera,
    calibrate,
    capture,
)
from acquisition.twins.backend import TwinBackend
from acquisition.twins.camera import CameraTwin
from tests.acquisition.benches import PLAN, SAMPLE, bench

SHAPE = (64, 64)


class Linked:
    """The simulated bench's optics between two modulators and any camera."""

    def __init__(self, open_camera):
        self.optics = bench()
        self.view = None
        self.kinds = []
        modulators = {name: SimulatedModulator(name, (8, 8)) for name in ("illumination", "analysis")}
        self.bench = Bench(
            open_camera(self.scene), modulators, self.illuminate, self.analyse, wavelength=self.optics.wavelength,
            pixel_size=self.optics.pixel_size, merge_rule=self.optics.merge_rule, place=self.kinds.append,
        )  # fmt: skip

    def scene(self, exposure, block):
        return self.optics.expose(self.view, round(exposure, 9)).counts

    def illuminate(self, step, illumination, points):
        self.optics.prepare(step, PLAN.views, illumination, points)
        return np.full((8, 8), 0.1 * step.state)

    def analyse(self, view, views):
        self.view = view
        return np.full((8, 8), 0.1 * view)


def direct(scene):
    return SimulatedCamera("TWIN-0001", SHAPE, 12, scene)


def over_usb(scene):
    return Usb3VisionCamera.open("TWIN-0001", TwinBackend(CameraTwin(shape=SHAPE, bits=12, scene=scene)))


def raw(folder):
    found = {}
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as stored:
            found |= {(path.name, name): stored[name] for name in stored.files}
    return found


@pytest.mark.parametrize("plan", [PLAN, SAMPLE])
def test_through_usb_every_frame_is_that_of_the_direct_twin_and_of_the_bench_itself(plan, tmp_path):
    verb = calibrate if plan is PLAN else capture
    verb(bench(), plan, tmp_path / "simulated")
    for name, camera in (("direct", direct), ("usb", over_usb)):
        linked = Linked(camera)
        with linked.bench as devices:
            verb(devices, plan, tmp_path / name)
        assert linked.kinds == [step.kind for step in plan.captures]
    expected = raw(tmp_path / "simulated")
    for name in ("direct", "usb"):
        found = raw(tmp_path / name)
        assert found.keys() == expected.keys()
        for key, frames in expected.items():
            np.testing.assert_array_equal(found[key], frames)


def test_a_run_that_loses_its_camera_resumes_with_another_connection(tmp_path):
    twin = {}

    def loose(scene):
        twin["camera"] = CameraTwin(shape=SHAPE, bits=12, scene=scene)
        twin["camera"].stream_faults = {23: "unplug"}
        return Usb3VisionCamera.open("TWIN-0001", TwinBackend(twin["camera"]))

    with pytest.raises(DeviceLost), pytest.MonkeyPatch.context() as patch:
        patch.setattr("acquisition.run.WAITS", ())
        with Linked(loose).bench as devices:
            capture(devices, SAMPLE, tmp_path / "run")
    with Linked(over_usb).bench as devices:
        capture(devices, SAMPLE, tmp_path / "run")
    capture(bench(), SAMPLE, tmp_path / "simulated")
    found, expected = raw(tmp_path / "run"), raw(tmp_path / "simulated")
    for key, frames in expected.items():
        np.testing.assert_array_equal(found[key], frames)


def test_everything_is_made_safe_and_closed_and_the_first_error_stays():
    class Refusing(SimulatedModulator):
        def make_safe(self):
            raise DeviceLost("the modulator is gone")

    laser = SimulatedInstrument("LASER")
    camera = SimulatedCamera()
    made = []
    laser.make_safe = lambda: made.append("laser")

    def new():
        return Bench(
            camera, {"analysis": Refusing("M")}, analyse=lambda view, views: np.zeros((32, 48)), wavelength=850e-9,
            pixel_size=1e-6, merge_rule=InverseVariance(1.0, 1.0), others=(laser,),
        )  # fmt: skip

    with pytest.raises(ZeroDivisionError) as caught, new():
        raise ZeroDivisionError
    assert "could not be made safe" in caught.value.__notes__[0]
    assert made == ["laser"]
    with pytest.raises(DeviceLost, match="closed"):
        camera.snap(0.01)
    with pytest.raises(DeviceLost, match="modulator is gone"), new():
        pass


@pytest.mark.parametrize(("change", "error", "text"), [
    ({"camera": None}, TypeError, "camera"),
    ({"modulators": {"other": SimulatedModulator()}}, ValueError, "illumination and analysis"),
    ({"modulators": {"analysis": SimulatedModulator()}}, ValueError, "no function"),
    ({"wavelength": 0}, ValueError, "wavelength"),
    ({"merge_rule": None}, TypeError, "merge_rule"),
    ({"registration": np.eye(3)}, ValueError, "registration"),
    ({"others": (3,)}, TypeError, "others"),
])  # fmt: skip
def test_wrong_parts_are_named(change, error, text):
    parts = {"camera": SimulatedCamera(), "modulators": {}, "wavelength": 850e-9, "pixel_size": 1e-6,
             "merge_rule": InverseVariance(1.0, 1.0)} | change  # fmt: skip
    with pytest.raises(error, match=text):
        Bench(**parts)
