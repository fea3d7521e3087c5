"""The camera's driver over its twin: whole frames or a clear error, whatever goes wrong, and nothing for ever."""

import struct
import time

import numpy as np
import pytest

from acquisition import errors
from acquisition.errors import AcquisitionError, DeviceAbsent, DeviceForbidden, DeviceLost, ProtocolError, SettingError
from acquisition.twins.backend import TwinBackend
from acquisition.twins.camera import CONTROL_FAULTS, REGISTERS, SIRM, STREAM_FAULTS, CameraTwin
from acquisition.usb.camera import Usb3VisionCamera
from acquisition.usb.discovery import list_devices

SERIAL = "TWIN-0001"
EXPOSURES = (0.005, 0.002, 0.002)


def session(twin):
    """Open, three frames, close; every frame is compared with the scene that made it."""
    with Usb3VisionCamera.open(SERIAL, TwinBackend(twin)) as camera:
        for exposure in EXPOSURES:
            frame = camera.snap(exposure)
            assert frame.exposure == pytest.approx(exposure)
            np.testing.assert_array_equal(frame.counts, twin.scene(exposure, frame.block))


def commands_of_a_session():
    twin = CameraTwin()
    session(twin)
    return twin.commands


@pytest.mark.parametrize("options", [{}, {"zipped": True}, {"bits": 12}, {"bits": 16}, {"trigger": False},
                                     {"alignment": 1}, {"shape": (1203, 1008)}])  # fmt: skip
def test_frames_are_the_scene(options):
    session(CameraTwin(**options))


