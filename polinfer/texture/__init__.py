"""Texture: mean and disorder of the pixels in a sliding window."""

from .angles import Angle, Rescaled, von_mises_entropy
from .base import Distribution
from .bounded import Bounded
from .chi import Chi
from .filters import Texture, cooccurrence_entropy, describe, entropy, expectation
from .joint import Joint, MultivariateVonMises, TorusGraph

__all__ = [
    "Angle",
    "Bounded",
    "Chi",
    "Distribution",
    "Joint",
    "MultivariateVonMises",
    "Rescaled",
    "Texture",
    "TorusGraph",
    "cooccurrence_entropy",
    "describe",
    "entropy",
    "expectation",
    "von_mises_entropy",
]
