"""Registers and stream packets of USB3 Vision: parsed here, without a device.

In: bytes from a camera. Out: checked records. Called by the camera's driver.

From public sources (aravis, cameleon); the standard itself is licensed and was not at hand.
"""

from __future__ import annotations

import hashlib
import io
import struct
import zipfile
import zlib
from dataclasses import dataclass

import numpy as np

from acquisition.errors import FrameLost, ProtocolError
from acquisition.genicam.description import LARGEST

__all__ = [
    "FORMATS",
    "Leader",
    "ManifestEntry",
    "PixelFormat",
    "Trailer",
    "camera_xml",
    "leader",
    "manifest",
    "trailer",
]

ABRM = {"manufacturer": 0x004, "model": 0x044, "family": 0x084, "version": 0x0C4, "serial": 0x144, "user": 0x184,
        "response": 0x1CC, "manifest": 0x1D0, "sbrm": 0x1D8}  # fmt: skip
SBRM = {"version": 0x00, "capability": 0x04, "command": 0x14, "acknowledge": 0x18, "sirm": 0x20}
SIRM = {"info": 0x00, "control": 0x04, "payload": 0x08, "leader": 0x10, "trailer": 0x14, "max_leader": 0x18,
        "transfer": 0x1C, "count": 0x20, "final1": 0x24, "final2": 0x28, "max_trailer": 0x2C}  # fmt: skip
LEADER, TRAILER = 0x4C563355, 0x54563355
LEADER_SIZE, TRAILER_SIZE = 52, 32
MOST_ENTRIES = 64
LARGEST_PAYLOAD = 1 << 28  # bytes of a frame


@dataclass(frozen=True)
class PixelFormat:
    """Name, number, and what a pixel is: bytes of an unsigned integer and the count at saturation."""

    name: str
    code: int
    dtype: np.dtype
    full_scale: int


FORMATS = {
    f.code: f
    for f in (
        PixelFormat("Mono8", 0x01080001, np.dtype("u1"), 255),
        PixelFormat("Mono10", 0x01100003, np.dtype("<u2"), 1023),
        PixelFormat("Mono12", 0x01100005, np.dtype("<u2"), 4095),
        PixelFormat("Mono16", 0x01100007, np.dtype("<u2"), 65535),
    )
}


@dataclass(frozen=True)
class ManifestEntry:
    """Where a camera's XML lies: address, bytes, whether it is zipped, and its SHA-1 (empty for none)."""

    address: int
    size: int
    zipped: bool
    sha1: bytes
    schema: tuple[int, int]


def manifest(raw: bytes) -> list[ManifestEntry]:
    """Entries of a manifest table, after its count; ProtocolError where the table makes no sense."""
    if len(raw) % 64 or not 0 < len(raw) <= 64 * MOST_ENTRIES:
        raise ProtocolError(f"a manifest of {len(raw)} bytes holds no whole entries, or more than {MOST_ENTRIES}.")
    found = []
    for start in range(0, len(raw), 64):
        info, address, size = struct.unpack_from("<IQQ", raw, start + 4)
        compression = (info >> 10) & 0x3F
        if info & 7 == 0 and compression in (0, 1) and 0 < size <= LARGEST:
            sha1 = raw[start + 24 : start + 44]
            schema = (info >> 24, (info >> 16) & 0xFF)
            found.append(ManifestEntry(address, size, compression == 1, sha1 if any(sha1) else b"", schema))
    if not found:
        raise ProtocolError("the camera's manifest names no XML that could be read (plain or zipped, 16 MiB at most).")
    return found


def camera_xml(entry: ManifestEntry, raw: bytes) -> bytes:
    """The XML of an entry, unzipped; ProtocolError for a wrong checksum, a damaged archive or one that is too large."""
    if len(raw) != entry.size:
        raise ProtocolError(f"the camera's XML has {len(raw)} bytes where its manifest states {entry.size}.")
    if entry.sha1 and hashlib.sha1(raw, usedforsecurity=False).digest() != entry.sha1:
        raise ProtocolError("the camera's XML does not have the checksum that its manifest states.")
    if not entry.zipped:
        return raw
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            names = archive.infolist()
            if len(names) != 1 or names[0].file_size > LARGEST:
                raise ProtocolError("the camera's zipped XML must be one file of at most 16 MiB.")
            with archive.open(names[0]) as file:
                found = file.read(LARGEST + 1)
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError, ValueError,
            struct.error) as error:  # fmt: skip
        raise ProtocolError(f"the camera's zipped XML cannot be unpacked: {error}.") from error
    if len(found) > LARGEST:
        raise ProtocolError("the camera's zipped XML has more than 16 MiB.")
    return found


@dataclass(frozen=True)
class Leader:
    """What comes before a frame: block number, time (ns), pixel format, size, bytes of padding after each row."""

    block: int
    time: int
    format: int
    width: int
    height: int
    x: int
    y: int
    padding: int


def leader(raw: bytes | memoryview) -> Leader:
    """A frame's leader; FrameLost where it is not one of an image."""
    if len(raw) < LEADER_SIZE:
        raise FrameLost(f"a leader of {len(raw)} bytes where {LEADER_SIZE} must be.")
    magic, _, size, block = struct.unpack_from("<IHHQ", raw)
    if magic != LEADER:
        raise FrameLost(f"a frame begins with {magic:#010x}, not {LEADER:#010x}.")
    kind = struct.unpack_from("<H", raw, 18)[0]
    if not LEADER_SIZE <= size <= len(raw) or kind != 0x0001:
        raise FrameLost(f"a leader states {size} bytes and payload type {kind:#06x}; plain images are read.")
    time, code, width, height, x, y, padding = struct.unpack_from("<QIIIIIH", raw, 20)
    return Leader(block, time, code, width, height, x, y, padding)


@dataclass(frozen=True)
class Trailer:
    """What comes after a frame: block number, status (0: whole), bytes of payload, rows."""

    block: int
    status: int
    payload: int
    height: int


def trailer(raw: bytes | memoryview) -> Trailer:
    """A frame's trailer; FrameLost where it is not one."""
    if len(raw) < TRAILER_SIZE:
        raise FrameLost(f"a trailer of {len(raw)} bytes where {TRAILER_SIZE} must be.")
    magic, _, size, block, status, _, payload, height = struct.unpack_from("<IHHQHHQI", raw)
    if magic != TRAILER:
        raise FrameLost(f"a frame ends with {magic:#010x}, not {TRAILER:#010x}.")
    if not TRAILER_SIZE <= size <= len(raw):
        raise FrameLost(f"a trailer of {len(raw)} bytes states {size}.")
    return Trailer(block, status, payload, height)
