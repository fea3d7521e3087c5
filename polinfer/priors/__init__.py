"""Prior densities of one parameter: normalised, with a sampler and a support."""

from .axial_von_mises import AxialVonMises
from .base import Prior
from .defaults import default_priors
from .truncated_normal import TruncatedNormal
from .uniform_angle import UniformAngle
from .von_mises import VonMises

__all__ = ["AxialVonMises", "Prior", "TruncatedNormal", "UniformAngle", "VonMises", "default_priors"]
