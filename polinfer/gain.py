"""The global complex factor g of a measured matrix, integrated out.

Each class works on data in units of sigma: ``M = J R`` and ``Y`` are complex ``(..., 2, 2)`` with
``log p(Y | M, g) = -|g M - Y|^2``. The integrals are written around the best gain, so that no large numbers cancel.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .checks import real_number
from .circular import bessel_ratio, log_scaled_bessel
from .power_means import log_gain_mean, log_phase_mean

__all__ = ["ComplexGain", "Gain", "PhaseGain", "UnitGain"]


def _square(x: jax.Array) -> jax.Array:
    return jnp.sum(jnp.real(x) ** 2 + jnp.imag(x) ** 2, axis=(-1, -2))


def _product(model: jax.Array, data: jax.Array) -> jax.Array:
    return jnp.sum(jnp.conj(model) * data, axis=(-1, -2))


class Gain(ABC):
    """What a kind of gain must offer; ``real_parameters`` is how many real numbers the data have to determine."""

    real_parameters: int
    free_phase: bool

    @abstractmethod
    def best(self, model: jax.Array, data: jax.Array) -> jax.Array:
        """The most probable gain."""

    @abstractmethod
    def mean(self, model: jax.Array, data: jax.Array) -> jax.Array:
        """The posterior mean of the gain."""

    @abstractmethod
    def log_marginal(self, model: jax.Array, data: jax.Array) -> jax.Array:
        """Log of the integral of ``exp(-|g M - Y|^2) p(g)`` over g."""

    @abstractmethod
    def log_power_mean(self, model: jax.Array, data: jax.Array, rest: jax.Array, power: jax.Array) -> jax.Array:
        """Log of the integral of ``(1 + rest + |g M - Y|^2)^-power p(g)`` over g: what unknown noise asks for."""

    @abstractmethod
    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Independent complex draws from the prior."""


@dataclass(frozen=True)
class UnitGain(Gain):
    """g = 1: what ``Model(gain=None)`` means.

    >>> UnitGain().sample(np.random.default_rng(0), ()).item()
    (1+0j)
    """

    real_parameters = 0
    free_phase = False

    def best(self, model: jax.Array, data: jax.Array) -> jax.Array:
        return jnp.ones(jnp.broadcast_shapes(model.shape, data.shape)[:-2], model.dtype)

    def mean(self, model: jax.Array, data: jax.Array) -> jax.Array:
        return self.best(model, data)

    def log_marginal(self, model: jax.Array, data: jax.Array) -> jax.Array:
        return -_square(model - data)

    def log_power_mean(self, model: jax.Array, data: jax.Array, rest: jax.Array, power: jax.Array) -> jax.Array:
        return -power * jnp.log1p(rest + _square(model - data))

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:  # noqa: ARG002
        return np.ones(shape, complex)


@dataclass(frozen=True)
class PhaseGain(Gain):
    """``|g| = 1`` with a uniform phase, one for each pixel.

    With ``a = <M, Y>`` and ``alpha = arg a`` the marginal is
    ``-|e^{i alpha} M - Y|^2 + log(I_0(2 |a|) e^{-2 |a|})`` (data in units of sigma).

    >>> abs(PhaseGain().sample(np.random.default_rng(0), (3,))).round(6).tolist()
    [1.0, 1.0, 1.0]
    """

    real_parameters = 1
    free_phase = True

    def _overlap(self, model: jax.Array, data: jax.Array) -> tuple[jax.Array, jax.Array]:
        overlap = _product(model, data)
        square = jnp.real(overlap) ** 2 + jnp.imag(overlap) ** 2
        dark = square == 0  # no light: any phase fits, and the derivative of |a| does not exist
        size = jnp.sqrt(jnp.where(dark, jnp.ones_like(square), square))
        phase = jnp.where(dark, jnp.ones_like(overlap), overlap / size)
        return phase, jnp.where(dark, jnp.zeros_like(size), size)

    def best(self, model: jax.Array, data: jax.Array) -> jax.Array:
        return self._overlap(model, data)[0]

    def mean(self, model: jax.Array, data: jax.Array) -> jax.Array:
        phase, size = self._overlap(model, data)
        return phase * bessel_ratio(2 * size)

    def log_marginal(self, model: jax.Array, data: jax.Array) -> jax.Array:
        phase, size = self._overlap(model, data)
        return -_square(phase[..., None, None] * model - data) + log_scaled_bessel(2 * size)

    def log_power_mean(self, model: jax.Array, data: jax.Array, rest: jax.Array, power: jax.Array) -> jax.Array:
        phase, size = self._overlap(model, data)
        least = rest + _square(phase[..., None, None] * model - data)
        return log_phase_mean(power, 4 * size / (1 + least)) - power * jnp.log1p(least)

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        return np.asarray(np.exp(2j * np.pi * rng.uniform(size=shape)))


@dataclass(frozen=True)
class ComplexGain(Gain):
    """``g ~ CN(0, scale^2)``, one for each pixel: amplitude and phase unknown, ``E|g|^2 = scale^2``.

    With ``m = |M|^2`` and ``ghat = <M, Y> / (m + 1/scale^2)`` the marginal is
    ``-|ghat M - Y|^2 - |ghat|^2/scale^2 - log(1 + scale^2 m)`` (data in units of sigma; gain without unit).

    Parameters
    ----------
    scale: > 0, root mean square of the amplitude, in units of response over illumination. Else ValueError.

    >>> ComplexGain(2).scale
    2.0
    """

    scale: float

    real_parameters = 2
    free_phase = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "scale", real_number("scale", self.scale, above=0))

    def best(self, model: jax.Array, data: jax.Array) -> jax.Array:
        return _product(model, data) / (_square(model) + 1 / self.scale**2)

    def mean(self, model: jax.Array, data: jax.Array) -> jax.Array:
        return self.best(model, data)

    def log_marginal(self, model: jax.Array, data: jax.Array) -> jax.Array:
        gain = self.best(model, data)
        penalty = (jnp.real(gain) ** 2 + jnp.imag(gain) ** 2) / self.scale**2
        return -_square(gain[..., None, None] * model - data) - penalty - jnp.log1p(self.scale**2 * _square(model))

    def log_power_mean(self, model: jax.Array, data: jax.Array, rest: jax.Array, power: jax.Array) -> jax.Array:
        square = _square(model)
        dark = square == 0
        size = jnp.where(dark, jnp.ones_like(square), square)
        gain = _product(model, data) / size
        signal = size * (jnp.real(gain) ** 2 + jnp.imag(gain) ** 2)
        least = _square(gain[..., None, None] * model - data)
        return log_gain_mean(power, rest + least, jnp.where(dark, 0 * signal, signal), self.scale**2 * square)

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        pair: Any = rng.normal(scale=self.scale / np.sqrt(2), size=(2, *shape))
        return np.asarray(pair[0] + 1j * pair[1])
