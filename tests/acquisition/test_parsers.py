"""Every parser of device bytes on random bytes: a record, or an error of ours."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquisition.errors import AcquisitionError, FrameLost, ProtocolError
from acquisition.twins.backend import TwinBackend
from acquisition.twins.camera import CameraTwin
from acquisition.twins.dlpc900 import Dlpc900Twin
from acquisition.usb import u3v
from acquisition.usb.camera import Usb3VisionCamera
from acquisition.usb.dlpc900 import Dlpc900Modulator
from acquisition.usb.gencp import acknowledge

LEADER = struct.pack("<IHHQHHQIIIIIHH", u3v.LEADER, 0, 52, 7, 0, 1, 5, 0x01080001, 64, 48, 0, 0, 0, 0)
TRAILER = struct.pack("<IHHQHHQI", u3v.TRAILER, 0, 32, 7, 0, 0, 3072, 48)
ENTRY = struct.pack("<HBBIQQ", 0, 0, 1, 1 << 16, 0x1000, 50).ljust(64, b"\0")


def near(raw):
    """Random bytes, and a right packet with some bytes changed or cut."""

    def damage(changes, cut):
        made = bytearray(raw)
        for place, value in changes:
            made[place % len(made)] = value
        return bytes(made[: len(made) - cut])

    changes = st.lists(st.tuples(st.integers(0, 500), st.integers(0, 255)), max_size=6)
    return st.one_of(st.binary(max_size=120), st.builds(damage, changes, st.integers(0, 12)))


def test_right_packets_are_read():
    assert u3v.leader(LEADER).width == 64
    assert u3v.trailer(TRAILER).payload == 3072
    assert u3v.manifest(ENTRY)[0].address == 0x1000


@given(near(LEADER))
def test_leaders(raw):
    try:
        found = u3v.leader(raw)
    except FrameLost:
        return
    assert raw[:4] == b"U3VL"
    assert found.block == int.from_bytes(raw[8:16], "little")


@given(near(TRAILER))
def test_trailers(raw):
    try:
        found = u3v.trailer(raw)
    except FrameLost:
        return
    assert raw[:4] == b"U3VT"
    assert found.payload == int.from_bytes(raw[20:28], "little")


@given(near(struct.pack("<IHHHH", 0x43563355, 0, 0x0801, 4, 9) + b"abcd"))
def test_acknowledgements(raw):
    try:
        found = acknowledge(raw)
    except ProtocolError:
        return
    assert len(found.payload) == len(raw) - 12


@given(near(ENTRY))
def test_manifests(raw):
    try:
        found = u3v.manifest(raw)
    except ProtocolError:
        return
    assert all(0 < entry.size <= 16 << 20 for entry in found)


@given(near(b"PK\x03\x04" + b"\0" * 40), st.booleans())
def test_archives(raw, zipped):
    entry = u3v.ManifestEntry(0, len(raw), zipped, b"", (1, 1))
    try:
        found = u3v.camera_xml(entry, raw)
    except ProtocolError:
        return
    assert zipped or found == raw


class Noisy(CameraTwin):
    """A camera whose stream is given."""

    given_parts: list = []  # noqa: RUF012

    def _streamed(self, length):
        if self.given_parts:
            return self._checked(self.given_parts.pop(0), 0x82, length)
        return super()._streamed(length)


@given(st.lists(st.one_of(near(LEADER), near(TRAILER), st.binary(max_size=4000)), max_size=5))
def test_random_streams_give_whole_frames_or_an_error(parts):
    twin = Noisy()
    with Usb3VisionCamera.open("TWIN-0001", TwinBackend(twin)) as camera:
        twin.given_parts = list(parts)
        try:
            frame = camera.snap(0.001)
        except AcquisitionError:
            return
        assert frame.counts.shape == (48, 64)


@given(st.lists(st.binary(min_size=0, max_size=64), max_size=8))
def test_random_reports_of_a_dlpc900(reports):
    twin = Dlpc900Twin()
    modulator = Dlpc900Modulator.open("DLP-0001", TwinBackend(twin))
    twin._sent.extend(reports)
    try:
        modulator.get("mode")
    except AcquisitionError:
        pass
    finally:
        modulator.close()


@pytest.mark.parametrize("size", [0, 1, 11, 13, 4096])
def test_lengths_that_do_not_fit(size):
    with pytest.raises(ProtocolError):
        acknowledge(bytes(size))
    with pytest.raises(FrameLost):
        u3v.leader(bytes(size))
    with pytest.raises(FrameLost):
        u3v.trailer(bytes(size))
