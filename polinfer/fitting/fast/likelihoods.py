"""The log likelihood as a function of the overlap and the energy, for each kind of gain and noise.

Each class gives, element-wise, the value formed from residuals (no large numbers cancel), and the derivatives by
``r``, the overlap turned to the phase of the gain, by the energy ``m``, and across the phase. Compiled code takes their
numbers as arguments: one that holds for a gain of any size.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ...circular import bessel_ratio, log_scaled_bessel
from ...gain import ComplexGain, PhaseGain
from ...model import Model
from ...noise import KnownNoise
from .known import ZERO, Known
from .point import Pair, unit

__all__ = ["Complex", "Likelihood", "Phase", "Residual", "Slopes", "Unit", "likelihood"]


class Residual(NamedTuple):
    """At a matrix M = J R: the gain used (real and imaginary part), ``|g M - Y|^2``, ``|M|^2`` and the overlap."""

    gain: Pair
    square: Any
    energy: Any
    overlap: Pair


class Slopes(NamedTuple):
    """Derivatives of the log likelihood; ``across`` is the curvature along the overlap's other component.

    An entry that is always 0 is None.
    """

    r: Any
    m: Any
    rr: Any = None
    rm: Any = None
    mm: Any = None
    across: Any = None


def _overlap(model: list[list[Pair]], data: list[list[Pair]]) -> Pair:
    pairs = [(m, y) for row, other in zip(model, data, strict=True) for m, y in zip(row, other, strict=True)]
    return (
        sum(m[0] * y[0] + m[1] * y[1] for m, y in pairs),
        sum(m[0] * y[1] - m[1] * y[0] for m, y in pairs),
    )


def _energy(model: list[list[Pair]]) -> Any:
    return sum(x * x + y * y for row in model for x, y in row)


def square(model: list[list[Pair]], data: list[list[Pair]], gain: Pair | None) -> Any:
    total: Any = 0.0
    for row, other in zip(model, data, strict=True):
        for (x, y), (a, b) in zip(row, other, strict=True):
            re, im = (x, y) if gain is None else (x * gain[0] - y * gain[1], x * gain[1] + y * gain[0])
            total = total + (re - a) ** 2 + (im - b) ** 2
    return total


@partial(jax.tree_util.register_dataclass, data_fields=[], meta_fields=[])
@dataclass(frozen=True)
class Unit:
    """g = 1 and sigma known: ``-|M - Y|^2``."""

    free_phase = False

    def residual(self, model: list[list[Pair]], data: list[list[Pair]]) -> Residual:
        """What the other methods need of a matrix."""
        return Residual((Known(1.0), ZERO), square(model, data, None), None, (ZERO, ZERO))

    def value(self, at: Residual) -> Any:
        """Log likelihood without the statistics' constant."""
        return -at.square

    def slopes(self, at: Residual) -> Slopes:  # noqa: ARG002
        """Its derivatives."""
        return Slopes(2.0, -1.0)

    def mean_gain(self, at: Residual) -> Pair | None:  # noqa: ARG002
        """Posterior mean of the gain, None: there is none."""
        return None


@partial(jax.tree_util.register_dataclass, data_fields=[], meta_fields=[])
@dataclass(frozen=True)
class Phase:
    """``|g| = 1``, phase uniform: ``log I_0(2 |a|) - m - |Y|^2``."""

    free_phase = True

    def residual(self, model: list[list[Pair]], data: list[list[Pair]]) -> Residual:
        """What the other methods need of a matrix."""
        a = _overlap(model, data)
        gain = unit(*a)
        return Residual(gain, square(model, data, gain), _energy(model), a)

    def value(self, at: Residual) -> Any:
        """Log likelihood without the statistics' constant."""
        return -at.square + log_scaled_bessel(2 * self._size(at))

    def _size(self, at: Residual) -> Any:
        return at.overlap[0] * at.gain[0] + at.overlap[1] * at.gain[1]

    def slopes(self, at: Residual) -> Slopes:
        """Its derivatives."""
        x = 2 * self._size(at)
        far = x > 20.0
        safe = jnp.where(x > 1e-3, x, 1.0)
        inverse = 1 / safe
        ratio = bessel_ratio(x)
        # 1 - A/x - A^2 cancels at large x, and A/x is 1/2 at 0
        over = jnp.where(x > 1e-3, ratio * inverse, 0.5)
        series = 0.5 + inverse * (0.25 + inverse * (0.375 + inverse * (0.78125 + inverse * 2.03125)))
        bend = jnp.where(far, inverse * inverse * series, 1 - over - ratio * ratio)
        return Slopes(2 * ratio, -1.0, rr=4 * bend, across=4 * over)

    def mean_gain(self, at: Residual) -> Pair:
        """Posterior mean of the gain."""
        ratio = bessel_ratio(2 * self._size(at))
        return at.gain[0] * ratio, at.gain[1] * ratio


@partial(jax.tree_util.register_dataclass, data_fields=["precision"], meta_fields=[])
@dataclass(frozen=True)
class Complex:
    """``g ~ CN(0, t^2)``: ``|a|^2 / (m + 1/t^2) - log(1 + t^2 m) - |Y|^2``; ``precision`` is 1/t^2."""

    precision: Any
    free_phase = True

    def residual(self, model: list[list[Pair]], data: list[list[Pair]]) -> Residual:
        """What the other methods need of a matrix."""
        a, m = _overlap(model, data), _energy(model)
        weight = 1 / (m + self.precision)
        gain = (a[0] * weight, a[1] * weight)
        return Residual(gain, square(model, data, gain), m, a)

    def value(self, at: Residual) -> Any:
        """Log likelihood without the statistics' constant."""
        penalty = self.precision * (at.gain[0] * at.gain[0] + at.gain[1] * at.gain[1])
        return -at.square - penalty - jnp.log1p(at.energy / self.precision)

    def slopes(self, at: Residual) -> Slopes:
        """Its derivatives."""
        weight = 1 / (at.energy + self.precision)
        r = jnp.sqrt(at.overlap[0] * at.overlap[0] + at.overlap[1] * at.overlap[1])
        size = r * weight
        return Slopes(
            2 * size, -size * size - weight, 2 * weight, -2 * size * weight,
            (2 * size * size + weight) * weight, 2 * weight,
        )  # fmt: skip

    def mean_gain(self, at: Residual) -> Pair:
        """Posterior mean of the gain."""
        return at.gain


Likelihood = Unit | Phase | Complex


def likelihood(model: Model) -> Likelihood | None:
    """The likelihood of a model, or None where there is no fast form."""
    if type(model.noise) is not KnownNoise:
        return None
    if model.gain is None:
        return Unit()
    if type(model.gain) is PhaseGain:
        return Phase()
    if type(model.gain) is ComplexGain:
        return Complex(1 / model.gain.scale**2)
    return None
