from . import contrast, conventions, datasets, phantoms, texture
from .bounds import cramer_rao_bound, tilt_bound
from .chunked import Stored, fit_stored
from .comparison import Comparison, compare, ordering_screen, power, select
from .decomposition import decompose, ordering_error
from .degeneracy import canonicalise, orbit
from .files import load
from .fitting import fit
from .gain import ComplexGain, PhaseGain
from .gauge import smooth_gauge
from .misalignment import RotatedBasis, TiltPlane
from .model import Model
from .neighbours import Window
from .noise import InferredNoise, KnownNoise
from .orderings import Ordering, PolariserFirst, RetarderFirst
from .priors import AxialVonMises, Prior, TruncatedNormal, UniformAngle, VonMises
from .records import Fit, Measurement, Parameters, Status
from .sampling import Draws, Ensemble, Gibbs, calibration_ranks, sample, summarise
from .simulation import simulate
from .storage import save
from .tilting import untilt

__all__ = [
    "AxialVonMises",
    "Comparison",
    "ComplexGain",
    "Draws",
    "Ensemble",
    "Fit",
    "Gibbs",
    "InferredNoise",
    "KnownNoise",
    "Measurement",
    "Model",
    "Ordering",
    "Parameters",
    "PhaseGain",
    "PolariserFirst",
    "Prior",
    "RetarderFirst",
    "RotatedBasis",
    "Status",
    "Stored",
    "TiltPlane",
    "TruncatedNormal",
    "UniformAngle",
    "VonMises",
    "Window",
    "calibration_ranks",
    "canonicalise",
    "compare",
    "contrast",
    "conventions",
    "cramer_rao_bound",
    "datasets",
    "decompose",
    "fit",
    "fit_stored",
    "load",
    "orbit",
    "ordering_error",
    "ordering_screen",
    "phantoms",
    "power",
    "sample",
    "save",
    "select",
    "simulate",
    "smooth_gauge",
    "summarise",
    "texture",
    "tilt_bound",
    "untilt",
]
