from . import holograms
from .ageing import Staleness, refresh, staleness, update_matrix
from .bundle import Bundle
from .drift import Drift, track_drift
from .fibrelets import find_fibrelets
from .fields import fibrelets_of, retrieve_fields, retrieve_sample
from .files import load, save
from .imaging import TransmissionImage, transmission_image
from .interference import relative_phase
from .propagation import angular_spectrum
from .reconstruction import reconstruct
from .records import (
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
from .recovery.base import Cost, recover
from .recovery.basis_pursuit import BasisPursuit
from .recovery.denoise import DenoiseStatus, Solution, basis_pursuit_denoise
from .recovery.forward_inverse import ForwardInverse
from .recovery.intensity_only import IntensityOnly
from .recovery.intensity_rows import Rows, RowStatus, rows_from_intensities
from .recovery.ridge import Ridge
from .recovery.weighted_sum import WeightedSum
from .registration import Registration, register_facets
from .retrieval.accelerated import Accelerated
from .retrieval.base import retrieve
from .retrieval.gerchberg_saxton import GerchbergSaxton
from .retrieval.modal import Modal
from .retrieval.transport_of_intensity import TransportOfIntensity
from .transmission import Frame, Transmission

__all__ = [
    "Accelerated",
    "BasisPursuit",
    "Bundle",
    "Calibration",
    "CalibrationFields",
    "Cost",
    "Defocus",
    "DenoiseStatus",
    "Diversity",
    "Drift",
    "Fibrelets",
    "ForwardInverse",
    "Frame",
    "GerchbergSaxton",
    "Images",
    "IntensityOnly",
    "Interference",
    "Inverse",
    "Modal",
    "Recording",
    "RecordingFields",
    "Registration",
    "RetrievalStatus",
    "Retrieved",
    "Ridge",
    "RowStatus",
    "Rows",
    "Solution",
    "Staleness",
    "Transmission",
    "TransmissionImage",
    "TransportOfIntensity",
    "WeightedSum",
    "angular_spectrum",
    "basis_pursuit_denoise",
    "fibrelets_of",
    "find_fibrelets",
    "holograms",
    "load",
    "reconstruct",
    "recover",
    "refresh",
    "register_facets",
    "relative_phase",
    "retrieve",
    "retrieve_fields",
    "retrieve_sample",
    "rows_from_intensities",
    "save",
    "staleness",
    "track_drift",
    "transmission_image",
    "update_matrix",
]
