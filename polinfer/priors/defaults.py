"""The priors that hold where a model names no other."""

from __future__ import annotations

from math import pi

from .base import Prior
from .truncated_normal import TruncatedNormal
from .uniform_angle import UniformAngle
from .von_mises import VonMises

__all__ = ["default_priors"]


def default_priors() -> dict[str, Prior]:
    """Default prior of each of the five parameters, by its name.

    Angles of axes and the retardance are uniform, the circularity is ``VonMises(0, 1)`` (linear birefringence is more
    likely than circular) and the diattenuation ``TruncatedNormal(0, 0.5, -1, 1)``.

    >>> default_priors()["circularity"]
    VonMises(mean=0.0, concentration=1.0)
    """
    return {
        "diattenuation": TruncatedNormal(0.0, 0.5, -1.0, 1.0),
        "diattenuation_angle": UniformAngle(pi),
        "retardance": UniformAngle(2 * pi),
        "retardance_angle": UniformAngle(pi),
        "circularity": VonMises(0.0, 1.0),
    }
