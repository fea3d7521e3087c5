"""Two illumination arms that are not parallel: what a scene may declare about them."""

from .base import Misalignment
from .rotated_basis import RotatedBasis
from .tilt_plane import Tilt, TiltPlane

__all__ = ["Misalignment", "RotatedBasis", "Tilt", "TiltPlane"]