@pytest.mark.parametrize("among", [3, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("fault", CONTROL_FAULTS)
def test_a_fault_at_any_command_is_overcome_or_named(fault, among):
    """One command among so many of a session, each kind of fault at others; afterwards the device works again, and no
    call goes on for ever."""
    survived, commands = 0, commands_of_a_session()
    assert commands > 60
    steps = range(list(CONTROL_FAULTS).index(fault) % among, commands, among)
    for step in steps:
        twin = CameraTwin()
        twin.control_faults[step] = fault
        start = time.monotonic()
        try:
            session(twin)
            survived += 1
        except AcquisitionError as error:
            assert type(error) is not AcquisitionError, error
            assert len(str(error)) > 10
        assert time.monotonic() - start < 5
        assert not twin.control_faults, "the fault was never met"
        twin.plugged = True
        session(twin)
    # what one repetition mends must be mended
    mendable = {"no acknowledgement", "late acknowledgement", "pending", "bad magic", "wrong number", "wrong command",
                "wrong length", "short", "empty", "busy"}  # fmt: skip
    if fault in mendable:
        assert survived == len(steps)
    if fault == "unplug":
        assert survived <= 3  # while it is being closed


@pytest.mark.parametrize("fault", STREAM_FAULTS)
@pytest.mark.parametrize("trigger", [True, False])
def test_a_fault_in_any_frame_is_overcome_or_named(fault, trigger):
    for number in range(len(EXPOSURES)):
        twin = CameraTwin(trigger=trigger)
        twin.stream_faults[number] = fault
        start = time.monotonic()
        if fault == "unplug":
            with pytest.raises(DeviceLost):
                session(twin)
        else:
            session(twin)  # taken again
        assert time.monotonic() - start < 5
        assert not twin.stream_faults
        twin.plugged = True
        session(twin)


@pytest.mark.parametrize("fault", sorted(set(STREAM_FAULTS) - {"unplug", "empty", "nothing", "gap"}))
def test_a_fault_that_stays_is_an_error(fault):
    twin = CameraTwin()
    twin.stream_faults = dict.fromkeys(range(20), fault)
    with pytest.raises(AcquisitionError), Usb3VisionCamera.open(SERIAL, TwinBackend(twin)) as camera:
        camera.snap(0.001)


def test_frames_in_a_row_are_complete_and_a_gap_is_not_passed_over():
    twin = CameraTwin()
    with Usb3VisionCamera.open(SERIAL, TwinBackend(twin)) as camera:
        blocks = [frame.block for frame in camera.frames(50)]
        assert blocks == list(range(50))
        twin.stream_faults[twin.frames_begun + 7] = "gap"
        with pytest.raises(errors.FrameLost, match="lost"):
            list(camera.frames(20))
        assert camera.snap(0.001).counts.shape == (48, 64)


def test_frames_that_began_before_the_call_are_thrown_away():
    """A camera that runs freely has frames waiting, with the exposure and the pattern of before."""
    twin = CameraTwin(trigger=False)
    pattern = {"value": 1}
    twin.scene = lambda exposure, block: np.full((48, 64), pattern["value"], np.uint8)
    with Usb3VisionCamera.open(SERIAL, TwinBackend(twin)) as camera:
        camera.snap(0.01)
        twin._begin()  # a frame of the old pattern is under way
        pattern["value"] = 2
        twin.clock += 0.5
        assert np.all(camera.snap(0.01).counts == 2)


def test_settings_have_the_limits_of_the_device_and_are_read_back():
    twin = CameraTwin()
    with Usb3VisionCamera.open(SERIAL, TwinBackend(twin)) as camera:
        exposure = camera.settings["exposure"]
        assert (exposure.unit, exposure.low, exposure.high) == ("s", pytest.approx(1e-5), pytest.approx(10.0))
        assert camera.set("exposure", 0.0033333333).actual == pytest.approx(0.003333)  # whole microseconds
        assert camera.set("exposure", exposure.low).actual == pytest.approx(1e-5)
        for name, bad in (("exposure", 11.0), ("exposure", 0.0), ("exposure", float("nan")), ("exposure", "long"),
                          ("width", 33), ("width", 128), ("height", 1.5), ("gain", 25.0), ("pixel_format", "RGB8"),
                          ("shutter", 1)):  # fmt: skip
            with pytest.raises(SettingError, match=name):
                camera.set(name, bad)
        camera.set("width", 32)
        camera.set("offset_x", 16)
        camera.set("height", 10)
        camera.set("pixel_format", "Mono12")
        assert camera.full_scale == 4095
        frame = camera.snap(0.001)
        np.testing.assert_array_equal(frame.counts, twin.scene(0.001, frame.block)[:10, 16:48])
        assert frame.counts.dtype == np.uint16
    assert twin.register("x") == 16


def test_the_camera_is_left_idle_whatever_happens():
    twin = CameraTwin()
    with pytest.raises(ZeroDivisionError), Usb3VisionCamera.open(SERIAL, TwinBackend(twin)) as camera:
        camera.snap(0.001)
        assert twin.acquiring
        raise ZeroDivisionError
    assert not twin.acquiring
    assert twin._get(SIRM + 4, 4) == bytes(4)
    assert twin.register("locked") == 0


def test_a_loss_keeps_its_first_error_and_the_device_can_come_back():
    twin = CameraTwin()
    backend = TwinBackend(twin)
    with pytest.raises(DeviceLost, match="check cable"), Usb3VisionCamera.open(SERIAL, backend) as camera:
        camera.snap(0.001)
        twin.plugged = False
        camera.snap(0.001)
    with pytest.raises(DeviceAbsent, match="no camera is connected"):
        Usb3VisionCamera.open(SERIAL, backend)
    twin.plugged, twin.acquiring = True, False
    session(twin)


def test_only_the_serial_number_asked_for_is_opened():
    backend = TwinBackend(CameraTwin("A"), CameraTwin("B"))
    with Usb3VisionCamera.open("B", backend) as camera:
        assert camera.describe()["serial"] == "B"
    with pytest.raises(DeviceAbsent, match="'A', 'B'"):
        Usb3VisionCamera.open("C", backend)
    with pytest.raises(DeviceAbsent, match="serial"):
        Usb3VisionCamera.open("", backend)


def test_what_may_not_be_opened_is_told_from_what_is_not_there():
    class Guarded(TwinBackend):
        def open_device(self, dev):
            import usb.core

            raise usb.core.USBError("Access denied", -3, 13)

    backend = Guarded(CameraTwin())
    (found,) = list_devices(backend)
    assert (found.kind, found.serial) == ("camera", "")
    assert "udev" in found.problem
    with pytest.raises(DeviceForbidden, match="uaccess"):
        Usb3VisionCamera.open(SERIAL, backend)
    assert list_devices(TwinBackend()) == []


def xml_of(text):
    return (
        f'<RegisterDescription xmlns="http://www.genicam.org/GenApi/Version_1_1">{text}</RegisterDescription>'.encode()
    )


BOMB = (
    b'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">'
    + b"".join(b'<!ENTITY %c "%s">' % (98 + i, b"&%c;" % (97 + i) * 10) for i in range(9))
    + b"]><RegisterDescription>&j;</RegisterDescription>"
)
OUTSIDE = (b'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]>'
           b"<RegisterDescription>&a;</RegisterDescription>")  # fmt: skip


@pytest.mark.parametrize("xml", [BOMB, OUTSIDE, b"", b"<a/>", b"\xff\xfe\x00", xml_of("<Integer/>"), xml_of(""),
                                 xml_of('<Integer Name="Width"><pValue>Width</pValue></Integer>'),
                                 b"<RegisterDescription>" * 100_000])  # fmt: skip
@pytest.mark.parametrize("zipped", [True, False])
def test_xml_that_is_hostile_or_broken_opens_nothing(xml, zipped):
    with pytest.raises(ProtocolError):
        Usb3VisionCamera.open(SERIAL, TwinBackend(CameraTwin(xml=xml, zipped=zipped)))


def test_a_zip_bomb_is_not_unpacked():
    twin = CameraTwin(xml=b"<a>" + b" " * (64 << 20) + b"</a>", zipped=True)
    with pytest.raises(ProtocolError, match="16 MiB"):
        Usb3VisionCamera.open(SERIAL, TwinBackend(twin))


@pytest.mark.parametrize(("address", "size", "value"), [
    (SIRM + 0x08, 8, 1 << 40),  # payload
    (SIRM + 0x08, 8, 0),
    (SIRM + 0x10, 4, 0xFFFFFFFF),  # leader
    (SIRM + 0x14, 4, 0),  # trailer
    (0x10014, 4, 0xFFFFFFFF),  # largest command
    (0x10018, 4, 0),  # largest acknowledgement
    (0x1D0, 8, 0xFFFFFFFFFFFF),  # manifest
    (0x1D8, 8, 0xFFFFFFFFFFFF),  # SBRM
    (0x40000, 8, 1 << 60),  # entries
    (0x40000, 8, 0),
    (0x40008 + 16, 8, 1 << 50),  # size of the XML
    (0x40008 + 24, 8, 12345),  # its checksum
    (REGISTERS["width"], 4, 0xFFFFFFFF),
    (REGISTERS["height"], 4, 0),
])  # fmt: skip
def test_absurd_sizes_allocate_nothing(address, size, value):
    import tracemalloc

    twin = CameraTwin()
    twin._sizes = lambda: None
    twin._put(SIRM + 8, struct.pack("<Q", 48 * 64))
    twin._put(address, value.to_bytes(size, "little"))
    tracemalloc.start()
    try:
        with pytest.raises(AcquisitionError), Usb3VisionCamera.open(SERIAL, TwinBackend(twin)) as camera:
            camera.snap(0.001)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


def test_a_command_that_must_not_be_repeated_is_sent_once():
    """A trigger whose acknowledgement is lost may have worked: its frame tells."""
    twin = CameraTwin()
    with Usb3VisionCamera.open(SERIAL, TwinBackend(twin)) as camera:
        camera.snap(0.001)
        before = twin.triggers
        twin.control_faults = {twin.commands: "no acknowledgement"}
        frame = camera.snap(0.001)
    assert twin.triggers == before + 1
    np.testing.assert_array_equal(frame.counts, twin.scene(0.001, frame.block))
