"""The joint posterior of one pixel."""

from __future__ import annotations

from math import degrees, inf
from typing import TYPE_CHECKING, Any

import numpy as np

from ..checks import integer
from ..records import PERIODS, Parameters
from .diagnostics import NO_DRAWS
from .summaries import circular_mean_and_std, highest_density

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .draws import Draws

__all__ = ["plot_pixel"]

LEVEL = 0.68
LABELS = Parameters(
    "diattenuation", "diattenuation\nangle (°)", "retardance (°)", "retardance\nangle (°)", "circularity (°)"
)


def _index(shape: tuple[int, ...], pixel: tuple[int, ...]) -> tuple[int, ...]:
    """``pixel`` as an index into ``shape`` with numbers >= 0."""
    if not isinstance(pixel, tuple) or len(pixel) != len(shape):
        raise ValueError(f"pixel must be a tuple of {len(shape)} integers, an index into shape {shape}, got {pixel!r}.")
    places = zip(pixel, shape, strict=True)
    return tuple(integer(f"pixel[{axis}]", x, low=-n, high=n - 1) % n for axis, (x, n) in enumerate(places))


class _Column:
    """Draws of one quantity, unrolled around their mean direction, and what is to be written beside them."""

    def __init__(self, label: str, values: np.ndarray, period: float) -> None:
        mean, std = circular_mean_and_std(values, period)
        self.label, self.period, self.mean, self.std = label, period, float(mean), float(std)
        around = values - mean
        if period != inf:
            around = around - period * np.ceil(around / period - 0.5)
        self.values = mean + around
        low, high = highest_density(values, period, LEVEL)
        self.ends = float(low), float(high if low <= high else high + period)
        if period != inf and self.ends[1] < mean:
            self.ends = self.ends[0] + period, self.ends[1] + period
        elif period != inf and self.ends[0] > mean:
            self.ends = self.ends[0] - period, self.ends[1] - period

    def name_tick(self, x: float, _: Any = None) -> str:
        """The value on its circle."""
        return f"{x if self.period == inf else x - self.period * np.ceil(x / self.period - 0.5):.4g}"

    @property
    def title(self) -> str:
        digits = max(0, 1 - int(np.floor(np.log10(self.std)))) if self.std > 0 else 3
        return f"{self.mean:.{digits}f} ± {self.std:.{digits}f}"


def _columns(draws: Draws, place: tuple[int, ...]) -> list[_Column]:
    at: tuple[Any, ...] = (slice(None), slice(None), *place)
    found = []
    for name in draws.model.free:
        values = np.asarray(getattr(draws.parameters, name)[at], float).reshape(-1)
        period = getattr(PERIODS, name)
        unit = 1.0 if period == inf else degrees(1)
        found.append(_Column(getattr(LABELS, name), unit * values, unit * period))
    if draws.gain is not None:
        gain = np.asarray(draws.gain[at]).reshape(-1)
        if np.ptp(np.abs(gain)) > 1e-6 * np.max(np.abs(gain)):
            found.append(_Column("amplitude", np.abs(gain).astype(float), inf))
        found.append(_Column("phase (°)", np.degrees(np.angle(gain)).astype(float), 360.0))
    if draws.sigma is not None:
        found.append(_Column("sigma", np.asarray(draws.sigma[at], float).reshape(-1), inf))
    return found


def plot_pixel(draws: Draws, pixel: tuple[int, ...]) -> Figure:
    """Every pair of parameters of one pixel, and each by itself.

    Angles are in degrees and unrolled around their mean direction, so that no cloud is cut by the wrap; the ticks are
    values within the range. Lines: mean, and the ends of the shortest arc that holds 68 % of the draws. Shown are the
    free parameters, the gain, and sigma where it is inferred.

    Parameters
    ----------
    draws: of any pixel shape. pixel: index into it, a tuple of integers; ``()`` if it is a single pixel.

    Raises
    ------
    ValueError: no such pixel, or one without draws.

    >>> from polinfer import Measurement, Model
    >>> from polinfer.sampling.draws import Draws
    >>> values = Parameters(*np.random.default_rng(0).normal(0.5, 0.1, (5, 2, 100, 3)))
    >>> draws = Draws(Model(), Measurement.from_jones(np.ones((3, 2, 2)), 0.1), values, np.zeros(3), np.zeros(3),
    ...               np.zeros(3, np.int32), None, None, 1, None)
    >>> len(plot_pixel(draws, (1,)).axes)
    15
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    place = _index(draws.shape, pixel)
    if draws.status[place] & NO_DRAWS:
        raise ValueError(f"pixel {pixel} has no draws: it is masked or not finite; choose another one.")
    columns = _columns(draws, place)
    count = len(columns)
    side = 1.9 * count + 0.6
    figure = Figure(figsize=(side, side))
    # fixed margins: to measure all labels takes longer than to draw them
    left, top = 0.85 / side, 1 - 0.3 / side
    grid = figure.add_gridspec(count, count, left=left, right=1 - 0.2 / side, bottom=0.65 / side, top=top, wspace=0.12)
    lowest: dict[int, Any] = {}
    for i, down in reversed(list(enumerate(columns))):
        for j, across in enumerate(columns[: i + 1]):
            axes = figure.add_subplot(grid[i, j], sharex=lowest.get(j))
            lowest.setdefault(j, axes)
            if i == j:
                axes.hist(down.values, bins=40, color="0.6")
                axes.axvline(down.mean, color="C3", linewidth=1)
                for end in down.ends:
                    axes.axvline(end, color="C3", linewidth=1, linestyle="--")
                axes.set_title(down.title, fontsize=9)
                axes.set_yticks([])
            else:
                axes.hexbin(across.values, down.values, gridsize=30, cmap="Greys", mincnt=1, linewidths=0.1)
                axes.plot(across.mean, down.mean, "+", color="C3")
                axes.yaxis.set_major_locator(MaxNLocator(4))
                axes.yaxis.set_major_formatter(FuncFormatter(down.name_tick))
                axes.tick_params(labelleft=j == 0)
            axes.xaxis.set_major_locator(MaxNLocator(4))
            axes.xaxis.set_major_formatter(FuncFormatter(across.name_tick))
            axes.tick_params(labelsize=7, labelbottom=i == count - 1)
            if i == count - 1:
                axes.set_xlabel(across.label, fontsize=9)
            if j == 0 and i > 0:
                axes.set_ylabel(down.label, fontsize=9)
    return figure
