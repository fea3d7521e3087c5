"""The von Mises distribution of the angles in a window."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import log, pi
from typing import Any

import numpy as np

from ..checks import real_array, real_number
from .base import Distribution, Found, Wanted

__all__ = ["Angle", "Rescaled", "concentration_of", "von_mises_entropy"]

DEGREES = {np.dtype(np.float32): 12, np.dtype(np.float64): 36}


def von_mises_entropy(concentration: Any) -> np.ndarray:
    r"""Differential entropy of a von Mises distribution of period 2 pi, in nats.

    .. math:: H(\kappa) = \log 2\pi I_0(\kappa) - \kappa\, I_1(\kappa)/I_0(\kappa)

    For an axis, whose period is pi, it is less by log 2. Absolute error below 1e-9 up to a concentration of 1e6.

    Parameters
    ----------
    concentration: >= 0, any shape, without unit.

    Raises
    ------
    ValueError, TypeError: negative, no real numbers.

    >>> round(float(von_mises_entropy(0.0)), 4), round(float(von_mises_entropy(1e6)), 4)
    (1.8379, -5.4888)
    """
    from scipy.special import i0e, i1e

    kappa = real_array("concentration", concentration, low=0).astype(float)
    scaled = i0e(kappa)
    return np.asarray(np.log(2 * pi * scaled) + kappa * (1 - i1e(kappa) / scaled))


def concentration_of(resultant: np.ndarray) -> np.ndarray:
    """Concentration of the von Mises distribution with this mean resultant length, 0 to 1 (where it is infinite).

    Newton's iteration from the approximation of Best and Fisher (1981); relative error below 1e-9 up to 1e5.
    """
    from scipy.special import i0e, i1e

    r = np.asarray(resultant, float)
    with np.errstate(all="ignore"):
        kappa = np.where(
            r < 0.53, r * (2 + r**2 * (1 + 5 / 6 * r**2)),
            np.where(r < 0.85, -0.4 + 1.39 * r + 0.43 / (1 - r), 1 / (r * (1 - r) * (3 - r))),
        )  # fmt: skip
        for _ in range(4):
            ratio = i1e(kappa) / i0e(kappa)
            slope = 1 - ratio * (ratio + 1 / np.where(kappa > 0, kappa, 1))
            step = np.where((kappa > 0) & (kappa < 1e5), (ratio - r) / slope, 0)
            kappa = kappa - np.clip(step, -kappa, 0.5 * kappa)
    return np.where(r < 1, kappa, np.where(r >= 1, np.inf, np.nan))


@lru_cache
def _remainder(degree: int) -> tuple[float, ...]:
    """Coefficients in ``1 - 2u`` of ``H - log(u) / 2``, where ``u = 1 - R^2``, R the mean resultant length.

    The function is smooth on [0, 1], from log(2 pi) at u = 1 to log(2 pi e) / 2 at u = 0; the error of degree 12 is
    4e-6, that of 36 is 1e-10.
    """
    from numpy.polynomial import Chebyshev, Polynomial

    def remainder(y: np.ndarray) -> np.ndarray:
        u = 0.5 * (1 - y)
        kappa = concentration_of(np.sqrt(1 - u))
        return von_mises_entropy(kappa) - 0.5 * np.log(u)

    return tuple(Chebyshev.interpolate(remainder, degree).convert(kind=Polynomial).coef)


def _horner(coefficients: tuple[float, ...], x: np.ndarray, out: np.ndarray) -> np.ndarray:
    np.multiply(x, coefficients[-1], out=out)
    for c in coefficients[-2:0:-1]:
        out += c
        out *= x
    out += coefficients[0]
    return out


def _entropy(u: np.ndarray, spare: np.ndarray) -> np.ndarray:
    """Entropy where ``u = 1 - R^2``, into u; minus infinity where u <= 0. ``spare``: two arrays as large."""
    np.maximum(u, 0, out=u)
    np.multiply(u, -2, out=spare[0])
    spare[0] += 1
    _horner(_remainder(DEGREES[u.dtype]), spare[0], spare[1])
    np.log(u, out=u)
    u *= 0.5
    u += spare[1]
    return u


@lru_cache
def _arctangent() -> tuple[float, ...]:
    """Coefficients in t^2 of ``atan(t) / t`` on [0, 1], error 1e-8."""
    from numpy.polynomial import Chebyshev, Polynomial

    def ratio(x: np.ndarray) -> np.ndarray:
        return np.arctan(np.sqrt(x)) / np.sqrt(x)

    return tuple(Chebyshev.interpolate(ratio, 8, domain=[0, 1]).convert(kind=Polynomial).coef)


def _direction(y: np.ndarray, x: np.ndarray, spare: np.ndarray) -> np.ndarray:
    """``arctan2(y, x)``, NaN where both are 0, into x; ``spare``: three arrays as large."""
    if x.dtype != np.float32:
        none = (x == 0) & (y == 0)
        np.arctan2(y, x, out=x)
        x[none] = np.nan
        return x
    # a third of the time of NumPy's, whose single precision is not vectorised everywhere
    a, b, c = spare
    np.abs(y, out=a)
    np.abs(x, out=b)
    steep, backward = a > b, x < 0
    np.minimum(a, b, out=c)
    np.maximum(a, b, out=a)
    c /= a
    np.multiply(c, c, out=a)
    c *= _horner(_arctangent(), a, b)
    for reflected, angle in ((steep, 0.5 * pi), (backward, pi)):
        np.multiply(reflected, np.float32(angle), out=a)
        c -= a
        np.abs(c, out=c)
    return np.copysign(c, y, out=x)


@dataclass(frozen=True)
class Angle(Distribution):
    r"""Angles of a given period, von Mises distributed: ``p(x) = e^{k cos f (x - m)} f / (2 pi I_0(k))``.

    With ``f = 2 pi / period``, C and S the sums of ``cos f x`` and ``sin f x`` over the n pixels of a window, the most
    probable mean is ``arctan2(S, C) / f``, and the concentration that for which ``I_1(k) / I_0(k) = |C + i S| / n``.
    The entropy of that density is too small by ``1 / n`` on average, half the number of fitted parameters over n, as
    that of any exponential family. ``1 / (n - 1)`` is added, which leaves less than 0.001 nat from 25 pixels on.

    Parameters
    ----------
    period: radians, > 0; 2 pi for a direction or a phase, pi for an axis. Else ValueError.

    Notes
    -----
    With noise of standard deviation s in a pixel, the mean of ``e^{i f x}`` over noise and tissue is that of the tissue
    times ``w = e^{-f^2 s^2 / 2}``. Pixels are weighted with w, and ``R = |sum w e^{i f x}| / sum w^2`` is the resultant
    of the tissue alone. The window is worth ``sum w^2`` pixels without noise. Where noise explains all of the
    dispersion (R >= 1), the entropy of the tissue is minus infinity.
    """

    period: float = 2 * pi

    single = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", real_number("period", self.period, above=0))

    @property
    def frequency(self) -> float:
        """Radians of a full circle that one unit of the value makes."""
        return 2 * pi / self.period

    @property
    def single_floor(self) -> float:  # type: ignore[override]
        # concentration 500: 1 - R^2 is 0.002, and rounding 2e-7 in it is 1e-4 nat
        return 0.5 * log(2 * pi / 500) + 0.5 - log(self.frequency)

    def outside(self, values: np.ndarray) -> np.ndarray | None:  # noqa: ARG002
        return None

    @property
    def allowed(self) -> str:
        return "any"

    def features(self, noisy: bool) -> int:
        return 5 if noisy else 3

    def load(self, values: np.ndarray, noise: np.ndarray | None, used: np.ndarray, out: np.ndarray) -> None:
        cosine, sine, count = out[0], out[1], out[-1]
        angle = values if self.frequency == 1 else values * np.asarray(self.frequency, values.dtype)
        np.copyto(count, used)
        np.cos(angle, out=cosine)
        np.sin(angle, out=sine)
        if noise is None:
            cosine *= count
            sine *= count
        else:
            weight = np.exp(-0.5 * (self.frequency * noise) ** 2) * used
            cosine *= weight
            sine *= weight
            np.multiply(weight, weight, out=out[2])
            np.multiply(out[2], out[2], out=out[3])

    def finish(self, sums: np.ndarray, spare: np.ndarray, noisy: bool, wanted: Wanted) -> Found:
        cosine, sine, count = sums[0], sums[1], sums[2]
        entropy = mean = noise = None
        if noisy:
            # mean of the squared resultant of the noise, w^2, over pixels that count w^2
            kept = sums[3] / count
            noise = von_mises_noise(kept) - log(self.frequency)
        if wanted.entropy:
            u = spare[0]
            np.multiply(cosine, cosine, out=u)
            np.multiply(sine, sine, out=spare[1])
            u += spare[1]
            np.multiply(count, count, out=spare[1])
            u /= spare[1]
            np.subtract(1, u, out=u)
            extra = _noise_correction(u, kept) if noisy else None
            entropy = _entropy(u, spare[1:3])
            np.subtract(count, 1, out=spare[1])
            np.divide(1, spare[1], out=spare[1])
            if extra is not None:
                spare[1] *= extra
            if self.frequency != 1:
                spare[1] -= log(self.frequency)
            entropy += spare[1]
        if wanted.expectation:
            mean = _direction(sine, cosine, spare[3:6])
            if self.frequency != 1:
                mean /= self.frequency
        return Found(mean, entropy, count, noise)


def von_mises_noise(kept: np.ndarray) -> np.ndarray:
    """Entropy of von Mises noise whose squared mean resultant length is ``kept``; period 2 pi."""
    u = 1 - np.asarray(kept, float)
    return _entropy(u, np.empty((2, *u.shape)))


def _noise_correction(u: np.ndarray, kept: np.ndarray) -> np.ndarray:
    r"""Factor of the bias ``1 / (N - 1)`` that noise brings, where tissue has ``1 - R^2 = u``.

    The entropy as a function of the mean of ``e^{i f x}`` has the second derivative ``-V^-1``, V the covariance of cos
    and sin of the tissue. What it loses on average is half the trace of ``V^-1`` times the covariance of cos and sin
    with noise. Where noise outweighs tissue a first order says no more: the factor ends at 4.
    """
    u = np.clip(u, 1e-12, 1)
    square = 1 - u
    resultant = np.sqrt(square)
    kappa = concentration_of(resultant)
    ratio = np.where(kappa > 1e-6, resultant / np.where(kappa > 1e-6, kappa, 1), 0.5)
    second = 1 - 2 * ratio
    along, across = 0.5 * (1 + second) - square, ratio
    seen_along = 0.5 * (1 + second * kept**2) - square * kept
    seen_across = 0.5 * (1 - second * kept**2)
    factor = 0.5 * (seen_along / along + seen_across / across)
    return np.minimum(np.where(np.isfinite(factor), factor, 4.0), 4.0)


@dataclass(frozen=True)
class Rescaled(Distribution):
    """Values that are no angles, treated as the small angles ``(x - centre) / scale`` of a von Mises distribution.

    Far from the opposite side of the circle it is a Gaussian, so that such values can stand in a joint distribution
    beside angles. The entropy is that of the values themselves: ``log(scale)`` is added.

    Parameters
    ----------
    centre: where the values lie about. scale: > 0, several times their spread; values beyond ``centre +- pi scale / 2``
        raise ValueError, for they would come round to the other side.

    >>> Rescaled(0.5, 2.0).angle.period == 4 * pi
    True
    """

    centre: float
    scale: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", real_number("centre", self.centre))
        object.__setattr__(self, "scale", real_number("scale", self.scale, above=0))

    @property
    def angle(self) -> Angle:
        """The distribution of ``x - centre``."""
        return Angle(2 * pi * self.scale)

    def outside(self, values: np.ndarray) -> np.ndarray | None:
        return np.asarray(np.abs(values - self.centre) > 0.5 * pi * self.scale)

    @property
    def allowed(self) -> str:
        return f"within pi scale / 2 = {0.5 * pi * self.scale:g} of {self.centre:g}; choose a larger scale or mask them"

    def features(self, noisy: bool) -> int:
        return self.angle.features(noisy)

    def load(self, values: np.ndarray, noise: np.ndarray | None, used: np.ndarray, out: np.ndarray) -> None:
        self.angle.load(values - self.centre, noise, used, out)

    def finish(self, sums: np.ndarray, spare: np.ndarray, noisy: bool, wanted: Wanted) -> Found:
        found = self.angle.finish(sums, spare, noisy, wanted)
        mean = None if found.expectation is None else found.expectation + self.centre
        return replace(found, expectation=mean)
