"""High dynamic range from a bracket of exposures: which times, and how they count.

In: the camera's figures. Out: exposure times, and the rule by which the unsaturated ones make one radiance. Called by
benches and by :mod:`acquisition.merging`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

from polinfer.checks import real_number

__all__ = ["Bracket", "InverseVariance", "LongestUnsaturated", "MergeRule"]


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


class MergeRule(ABC):
    """How the unsaturated exposures of a pixel make one radiance.

    A rule is hashable (a frozen dataclass), and its formulas use operators only: they are compiled.
    """

    @abstractmethod
    def weight(self, time: Any, radiance: Any) -> Any:
        """Relative weight of one exposure, real (y, x), from its time and a first estimate of the radiance (y, x);
        None where the longest usable exposure counts alone."""

    @abstractmethod
    def variance(self, time: Any, radiance: Any) -> Any:
        """Variance of counts / (gain time) at one exposure, real (y, x)."""

    @property
    @abstractmethod
    def conversion(self) -> tuple[float, float, float]:
        """(photo-electrons per count, dark photo-electrons per second, counts without any light or time)."""


@dataclass(frozen=True)
class InverseVariance(MergeRule):
    r"""Weight every unsaturated exposure by its inverse variance.

    .. math:: \mathrm{var}_k = [ (L + d) t_k + r^2 + g^2/12 ] / t_k^2

    shot noise of signal and dark current d, read noise r (photo-electrons) and rounding of counts of g
    photo-electrons each. L in this formula is the longest unsaturated exposure's, never the frame's own: weights that
    follow a frame's own noise pull the mean towards its low values.

    gain: photo-electrons per count, > 0. read_noise: photo-electrons, >= 0. dark: photo-electrons per second, >= 0.
    offset: counts without light at no exposure, >= 0. :func:`photon_transfer` measures all four.
    """

    gain: float
    read_noise: float
    dark: float = 0.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        real_number("gain", self.gain, above=0)
        for name in ("read_noise", "dark", "offset"):
            real_number(name, getattr(self, name), low=0)

    @property
    def conversion(self) -> tuple[float, float, float]:
        """See :class:`MergeRule`."""
        return self.gain, self.dark, self.offset

    def variance(self, time: Any, radiance: Any) -> Any:
        """See :class:`MergeRule`."""
        shot = (radiance * (radiance > 0) + self.dark) * time
        return (shot + (self.read_noise**2 + self.gain**2 / 12)) * (1 / time**2)  # one division for all pixels

    def weight(self, time: Any, radiance: Any) -> Any:
        """See :class:`MergeRule`."""
        return 1 / self.variance(time, radiance)


@dataclass(frozen=True)
class LongestUnsaturated(MergeRule):
    """The paper's rule: keep, in each pixel, the longest exposure that is not saturated.

    gain, read_noise, dark, offset: as in :class:`InverseVariance`; they give the variance.
    """

    gain: float = 1.0
    read_noise: float = 0.0
    dark: float = 0.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        InverseVariance(self.gain, self.read_noise, self.dark, self.offset)

    @property
    def conversion(self) -> tuple[float, float, float]:
        """See :class:`MergeRule`."""
        return self.gain, self.dark, self.offset

    def variance(self, time: Any, radiance: Any) -> Any:
        """See :class:`MergeRule`."""
        return InverseVariance(self.gain, self.read_noise, self.dark).variance(time, radiance)

    def weight(self, time: Any, radiance: Any) -> Any:
        """See :class:`MergeRule`: no weights, the longest usable exposure alone."""
        return None
