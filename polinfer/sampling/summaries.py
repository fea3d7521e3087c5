"""Draws of every pixel in a few numbers: mean directions, widths, and the shortest arcs that hold a given share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import ceil, inf, pi
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import storage
from ..checks import real_number
from ..model import Model
from ..records import PERIODS, RANGES, Parameters, Status
from ..storage import array, setting
from ..threads import each
from .blocks import blocks, flat, rows
from .diagnostics import NO_DRAWS, diagnose

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Summary", "circular_mean_and_std", "highest_density", "summarise_draws"]

UNIDENTIFIED = {name: int(Status.unidentified(name)) for name in Parameters._fields}


@dataclass(frozen=True, eq=False)
class Summary:
    """Draws of every pixel in a few numbers; angles in radians, all arrays of shape P.

    Attributes
    ----------
    mean: of angles the mean direction ``p/(2 pi) arg mean exp(2 pi i x / p)`` with the period p of the parameter, of D
        the mean.
    std: of angles the circular standard deviation ``p/(2 pi) sqrt(-2 log R)`` with the mean resultant length R, which
        exceeds that of a uniform distribution where the directions cancel; of D the standard deviation.
    low, high: ends of the shortest interval that holds the share ``level`` of the draws. For an angle it is the arc
        from low upwards to high, which may cross the wrap (then low > high).
    status: that of the draws, with ``UNIDENTIFIED_<PARAMETER>`` by the width of the draws: std above half of that of a
        uniform distribution over the range.
    ess, r_hat: worst effective sample size and split R-hat over the invariants.

    Fixed parameters have std 0; those that drop out of J are NaN and flagged, and so is everything where there are no
    draws. Nothing else is NaN. A pixel depends on its own draws alone: summaries of parts of a frame can be joined,
    :meth:`join`.
    """

    mean: Parameters = array(("*P",), "rad")
    std: Parameters = array(("*P",), "rad")
    low: Parameters = array(("*P",), "rad")
    high: Parameters = array(("*P",), "rad")
    level: float = setting()
    status: np.ndarray = array(("*P",), "1")
    ess: np.ndarray = array(("*P",), "1")
    r_hat: np.ndarray = array(("*P",), "1")

    @staticmethod
    def join(parts: Sequence[Summary], shape: tuple[int, ...]) -> Summary:
        """One summary of shape ``shape`` from those of consecutive pixels, each of any shape.

        ValueError if the levels differ or the number of pixels is not that of ``shape``.

        >>> draws = Parameters(*np.full((5, 1, 4, 6), 0.1))
        >>> parts = [summarise_draws(Model(), draws, None, None, np.zeros(6, int), 0.9) for _ in range(2)]
        >>> Summary.join(parts, (3, 4)).mean.retardance.shape
        (3, 4)
        """
        if not parts:
            raise ValueError("parts must be at least one Summary, got none.")
        levels = sorted({part.level for part in parts})
        if len(levels) > 1:
            raise ValueError(f"parts have different levels, {levels}; make all of them with one.")
        count = sum(part.status.size for part in parts)
        if count != int(np.prod(shape)):
            raise ValueError(f"parts have {count} pixels, but shape {shape} has {int(np.prod(shape))}.")

        def together(values: list[Any]) -> Any:
            if isinstance(values[0], Parameters):
                return Parameters(*(together(list(group)) for group in zip(*values, strict=True)))
            return np.concatenate([value.reshape(-1) for value in values]).reshape(shape)

        names = [field.name for field in fields(Summary) if field.name != "level"]
        joined = {name: together([getattr(part, name) for part in parts]) for name in names}
        return Summary(level=levels[0], **joined)

    def to_dataset(self) -> Any:
        """As a labelled :class:`xarray.Dataset`: ``mean.retardance``, ``low.retardance``, with units."""
        return storage.to_dataset(self)

    def plot(self, smooth: bool = False, pixel_size: float | None = None) -> Figure:
        """Maps of the means above the standard deviations, see :func:`polinfer.plots.plot_summary`."""
        from ..plots import plot_summary

        return plot_summary(self, smooth=smooth, pixel_size=pixel_size)


def _wrapped(x: np.ndarray, period: float) -> np.ndarray:
    """``x`` in (-period/2, period/2]."""
    return x - period * np.ceil(x / period - 0.5)


def circular_mean_and_std(values: Any, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean direction in (-period/2, period/2] and circular standard deviation along the last axis.

    With ``u = 2 pi x / period``: ``mean = arg(mean e^{iu})``, ``std = sqrt(-2 log R)``, ``R = |mean e^{iu}|``, both
    times ``period / (2 pi)``. R is formed from the differences to the mean, so that narrow distributions keep their
    digits.

    Parameters
    ----------
    values: real ``(..., n)``, n >= 1, in the unit of the period, which is > 0; ``inf`` means no circle: the common mean
        and standard deviation (of the n draws, not n - 1).

    Source: Fisher, Statistical Analysis of Circular Data, Cambridge 1993, section 2.3.

    >>> mean, std = circular_mean_and_std([3.0, -3.0], 2 * pi)
    >>> bool(np.isclose(mean, pi)), round(float(std), 3)
    (True, 0.142)
    """
    x = np.asarray(values, float)
    if period == inf:
        mean = x.mean(axis=-1)
        return mean, np.sqrt(np.mean((x - mean[..., None]) ** 2, axis=-1))
    turn = 2 * pi / period
    mean = np.arctan2(np.sin(turn * x).mean(axis=-1), np.cos(turn * x).mean(axis=-1)) / turn
    loss = np.mean(2 * np.sin(0.5 * turn * (x - mean[..., None])) ** 2, axis=-1)
    # for an even distribution R is 0 up to rounding, and its logarithm must stay finite
    length = np.minimum(loss, 1 - np.finfo(float).eps)
    return _wrapped(mean, period), np.sqrt(-2 * np.log1p(-length)) / turn


