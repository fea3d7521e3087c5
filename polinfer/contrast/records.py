"""The record that every measure of contrast returns."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Contrast"]


@dataclass(frozen=True)
class Contrast:
    """A contrast with its interval.

    Attributes
    ----------
    value: estimate, >= 0. low, high: ends of the interval that holds the contrast of the population with probability
        ``level``; NaN where a region lies in fewer than two units, which say nothing of how units differ.
    definition: what the number is.
    pixels, units: how many of them, in the first and the second region; units are what was drawn again by the
        bootstrap: samples, or groups of pixels if no samples were given.
    left_out: pixels of the two regions whose value was NaN.
    resamples, seed: of the bootstrap; seed is None for a generator of one's own.

    >>> import numpy as np
    >>> from polinfer import contrast
    >>> labels = np.repeat([0, 1], 500)
    >>> print(contrast.cnr(np.random.default_rng(0).normal(3.0 * labels), labels, rng=1))
    2.14 (95 %: 2.01 to 2.27)
    """

    value: float
    low: float
    high: float
    level: float
    definition: str
    pixels: tuple[int, int]
    units: tuple[int, int]
    left_out: int
    resamples: int
    seed: int | None = None

    def __str__(self) -> str:
        return f"{self.value:.3g} ({100 * self.level:g} %: {self.low:.3g} to {self.high:.3g})"
