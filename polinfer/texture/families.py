"""Which distribution a caller means."""

from __future__ import annotations

from math import pi
from typing import Any

from ..priors import AxialVonMises, Prior, TruncatedNormal, VonMises
from .angles import Angle
from .base import Distribution
from .bounded import Bounded

__all__ = ["FAMILIES", "distribution_of"]

#: The distribution that each class of densities stands for.
FAMILIES: dict[type[Prior], Distribution] = {
    VonMises: Angle(2 * pi),
    AxialVonMises: Angle(pi),
    TruncatedNormal: Bounded(-1.0, 1.0),
}


def distribution_of(name: str, distribution: Any) -> Distribution:
    """The distribution that an argument names: a :class:`Distribution`, or a class of densities in ``FAMILIES``."""
    if isinstance(distribution, Distribution):
        return distribution
    if isinstance(distribution, type) and distribution in FAMILIES:
        return FAMILIES[distribution]
    known = ", ".join(x.__name__ for x in FAMILIES)
    raise TypeError(
        f"{name} must be one of the classes {known}, or an object such as Chi(1), Bounded(low, high), Angle(period) or "
        f"Rescaled(centre, scale), got {distribution!r}."
    )
