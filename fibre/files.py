"""Which types a file of this package may be made of."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fibre.ageing import Staleness
from fibre.bundle import Bundle
from fibre.drift import Drift
from fibre.imaging import TransmissionImage
from fibre.records import (
    Calibration,
    CalibrationFields,
    Diversity,
    Fibrelets,
    Images,
    Interference,
    Inverse,
    Recording,
    RecordingFields,
    Retrieved,
)
from fibre.registration import Registration
from polinfer import storage
from polinfer.files import TYPES as BELOW
from polinfer.storage import save

__all__ = ["TYPES", "load", "save"]

TYPES: tuple[type, ...] = (
    Bundle,
    Calibration,
    CalibrationFields,
    Diversity,
    Drift,
    Fibrelets,
    Images,
    Interference,
    Inverse,
    Recording,
    RecordingFields,
    Registration,
    Retrieved,
    Staleness,
    TransmissionImage,
)


def load(path: str | Path, classes: tuple[type, ...] = ()) -> Any:
    """The record of this package, or of polinfer, that ``save`` wrote to ``path`` (``.nc`` or ``.zarr``).

    ``classes`` are types of your own that the record holds.

    Raises
    ------
    FileNotFoundError: nothing there. ValueError: a foreign, damaged or newer file, or a type that was not offered.

    >>> import tempfile
    >>> import numpy as np
    >>> from fibre import Fibrelets, save
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = save(Fibrelets(np.zeros((1, 2)), 1.6e-6), Path(folder) / "fibrelets.nc")
    ...     load(path).mode_radius.tolist()
    [1.6e-06]
    """
    return storage.load(path, (*BELOW, *TYPES, *classes))
