"""Texture: mean and disorder of the pixels in a sliding window."""

from .angles import Angle, Rescaled, von_mises_entropy
from .base import Distribution
from .bounded import Bounded
from .chi import Chi
from .filters import Texture, describe, entropy, expectation

__all__ = [
    "Angle",
    "Bounded",
    "Chi",
    "Distribution",
    "Rescaled",
    "Texture",
    "describe",
    "entropy",
    "expectation",
    "von_mises_entropy",
]
