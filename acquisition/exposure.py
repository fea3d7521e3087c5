"""High dynamic range from a bracket of exposures.

In: raw frames of one view and their exposure times. Out: radiance with variance and a saturation mask. Called when a
run's raw frames are read.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from polinfer.checks import integer, one_of_types, real_array, real_number

__all__ = ["Bracket", "InverseVariance", "LongestUnsaturated", "MergeRule", "Merged", "merge_exposures"]


@dataclass(frozen=True)
class Bracket:
    """Exposure times from the longest down by a factor until nothing saturates, or until ``stop``.

    longest, stop: seconds, longest >= stop > 0. factor: > 1; the paper uses 2^N with N = 1.

    >>> list(Bracket(longest=0.08, factor=2, stop=0.02).times())
    [0.08, 0.04, 0.02]
    """

    longest: float
    factor: float = 2.0
    stop: float = 1e-4

    def __post_init__(self) -> None:
        # kept as plain floats: a plan's hash must not depend on which kind of number it was given
        object.__setattr__(self, "longest", real_number("longest", self.longest, above=0))
        object.__setattr__(self, "factor", real_number("factor", self.factor, above=1))
        object.__setattr__(self, "stop", real_number("stop", self.stop, above=0, high=self.longest))

    def times(self) -> Any:
        """All exposure times, seconds, longest first."""
        time = self.longest
        while time >= self.stop * (1 - 1e-9):
            yield time
            time /= self.factor


@dataclass(frozen=True)
class Merged:
    """radiance: real (y, x), photo-electrons per second. variance: its variance, infinite where saturated at every
    exposure. saturated: bool (y, x), such pixels; their radiance is only a lower bound."""

    radiance: np.ndarray
    variance: np.ndarray
    saturated: np.ndarray


class MergeRule(ABC):
    """How the unsaturated exposures of a pixel make one radiance."""

    @abstractmethod
    def weights(self, times: np.ndarray, radiance: np.ndarray) -> np.ndarray:
        """Relative weights, real (k, y, x), from exposure times (k,) and a first estimate of radiance (y, x)."""

    @abstractmethod
    def variance(self, times: np.ndarray, radiance: np.ndarray) -> np.ndarray:
        """Variance of counts / (gain time) at each exposure, real (k, y, x)."""

    @property
    @abstractmethod
    def conversion(self) -> tuple[float, float]:
        """(photo-electrons per count, dark photo-electrons per second)."""


@dataclass(frozen=True)
class InverseVariance(MergeRule):
    r"""Weight every unsaturated exposure by its inverse variance.

    .. math:: \mathrm{var}_k = [ (L + d) t_k + r^2 + g^2/12 ] / t_k^2

    shot noise of signal and dark current d, read noise r (photo-electrons) and rounding of counts of g
    photo-electrons each. L in this formula is the longest unsaturated exposure's, never the frame's own: weights that
    follow a frame's own noise pull the mean towards its low values.

    gain: photo-electrons per count, > 0. read_noise: photo-electrons, >= 0. dark: photo-electrons per second, >= 0.
    """

    gain: float
    read_noise: float
    dark: float = 0.0

    def __post_init__(self) -> None:
        real_number("gain", self.gain, above=0)
        real_number("read_noise", self.read_noise, low=0)
        real_number("dark", self.dark, low=0)

    @property
    def conversion(self) -> tuple[float, float]:
        """See :class:`MergeRule`."""
        return self.gain, self.dark

    def variance(self, times: np.ndarray, radiance: np.ndarray) -> np.ndarray:
        """See :class:`MergeRule`."""
        t = times[:, None, None]
        shot = (np.maximum(radiance, 0) + self.dark) * t
        return (shot + self.read_noise**2 + self.gain**2 / 12) / t**2

    def weights(self, times: np.ndarray, radiance: np.ndarray) -> np.ndarray:
        """See :class:`MergeRule`."""
        return 1 / self.variance(times, radiance)


@dataclass(frozen=True)
class LongestUnsaturated(MergeRule):
    """The paper's rule: keep, in each pixel, the longest exposure that is not saturated.

    gain, read_noise, dark: as in :class:`InverseVariance`; they give the variance.
    """

    gain: float = 1.0
    read_noise: float = 0.0
    dark: float = 0.0

    def __post_init__(self) -> None:
        InverseVariance(self.gain, self.read_noise, self.dark)

    @property
    def conversion(self) -> tuple[float, float]:
        """See :class:`MergeRule`."""
        return self.gain, self.dark

    def variance(self, times: np.ndarray, radiance: np.ndarray) -> np.ndarray:
        """See :class:`MergeRule`."""
        return InverseVariance(self.gain, self.read_noise, self.dark).variance(times, radiance)

    def weights(self, times: np.ndarray, radiance: np.ndarray) -> np.ndarray:
        """See :class:`MergeRule`: the longest usable time outweighs all others by far more than a double resolves."""
        return np.broadcast_to((times / times.max())[:, None, None] ** 200, (len(times), *radiance.shape))


def merge_exposures(frames: Any, exposures: Any, full_scale: int, rule: MergeRule) -> Merged:
    """One radiance image from a bracket of raw frames.

    Parameters
    ----------
    frames: integer counts (k, y, x). exposures: (k,) seconds, > 0. full_scale: the count at which a pixel saturates
    (255 for 8 bits); counts >= full_scale are not used. rule: ``InverseVariance(...)`` or ``LongestUnsaturated(...)``.

    Raises
    ------
    TypeError: frames are not integers, or another rule. ValueError: shapes, exposure times, counts above full scale.

    >>> frames = np.array([[[255, 40]], [[100, 20]]], np.uint8)
    >>> merged = merge_exposures(frames, [0.2, 0.1], 255, InverseVariance(gain=2.0, read_noise=1.0))
    >>> merged.radiance
    array([[2000.,  400.]])
    """
    one_of_types("rule", rule, (MergeRule,), "pass InverseVariance(...) or LongestUnsaturated(...).")
    frames = np.asarray(frames)
    if frames.dtype.kind not in "ui":
        raise TypeError(f"frames must be raw integer counts, got {frames.dtype}; do not scale them.")
    if frames.ndim != 3 or len(frames) == 0:
        raise ValueError(f"frames must have shape (k, y, x) with k >= 1, got {frames.shape}.")
    times = real_array("exposures", exposures, shape=(len(frames),), above=0, finite=True)
    full_scale = integer("full_scale", full_scale, low=1)
    if frames.min() < 0 or frames.max() > full_scale:
        raise ValueError(
            f"frames must hold counts from 0 to full_scale {full_scale}, got {frames.min()} to {frames.max()}."
        )
    gain, dark = rule.conversion
    usable = frames < full_scale
    rates = frames * (gain / times)[:, None, None] - dark
    longest_first = np.argsort(-times, kind="stable")
    first = np.argmax(usable[longest_first], axis=0)
    estimate = np.take_along_axis(rates[longest_first], first[None], 0)[0]
    saturated = ~usable.any(axis=0)
    estimate = np.where(saturated, rates[longest_first[-1]], estimate)
    weights = rule.weights(times, estimate) * usable
    total = weights.sum(0)
    safe = np.where(saturated, 1, total)
    share = weights / safe
    # the rates themselves are used unclipped: a negative one (below the dark level) is a fair noisy value
    radiance = np.where(saturated, estimate, (share * rates).sum(0))
    variance = np.where(saturated, np.inf, (share**2 * rule.variance(times, np.maximum(radiance, 0))).sum(0))
    return Merged(radiance, variance, saturated)
