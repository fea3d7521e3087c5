"""Texture: mean and disorder of the pixels in a sliding window."""

from .angles import Angle, Rescaled, von_mises_entropy
from .base import Distribution
from .bounded import Bounded
from .chi import Chi
from .filters import cooccurrence_entropy, describe, entropy, expectation
from .fits import of_fit
from .joint import Joint, MultivariateVonMises, TorusGraph
from .records import FitTexture, Texture

__all__ = [
    "Angle",
    "Bounded",
    "Chi",
    "Distribution",
    "FitTexture",
    "Joint",
    "MultivariateVonMises",
    "Rescaled",
    "Texture",
    "TorusGraph",
    "cooccurrence_entropy",
    "describe",
    "entropy",
    "expectation",
    "of_fit",
    "von_mises_entropy",
]
