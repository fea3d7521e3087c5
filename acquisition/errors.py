"""Everything that devices and runs can raise. What happened comes first, then what to do about it.

AcquisitionError
  DeviceAbsent      no such device              DeviceForbidden   there, but this user may not open it
  DeviceBusy        another program has it      DeviceLost        it was there and is gone
  DeviceTimeout     no answer in time           ProtocolError     an answer that the protocol does not allow
    DeviceStalled   an endpoint that halted     DeviceRefused     a well-formed no: never worth a repetition
  SettingError      a value out of range        FrameLost         an image that did not arrive whole
  RunMismatch       a folder of another run
"""

from __future__ import annotations

__all__ = [
    "AcquisitionError",
    "DeviceAbsent",
    "DeviceBusy",
    "DeviceForbidden",
    "DeviceLost",
    "DeviceRefused",
    "DeviceStalled",
    "DeviceTimeout",
    "FrameLost",
    "ProtocolError",
    "RunMismatch",
    "SettingError",
]


class AcquisitionError(Exception):
    """The root: catch this to catch everything that a device or a run can do wrong."""


class DeviceAbsent(AcquisitionError):
    """No device with this serial number is connected."""


class DeviceForbidden(AcquisitionError):
    """The device is there, but this user may not open it."""


class DeviceBusy(AcquisitionError):
    """Another program or driver holds the device, or the system has no memory left for transfers."""


class DeviceLost(AcquisitionError):
    """The device was there and is gone: unplugged, or without power."""


class DeviceTimeout(AcquisitionError):
    """No answer in time."""


class DeviceStalled(DeviceTimeout):
    """An endpoint has halted and must be cleared; the transfer can be repeated."""


class ProtocolError(AcquisitionError):
    """Bytes that the protocol does not allow here. They are never used."""


class DeviceRefused(AcquisitionError):
    """The device understood and said no. ``status``: its code."""

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status


class SettingError(AcquisitionError, ValueError):
    """A value that a setting cannot take, or a setting that cannot be written now."""


class FrameLost(AcquisitionError):
    """A frame did not arrive whole: discarded by the camera, cut short, or skipped."""


class RunMismatch(AcquisitionError, ValueError):
    """A folder that another plan or other devices have begun."""
