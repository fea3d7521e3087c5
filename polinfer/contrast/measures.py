"""The two measures of contrast."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import as_generator, integer, real_number
from .bootstrap import draw
from .normal import Ratio
from .overlap import Overlap
from .records import Contrast
from .units import Regions, gather

__all__ = ["cnr", "gcnr"]


@dataclass(frozen=True)
class _Question:
    """Checked arguments of both measures."""

    data: Regions
    period: float | None
    level: float
    resamples: int
    generator: np.random.Generator
    seed: int | None

    @classmethod
    def asked(
        cls, values: Any, labels: Any, regions: tuple[int, int], samples: Any, period: float | None, mask: Any,
        level: float, resamples: int, rng: int | np.random.Generator | None,
    ) -> _Question:  # fmt: skip
        around = None if period is None else real_number("period", period, above=0)
        level = real_number("level", level, above=0, high=1)
        resamples = integer("resamples", resamples, low=100)
        generator, seed = as_generator(rng)
        data = gather(values, labels, regions, samples, mask, generator)
        return cls(data, around, level, resamples, generator, seed)

    def interval(self, measure: Ratio | Overlap) -> tuple[float, float]:
        """Of a measure; NaN where a region lies in a single unit."""
        if (self.data.held.sum(axis=0) < 2).any():
            return float("nan"), float("nan")
        weights = draw(self.data.held, self.resamples, self.generator)
        return measure.ends(weights, self.level)

    def answer(self, value: float, interval: tuple[float, float], definition: str) -> Contrast:
        """The record."""
        first, second = (int(n) for n in self.data.held.sum(axis=0))
        return Contrast(value, *interval, self.level, definition, self.data.pixels, (first, second),
                        self.data.left_out, self.resamples, self.seed)  # fmt: skip


def cnr(
    values: Any,
    labels: Any,
    regions: tuple[int, int] = (0, 1),
    samples: Any = None,
    period: float | None = None,
    mask: Any = None,
    level: float = 0.95,
    resamples: int = 1000,
    rng: int | np.random.Generator | None = None,
) -> Contrast:
    """Contrast-to-noise ratio of two regions, ``|mu_1 - mu_2| / sqrt(s_1^2 + s_2^2)``.

    mu and s^2 are the mean and the variance (over n) of all pixels of a region, samples pooled, so that differences
    between samples count as noise. With a ``period`` they are circular: mu is the mean direction, the difference is
    wrapped, and ``s = sqrt(-2 log R) period / 2 pi`` with the mean resultant length R.

    The interval is a bootstrap over ``samples``, symmetric and studentised by the jackknife, because percentiles are
    too narrow with a few samples; ``python -m benchmarks contrast`` measures both.

    Parameters
    ----------
    values: real, any shape; NaN: no answer, left out and counted. labels: integers, broadcast with values.
    regions: the two labels that are compared.
    samples: integers that broadcast with values: which sample a pixel is of. Pixels of one sample are alike, so samples
        are drawn again, not pixels. For a single image: :func:`tiles`. None: pixels are independent of each other;
        those of images hardly ever are, and then the interval is too narrow.
    period: of an angle, in the unit of the values (pi for axes, else 2 pi); None: values on a line.
    mask: bool, True = use. level: of the interval, 0 to 1. resamples: of the bootstrap, >= 100.
    rng: seed, generator or None: a fresh seed, recorded.

    Returns
    -------
    Contrast; its value is infinite or NaN where neither region varies.

    Raises
    ------
    TypeError, ValueError: arrays that do not broadcast, infinite values, a region without a pixel, values out of range.

    Source: Gordon et al., supplementary information; P. Hall, The Bootstrap and Edgeworth Expansion (1992).

    >>> from polinfer import phantoms
    >>> tissue = phantoms.cohort(rng=1)
    >>> number = np.arange(9)[:, None, None]
    >>> found = cnr(tissue.parameters.retardance_angle, tissue.labels, samples=number, period=np.pi, rng=1)
    >>> bool(found.low < found.value < found.high), found.units
    (True, (9, 6))
    """
    question = _Question.asked(values, labels, regions, samples, period, mask, level, resamples, rng)
    measure = Ratio(question.data, question.period)
    definition = "|mean difference| / sqrt(s1^2 + s2^2)"
    if question.period is not None:
        definition = f"|difference of mean directions| / sqrt(s1^2 + s2^2), circular with period {question.period:g}"
    return question.answer(abs(measure.value), question.interval(measure), definition)


def gcnr(
    values: Any,
    labels: Any,
    regions: tuple[int, int] = (0, 1),
    samples: Any = None,
    period: float | None = None,
    mask: Any = None,
    level: float = 0.95,
    resamples: int = 1000,
    rng: int | np.random.Generator | None = None,
) -> Contrast:
    """Generalised contrast-to-noise ratio, ``1 - integral min(p_1, p_2)``: 0 for equal densities, 1 for no overlap.

    It is ``1 - 2 e`` with e the least error of a decision, pixel by pixel, between two equally frequent regions,
    whatever their densities, and does not change if the values are stretched. Two normal densities of equal width have
    ``2 Phi(CNR / sqrt 2) - 1``.

    Estimated from counts in 32 bins (fewer for few pixels) of equal content. Counting by the bins' own decision is too
    large, above all where the densities are equal; counting each unit by the decision of all others is too small. The
    estimate is between the two. The interval is like that of :func:`cnr`, on a scale where the distance of two
    normal densities is a length; it begins at 0 where the counts differ by no more than chance makes probable.

    Parameters
    ----------
    As in :func:`cnr`. The values should be continuous: a few discrete ones share a bin.

    Returns
    -------
    Contrast. Where hardly any pixel is decided wrongly (less than two independent ones, as far as those of a unit are),
    ``low`` is what the bounds of Clopper and Pearson on both shares of errors leave; without an error ``high`` is 1.
    Where a region lies in a single unit there is no interval, and the value is that of the bins' own decision.

    Raises
    ------
    TypeError, ValueError: as :func:`cnr`.

    Source: A. Rodriguez-Molares et al., The generalized contrast-to-noise ratio, IEEE Trans. Ultrason. Ferroelectr.
    Freq. Control 67, 745 (2020).

    >>> labels = np.repeat([0, 1], 4000)
    >>> found = gcnr(np.random.default_rng(1).normal(labels), labels, rng=1)
    >>> bool(found.low < 0.383 < found.high), found.pixels              # 2 Phi(1 / 2) - 1
    (True, (4000, 4000))
    """
    question = _Question.asked(values, labels, regions, samples, period, mask, level, resamples, rng)
    measure = Overlap(question.data, question.period)
    return question.answer(measure.value, question.interval(measure), "1 - overlap of the densities")
