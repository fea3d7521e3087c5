"""A device in a process of its own: it answers as the original, and comes back after its process has died."""

import os
import signal
import time

import numpy as np
import pytest

from acquisition import DeviceLost, SimulatedCamera, SimulatedInstrument
from acquisition.errors import DeviceTimeout, SettingError
from acquisition.worker import WorkerCamera, WorkerInstrument

CAMERA, INSTRUMENT, HANGING = (f"tests.acquisition.test_worker:{name}" for name in ("Opened", "Mount", "Hanging"))


class Opened(SimulatedCamera):
    @classmethod
    def open(cls, serial):
        return cls(serial)

    def describe(self):
        print("what a library prints is no answer")  # noqa: T201
        return super().describe()


class Mount(SimulatedInstrument):
    @classmethod
    def open(cls, serial):
        return cls(serial)


class Hanging(Opened):
    def snap(self, exposure):
        time.sleep(1000)


def test_it_answers_as_the_original_does():
    with WorkerCamera.open(CAMERA, "W-1") as camera:
        direct = Opened("W-1")
        assert camera.describe() == direct.describe()
        assert camera.settings == direct.settings
        assert (camera.shape, camera.full_scale) == (direct.shape, direct.full_scale)
        for exposure in (0.01, np.float64(0.002)):
            ours, theirs = camera.snap(exposure), direct.snap(exposure)
            np.testing.assert_array_equal(ours.counts, theirs.counts)
            assert (ours.block, ours.time, ours.exposure) == (theirs.block, theirs.time, theirs.exposure)
        with pytest.raises(SettingError, match="exposure must be from"):
            camera.snap(100.0)
        with pytest.raises(SettingError, match="name must be"):
            camera.get("colour")
    with pytest.raises(DeviceLost, match="closed"):
        camera.snap(0.01)


def test_after_a_death_it_is_opened_again_with_all_its_settings():
    with WorkerInstrument.open(INSTRUMENT, "W-2") as mount:
        mount.set("angle", 1.25)
        os.kill(mount._process._process.pid, signal.SIGKILL)
        time.sleep(0.1)
        assert mount.get("angle") == 1.25


def test_a_death_in_the_middle_of_a_call_is_a_loss_and_the_next_call_works():
    with WorkerCamera.open(HANGING, "W-3") as camera:
        worker = camera._process._process.pid
        import threading

        threading.Timer(0.5, os.kill, (worker, signal.SIGKILL)).start()
        with pytest.raises(DeviceLost, match="process has ended"):
            camera.snap(0.01)
        assert camera.shape == (48, 64)
        assert camera._process._process.pid != worker


def test_one_that_hangs_is_ended(monkeypatch):
    monkeypatch.setattr("acquisition.worker.MARGIN", 1.0)
    with WorkerCamera.open(HANGING, "W-4") as camera:
        start = time.monotonic()
        with pytest.raises(DeviceTimeout, match="has not answered"):
            camera.snap(0.01)
        assert time.monotonic() - start < 5
        assert camera.shape == (48, 64)


def test_what_cannot_be_opened_is_said_at_once():
    with pytest.raises(Exception, match="no camera"):
        WorkerCamera.open("tests.acquisition.test_worker:Absent", "W-5")


class Absent:
    @classmethod
    def open(cls, serial):
        from acquisition import DeviceAbsent

        raise DeviceAbsent("no camera with this serial number")
