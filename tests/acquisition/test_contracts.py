"""One suite for every camera, modulator and instrument: simulated, over USB in software, and on a display."""

import contextlib
import os
import shutil
import subprocess
import time

import numpy as np
import pytest

from acquisition import (
    Camera,
    Dlpc900Modulator,
    Instrument,
    PhaseModulator,
    PowerMeter,
    Retarder,
    RotationMount,
    Setting,
    SimulatedCamera,
    SimulatedInstrument,
    SimulatedModulator,
    Usb3VisionCamera,
    errors,
)
from acquisition.errors import AcquisitionError, SettingError
from acquisition.twins.backend import TwinBackend
from acquisition.twins.camera import CameraTwin
from acquisition.twins.dlpc900 import DLPC_FAULTS, Dlpc900Twin
from acquisition.twins.instrument import InstrumentTwin

SHAPE = (48, 64)
CAMERAS = {
    "simulated": lambda: SimulatedCamera("TWIN-0001", SHAPE),
    "usb, triggered": lambda: Usb3VisionCamera.open("TWIN-0001", TwinBackend(CameraTwin())),
    "usb, free run, 12 bits": lambda: Usb3VisionCamera.open(
        "TWIN-0001", TwinBackend(CameraTwin(trigger=False, bits=12))
    ),
}
MODULATORS = {
    "simulated": lambda: SimulatedModulator("DLP-0001"),
    "dlpc900": lambda: Dlpc900Modulator.open("DLP-0001", TwinBackend(Dlpc900Twin()), SimulatedModulator(levels=16)),
}
INSTRUMENTS = {
    "simulated": (lambda: SimulatedInstrument("TMC-0001"), "angle"),
    "rotation mount": (lambda: RotationMount.open("TMC-0001", TwinBackend(InstrumentTwin())), "angle"),
    "retarder": (lambda: Retarder.open("TMC-0001", TwinBackend(InstrumentTwin())), "voltage"),
    "power meter": (lambda: PowerMeter.open("TMC-0001", TwinBackend(InstrumentTwin())), "wavelength"),
}


def any_device(make):
    """What holds for all of them."""
    with make() as device:
        assert device.serial
        described = device.describe()
        assert described["serial"] == device.serial
        assert described == device.describe()
        for name, setting in device.settings.items():
            assert isinstance(setting, Setting)
            assert setting.name == name
            if setting.access != "wo":
                value = device.get(name)
                if setting.low is not None and setting.kind in ("number", "integer"):
                    assert setting.low <= value <= setting.high
        with pytest.raises(SettingError, match="name must be"):
            device.get("nothing")
        device.make_safe()
        device.make_safe()
        for setting in device.settings.values():
            if setting.safe is not None:
                assert device.get(setting.name) == setting.safe
    device.close()  # a second time does nothing
    with pytest.raises(ZeroDivisionError), make():
        raise ZeroDivisionError


@pytest.mark.parametrize("name", CAMERAS)
def test_cameras(name):
    any_device(CAMERAS[name])
    with CAMERAS[name]() as camera:
        assert isinstance(camera, Camera)
        blocks, times = [], []
        for exposure in (0.004, 0.002, 0.004):
            frame = camera.snap(exposure)
            assert frame.counts.shape == camera.shape == SHAPE
            assert frame.counts.dtype.kind == "u"
            assert frame.counts.max() <= camera.full_scale
            assert frame.exposure == pytest.approx(exposure)
            blocks.append(frame.block)
            times.append(frame.time)
        assert sorted(times) == times
        low, high = camera.settings["exposure"].low, camera.settings["exposure"].high
        for bad in (0.0, -1.0, high * 2, low / 2, float("nan"), "long", None, True):
            with pytest.raises(SettingError, match="exposure"):
                camera.snap(bad)
        # frames are the caller's own: a later one does not change an earlier one
        first = camera.snap(0.004)
        kept = first.counts.copy()
        camera.snap(0.002)
        np.testing.assert_array_equal(first.counts, kept)


@pytest.mark.parametrize("name", MODULATORS)
def test_modulators(name):
    any_device(MODULATORS[name])
    with MODULATORS[name]() as modulator:
        one_modulator(modulator)


def one_modulator(modulator):
    assert isinstance(modulator, PhaseModulator)
    step = 2 * np.pi / modulator.levels
    phase = np.random.default_rng(0).integers(0, modulator.levels, modulator.shape) * step
    shown = modulator.show(phase)
    assert shown.settled >= 0
    assert modulator.show(phase + 2 * np.pi).digest == shown.digest  # a phase is a phase
    assert modulator.show(phase + 0.4 * step).digest == shown.digest  # the nearest level
    assert modulator.show(phase + step).digest != shown.digest
    for bad in (phase[:-1], phase[None], np.full(modulator.shape, np.nan), phase + 0j):
        with pytest.raises(SettingError, match="phase must be"):
            modulator.show(bad)


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_instruments(name):
    make, setting = INSTRUMENTS[name]
    any_device(make)
    with make() as instrument:
        assert isinstance(instrument, Instrument)
        declared = instrument.settings[setting]
        for share in (0.0, 0.3, 1.0):
            value = declared.low + share * (declared.high - declared.low)
            written = instrument.set(setting, value)
            assert written.requested == pytest.approx(value)
            assert written.actual == pytest.approx(value, rel=1e-6, abs=1e-12)
            assert instrument.get(setting) == written.actual
        with pytest.raises(SettingError, match=setting):
            instrument.set(setting, declared.high * 1.01 + 1e-9)