def highest_density(values: Any, period: float, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the shortest interval or arc that holds ``ceil(level n)`` of the n draws along the last axis.

    On a circle (finite ``period``) the arc goes from low upwards to high, both in (-period/2, period/2]; low > high
    where it crosses the wrap. Of equally short ones the first is taken.

    Parameters
    ----------
    values: real ``(..., n)``, n >= 1. period: > 0, ``inf`` where the values lie on a line. level: in (0, 1].

    >>> highest_density(np.array([3.0, -3.1, 0.0, 3.1, 1.0]), 2 * pi, 0.6)
    (array(3.), array(-3.1))
    """
    x = np.asarray(values, float)
    x = np.sort(x if period == inf else _wrapped(x, period), axis=-1)
    count = x.shape[-1]
    # 0.68 times 100 is 68.00000000000001
    held = min(max(ceil(level * count * (1 - 1e-12)), 1), count)
    width = x[..., held - 1 :] - x[..., : count - held + 1]
    if period != inf:
        across = x[..., : held - 1] + period - x[..., count - held + 1 :]
        width = np.concatenate([width, across], axis=-1)
    first = np.argmin(width, axis=-1)[..., None]
    low, high = (np.take_along_axis(x, place, axis=-1)[..., 0] for place in (first, (first + held - 1) % count))
    return low, high


def _line(model: Model, name: str) -> bool:
    """Whether a parameter lies on a line: D, and an angle whose prior leaves out a part of the circle."""
    if getattr(PERIODS, name) == inf:
        return True
    low, high = model.priors[name].support
    return bool(high - low < getattr(PERIODS, name) - 1e-9)


def unidentified(model: Model, std: Parameters) -> np.ndarray:
    """``UNIDENTIFIED_<PARAMETER>`` bits by standard deviations of any shape; dropped parameters have theirs."""
    bits = np.zeros(np.shape(std.diattenuation), np.int32)
    for name in model.free:
        low, high = getattr(RANGES, name)
        bits |= np.where(getattr(std, name) > 0.5 * (high - low) / 12**0.5, UNIDENTIFIED[name], 0).astype(np.int32)
    for name in model.dropped:
        bits |= np.int32(UNIDENTIFIED[name])
    return bits


def summarise_draws(
    model: Model,
    parameters: Parameters,
    gain: np.ndarray | None,
    sigma: np.ndarray | None,
    status: np.ndarray,
    level: float,
) -> Summary:
    """:class:`Summary` of draws ``(chain, draw, *P)`` with the ``status`` (P) of their pixels.

    The memory needed is that of a few hundred thousand numbers beside the draws.

    Raises
    ------
    ValueError: a level that is not in (0, 1).

    >>> rng = np.random.default_rng(0)
    >>> draws = Parameters(*(rng.normal(0.5, 0.1, (5, 4, 500, 3))))
    >>> made = summarise_draws(Model(), draws, None, None, np.array([0, 0, 1]), level=0.68)
    >>> made.mean.retardance.round(1).tolist(), made.std.retardance.round(1).tolist(), made.status.tolist()
    ([0.5, 0.5, nan], [0.1, 0.1, nan], [0, 0, 1])
    """
    level = real_number("level", level, above=0, high=1)
    if level == 1:
        raise ValueError("level must be < 1, got 1; the draws have no end that means anything.")
    status = np.asarray(status)
    good = np.flatnonzero((status & NO_DRAWS) == 0)
    kind = np.result_type(*(np.asarray(x).dtype for x in parameters), np.float32)
    parts = {part: {name: np.full(status.size, np.nan, kind) for name in Parameters._fields}
             for part in ("mean", "std", "low", "high")}  # fmt: skip
    for name, value in model.fixed.items():
        for part, number in (("mean", value), ("std", 0.0), ("low", value), ("high", value)):
            parts[part][name][good] = number
    for name in model.free:
        draws = flat(getattr(parameters, name))
        period = getattr(PERIODS, name)
        some = list(blocks(good, draws.shape[0] * draws.shape[1]))

        def work(index: int, name: str = name, draws: Any = draws, period: float = period, some: Any = some) -> None:
            block = some[index]
            x = rows(draws, block).reshape(len(block), -1)
            parts["mean"][name][block], parts["std"][name][block] = circular_mean_and_std(x, period)
            ends = highest_density(x, inf if _line(model, name) else period, level)
            parts["low"][name][block], parts["high"][name][block] = ends

        each(work, range(len(some)))
    made = {part: Parameters(**{name: x.reshape(status.shape) for name, x in values.items()})
            for part, values in parts.items()}  # fmt: skip
    told = diagnose(model, parameters, gain, sigma, status)
    with np.errstate(invalid="ignore"):
        flags = np.where((status & NO_DRAWS) == 0, unidentified(model, made["std"]), 0)
    bits = (status & ~sum(UNIDENTIFIED.values())) | flags
    return Summary(
        **made, level=level, status=bits.astype(np.int32), ess=told.worst_ess.astype(kind),
        r_hat=told.worst_r_hat.astype(kind),
    )  # fmt: skip
