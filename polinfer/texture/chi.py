"""The chi distribution of the amplitudes in a window."""

from __future__ import annotations

from dataclasses import dataclass
from math import lgamma, log

import numpy as np

from ..checks import integer
from .base import Distribution, Found, Wanted

__all__ = ["Chi"]


@dataclass(frozen=True)
class Chi(Distribution):
    r"""Amplitudes: the length of a vector of ``degrees`` independent Gaussians of mean 0 and deviation s.

    ``p(x) = 2 (x / s sqrt 2)^k e^{-x^2 / 2 s^2} / (x Gamma(k / 2))``, with k = ``degrees``, x >= 0. One degree is the
    absolute value of a Gaussian, two are those of a complex Gaussian (Rayleigh). The most probable s^2 is the mean of
    ``x^2 / k``. Its logarithm, and s itself, are biased by factors that depend on n k only, known exactly: expectation
    and entropy are without bias for independent pixels.

    Parameters
    ----------
    degrees: integer >= 1, else ValueError, TypeError.

    Notes
    -----
    Noise of standard deviation s_j in pixel j adds the mean of s_j^2 to that of x^2, and is subtracted from it. The
    entropy of the noise is that of the absolute value of a Gaussian as wide.
    """

    degrees: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "degrees", integer("degrees", self.degrees, low=1))

    def outside(self, values: np.ndarray) -> np.ndarray | None:
        return np.asarray(values < 0)

    @property
    def allowed(self) -> str:
        return ">= 0; pass an amplitude"

    def features(self, noisy: bool) -> int:
        return 3 if noisy else 2

    def load(self, values: np.ndarray, noise: np.ndarray | None, used: np.ndarray, out: np.ndarray) -> None:
        np.multiply(values * values, used, out=out[0])
        if noise is not None:
            np.multiply(noise * noise, used, out=out[1])
        np.copyto(out[-1], used)

    def finish(self, sums: np.ndarray, spare: np.ndarray, noisy: bool, wanted: Wanted) -> Found:  # noqa: ARG002
        from scipy.special import digamma, gammaln

        k, count = self.degrees, sums[-1]
        seen = sums[0] / count
        blurred = sums[1] / count if noisy else 0.0
        half = 0.5 * k * count
        variance = np.maximum(seen - blurred, 0) / k
        # noise makes the logarithm of the variance more uncertain; beyond a factor of 4 a first order says no more
        excess = np.minimum((seen / (k * variance)) ** 2, 4.0) if noisy else 1.0
        mean = entropy = noise = None
        if wanted.entropy:
            correction = excess * (np.log(half) - digamma(half))
            entropy = 0.5 * (np.log(variance) + correction) + _standard_entropy(k)
        if wanted.expectation:
            unbiased = np.exp(gammaln(half) - gammaln(half + 0.5)) * np.sqrt(half)
            mean = np.sqrt(2 * variance) * np.exp(lgamma(0.5 * (k + 1)) - lgamma(0.5 * k)) * unbiased
        if noisy:
            noise = 0.5 * np.log(blurred) + _standard_entropy(1)
        return Found(mean, entropy, count, noise)


def _standard_entropy(k: int) -> float:
    from scipy.special import digamma

    return float(lgamma(0.5 * k) + 0.5 * (k - log(2) - (k - 1) * digamma(0.5 * k)))