def test_making_safe_goes_on_after_a_failure_and_never_hides_the_first_error():
    class Half(SimulatedInstrument):
        def _write(self, setting, value):
            if setting.name == "first":
                raise errors.DeviceTimeout("first does not answer")
            super()._write(setting, value)

    declared = (Setting("first", "number", safe=0.0), Setting("second", "number", safe=0.0))
    device = Half(declared=declared)
    device.values["second"] = 5.0
    with pytest.raises(errors.DeviceTimeout, match="first does not"):
        device.make_safe()
    assert device.values["second"] == 0.0
    with pytest.raises(KeyError) as caught, Half(declared=declared):
        raise KeyError("mine")
    assert "could not be made safe" in caught.value.__notes__[0]


@pytest.mark.parametrize("fault", DLPC_FAULTS)
def test_a_fault_at_any_command_of_a_dlpc900_is_overcome_or_named(fault):
    def session(twin):
        with Dlpc900Modulator.open("DLP-0001", TwinBackend(twin)) as modulator:
            modulator.set("power", "normal")
            assert modulator.set("mode", "video").actual == "video"
            assert modulator.firmware == "4.2.3"
            assert modulator.status() == (1, 0)

    plain = Dlpc900Twin()
    session(plain)
    assert plain.values[0x0200] == 1  # standby, afterwards
    survived = 0
    for step in range(plain.commands):
        twin = Dlpc900Twin(faults={step: fault})
        with contextlib.suppress(AcquisitionError):
            session(twin)
            survived += 1
        twin.plugged = True
        session(twin)
    if fault in ("no reply", "wrong number", "short", "absurd length", "stale first", "empty", "stall", "overflow"):
        assert survived == plain.commands


@pytest.fixture
def screen():
    """A virtual X server of 160 x 120 pixels, and its name."""
    pytest.importorskip("pygame", reason="pygame is not installed (pip install 'polinfer[display]')")
    if shutil.which("Xvfb") is None:
        pytest.skip("Xvfb is not installed (.ci/run installs it)")
    ready, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "160x120x24", "-nolisten", "tcp", "-noreset"],
        pass_fds=(write,), stderr=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(write)
    # it writes its number, then a line's end; who hangs up between them ends it
    with os.fdopen(ready) as lines:
        name = ":" + lines.readline().strip()
    before = {key: os.environ.get(key) for key in ("DISPLAY", "SDL_VIDEODRIVER")}
    os.environ |= {"DISPLAY": name, "SDL_VIDEODRIVER": "x11"}
    yield name
    for key, value in before.items():
        os.environ.pop(key, None) if value is None else os.environ.__setitem__(key, value)
    server.terminate()
    server.wait()


def grabbed(name):
    from PIL import ImageGrab

    return np.asarray(ImageGrab.grab(xdisplay=name).convert("RGB"))


def test_a_display_shows_exact_pixels(screen):
    """What the X server has on its screen, pixel by pixel, against the grey levels that were meant."""
    from acquisition import DisplayModulator

    lookup = np.linspace(10, 250, 32).round().astype(np.uint8)
    with DisplayModulator("SLM", (120, 160), settle=0.05, lookup=lookup) as modulator:
        one_modulator(modulator)
        generator = np.random.default_rng(1)
        for _ in range(5):
            levels = generator.integers(0, 32, (120, 160))
            shown = modulator.show(levels * 2 * np.pi / 32)
            assert shown.settled >= 0.05
            seen = grabbed(screen)
            for colour in range(3):
                np.testing.assert_array_equal(seen[..., colour], lookup[levels])
        modulator.make_safe()
        assert np.all(grabbed(screen) == lookup[0])
    with pytest.raises(SettingError, match="nothing is scaled"):
        DisplayModulator("SLM", (100, 160))
    with pytest.raises(errors.DeviceAbsent, match="screen must be below 1"):
        DisplayModulator("SLM", (120, 160), screen=1)
    with pytest.raises(SettingError, match="lookup"):
        DisplayModulator("SLM", (120, 160), lookup=np.array([0.5, 1.0]))
    with DisplayModulator("SLM", (120, 160), settle=0.0) as modulator:
        modulator.set("settle", 0.2)
        start = time.monotonic()
        assert modulator.show(np.zeros((120, 160))).settled >= 0.2
        assert time.monotonic() - start >= 0.2
        with pytest.raises(SettingError, match="settle"):
            modulator.set("settle", -1.0)
