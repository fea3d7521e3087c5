"""What a distribution must offer to be fitted to the pixels of a window."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

__all__ = ["Distribution", "Found", "Wanted"]


class Wanted(NamedTuple):
    """What to compute."""

    expectation: bool
    entropy: bool


@dataclass(frozen=True, eq=False)
class Found:
    """What a strip of windows gave, flat arrays; None where it was not wanted.

    ``count`` is the number of pixels, less where their noise makes them worth less than one; ``noise_entropy`` is None
    without noise.
    """

    expectation: np.ndarray | None
    entropy: np.ndarray | None
    count: np.ndarray
    noise_entropy: np.ndarray | None


class Distribution(ABC):
    """A family of densities that is fitted to the pixels of every window: a frozen dataclass of plain numbers.

    The fit uses sums over the window of a few functions of the pixels, its features, so that it costs the same
    whatever the size of the window. The last feature is the number of pixels.
    """

    single: bool = False  # whether sums in single precision will do for data in single precision
    single_floor: float = -np.inf  # entropy below which they will not

    @abstractmethod
    def outside(self, values: np.ndarray) -> np.ndarray | None:
        """Which values (not NaN) the distribution cannot have; None: it can have all."""

    @property
    @abstractmethod
    def allowed(self) -> str:
        """The values that it can have, in words, and what to do with others."""

    @abstractmethod
    def features(self, noisy: bool) -> int:
        """How many features there are, with and without noise."""

    @abstractmethod
    def load(self, values: np.ndarray, noise: np.ndarray | None, used: np.ndarray, out: np.ndarray) -> None:
        """Write the features of pixels ``(rows, columns)`` into ``out``, shape (features, rows, columns).

        ``used`` says which pixels count: the features of others are 0, the values and noise (standard deviations)
        given for them too.
        """

    @abstractmethod
    def finish(self, sums: np.ndarray, spare: np.ndarray, noisy: bool, wanted: Wanted) -> Found:
        """Expectation and entropy of windows with these sums, shape (features, pixels).

        ``sums`` and ``spare``, twice as large, may be overwritten and may be what is returned. Where there are too few
        pixels the caller drops the result.
        """
