"""The shipped priors as functions of the five unit vectors.

A von Mises density, axial or not, is ``k cos(n y - t)`` in the angle y of its parameter, with n = 1, 2 or 4; a normal
density of D is quadratic in ``D = sin 2 y0``. What describes the same elements by other parameters has the same form
with another t, so that the prior of every equivalent copy is known at the point itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, isclose, log, pi, sin
from typing import Any

import numpy as np

from ...model import Model
from ...priors import AxialVonMises, TruncatedNormal, UniformAngle, VonMises
from ...records import PERIODS, RANGES, Parameters
from .point import Point

__all__ = ["COPIES", "Flat", "Harmonic", "Normal", "Term", "copies", "log_prior", "term", "terms"]

# y = factor * parameter (not for D)
FACTORS = Parameters(np.nan, 2.0, 0.5, 2.0, 1.0)
# The copies of polinfer.orbit as y -> sign * y + shift of every angle, in its order.
_RETARDERS = (
    ((1, 0.0), (1, 0.0), (1, 0.0)),
    ((-1, 0.0), (1, pi), (1, 0.0)),
    ((1, 0.0), (-1, 0.0), (1, pi)),
    ((-1, 0.0), (-1, pi), (1, pi)),
)
_POLARISERS = (((1, 0.0), (1, 0.0)), ((-1, 0.0), (1, pi)))
COPIES = tuple((*p, *r) for p in _POLARISERS for r in _RETARDERS)


@dataclass(frozen=True)
class Flat:
    """A constant density."""

    constant: float

    def transformed(self, sign: int, shift: float) -> Flat:  # noqa: ARG002
        """The same density seen from a copy."""
        return self

    def evaluate(self, pair: Any) -> tuple[Any, Any, Any] | None:  # noqa: ARG002
        """Log density up to the constant, and its first and second derivative by y; None: all 0."""
        return None


@dataclass(frozen=True)
class Harmonic:
    """``strength * cos(order * y - phase)``."""

    constant: float
    order: int
    phase: float
    strength: float

    def transformed(self, sign: int, shift: float) -> Harmonic:
        """``y -> sign * y + shift`` in place of y."""
        phase = sign * (self.phase - self.order * shift)
        return replace(self, phase=round(phase - 2 * pi * np.ceil(phase / (2 * pi) - 0.5), 12) + 0.0)

    def evaluate(self, pair: Any) -> tuple[Any, Any, Any]:
        """Log density up to the constant, and its first and second derivative by y."""
        c, s = pair
        for _ in range(self.order.bit_length() - 1):  # the order is a power of 2
            c, s = c * c - s * s, 2 * c * s
        cosine = self.strength * (c * cos(self.phase) + s * sin(self.phase))
        sine = self.strength * (s * cos(self.phase) - c * sin(self.phase))
        return cosine, -self.order * sine, -(self.order**2) * cosine


@dataclass(frozen=True)
class Normal:
    """``-(D - mean)^2 / (2 scale^2)`` with ``D = sin 2 y``."""

    constant: float
    mean: float
    scale: float

    def transformed(self, sign: int, shift: float) -> Normal:  # noqa: ARG002
        """The same density seen from a copy, whose D may have the other sign."""
        return replace(self, mean=sign * self.mean + 0.0)

    def evaluate(self, pair: Any) -> tuple[Any, Any, Any]:
        """Log density up to the constant, and its first and second derivative by y."""
        c, s = pair
        value, slope = 2 * s * c, 2 * (c * c - s * s)
        weight = 1 / self.scale**2
        off = value - self.mean
        return -0.5 * weight * off * off, -weight * off * slope, -weight * (slope * slope - 4 * off * value)


Term = Flat | Harmonic | Normal


def term(name: str, prior: Any) -> Term | None:
    """The prior of a parameter in its angle y, None if it has none of these forms."""
    low, high = getattr(RANGES, name)
    if name == "diattenuation":
        if type(prior) is TruncatedNormal and (prior.low, prior.high) == (low, high):
            return Normal(prior.log_peak, prior.mean, prior.scale)
        if type(prior) is UniformAngle and isclose(prior.period, high - low):
            return Flat(-log(prior.period))
        return None
    factor, period = getattr(FACTORS, name), getattr(PERIODS, name)
    if type(prior) is UniformAngle and isclose(prior.period, period):
        return Flat(-log(prior.period))
    if type(prior) not in (VonMises, AxialVonMises):
        return None
    own = 1 if type(prior) is VonMises else 2  # the density has the period 2 pi / own
    order = own / factor
    if order not in (1, 2, 4):
        return None
    return Harmonic(
        prior.log_peak - prior.concentration, int(order), own * prior.mean, prior.concentration
    ).transformed(1, 0.0)


def terms(model: Model) -> tuple[Term | None, ...] | None:
    """The prior of every parameter (None: it has none), or None where one has no such form."""
    found: list[Term | None] = []
    for name in Parameters._fields:
        if name not in model.free:
            found.append(None)
            continue
        own = term(name, model.priors[name])
        if own is None:
            return None
        found.append(own)
    return tuple(found)


def copies(prior: tuple[Term | None, ...], rows: np.ndarray) -> list[tuple[Term | None, ...]]:
    """The prior of each of the copies ``rows`` (8,) bool, as a function of the point itself."""
    return [
        tuple(None if t is None else t.transformed(*move) for t, move in zip(prior, copy, strict=True))
        for copy, row in zip(COPIES, rows, strict=True)
        if row
    ]


def log_prior(prior: tuple[Term | None, ...], point: Point) -> Any:
    """Log density up to the constants."""
    values = [t.evaluate(pair) for t, pair in zip(prior, point, strict=True) if t is not None]
    return sum((v[0] for v in values if v is not None), start=0.0)
