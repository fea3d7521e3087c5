from .bench.devices import Bench
from .bench.modulators import ModulatorModel
from .bench.scene import CameraModel, Scene
from .bench.simulator import SimulatedBench
from .contracts import AnyBench, Camera, Device, Frame, Instrument, PhaseModulator, Shown
from .display import DisplayModulator
from .errors import (
    AcquisitionError,
    DeviceAbsent,
    DeviceBusy,
    DeviceForbidden,
    DeviceLost,
    DeviceRefused,
    DeviceStalled,
    DeviceTimeout,
    FrameLost,
    ProtocolError,
    RunMismatch,
    SettingError,
)
from .exposure import Bracket, InverseVariance, LongestUnsaturated
from .merging import Merged, merge_exposures
from .photons import PhotonTransfer, photon_transfer
from .plan import (
    CalibrationPlan,
    GridPlan,
    PatternPlan,
    SamplePlan,
    Step,
    Timing,
    Upgrade,
    Views,
    elliptical_states,
    upgrades,
)
from .reporting import write_report
from .run import calibrate, capture
from .settings import Setting, Written
from .simulated import SimulatedCamera, SimulatedInstrument, SimulatedModulator
from .streaming import FibreImager, Imager, StreamedFrame, stream
from .usb.camera import Usb3VisionCamera
from .usb.discovery import Found, list_devices
from .usb.dlpc900 import Dlpc900Modulator
from .usb.instrument import PowerMeter, Retarder, RotationMount, Scpi, UsbtmcInstrument

__all__ = [
    "AcquisitionError",
    "AnyBench",
    "Bench",
    "Bracket",
    "CalibrationPlan",
    "Camera",
    "CameraModel",
    "Device",
    "DeviceAbsent",
    "DeviceBusy",
    "DeviceForbidden",
    "DeviceLost",
    "DeviceRefused",
    "DeviceStalled",
    "DeviceTimeout",
    "DisplayModulator",
    "Dlpc900Modulator",
    "FibreImager",
    "Found",
    "Frame",
    "FrameLost",
    "GridPlan",
    "Imager",
    "Instrument",
    "InverseVariance",
    "LongestUnsaturated",
    "Merged",
    "ModulatorModel",
    "PatternPlan",
    "PhaseModulator",
    "PhotonTransfer",
    "PowerMeter",
    "ProtocolError",
    "Retarder",
    "RotationMount",
    "RunMismatch",
    "SamplePlan",
    "Scene",
    "Scpi",
    "Setting",
    "SettingError",
    "Shown",
    "SimulatedBench",
    "SimulatedCamera",
    "SimulatedInstrument",
    "SimulatedModulator",
    "Step",
    "StreamedFrame",
    "Timing",
    "Upgrade",
    "Usb3VisionCamera",
    "UsbtmcInstrument",
    "Views",
    "Written",
    "calibrate",
    "capture",
    "elliptical_states",
    "list_devices",
    "merge_exposures",
    "photon_transfer",
    "stream",
    "upgrades",
    "write_report",
]
