"""From raw intensity images of a fibre bundle to Jones data."""

from fibre.bundle import Bundle
from fibre.propagation import angular_spectrum
from fibre.records import (
    Calibration,
    CalibrationFields,
    Defocus,
    Diversity,
    Fibrelets,
    Images,
    Interference,
    Inverse,
    Recording,
    RecordingFields,
    RetrievalStatus,
    Retrieved,
)
from fibre.retrieval.base import retrieve
from fibre.retrieval.gerchberg_saxton import GerchbergSaxton
from fibre.fibrelets import find_fibrelets
from fibre.fields import retrieve_fields
from fibre.interference import relative_phase
from fibre.reconstruction import reconstruct
from fibre.recovery.base import recover
from fibre.recovery.ridge import Ridge
