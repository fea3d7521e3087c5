"""Pixels that share their parameters with their neighbours: windows, box sums, and the statistics of a whole window.

With statistics R, Y, E of every pixel, the likelihood of a window is again of the form ``|J R - Y|^2 + E``, with
``R R^H = sum R_i R_i^H`` and ``Y R^H = sum Y_i R_i^H``, as long as gain and sigma are known. A complex gain of its own
in every pixel leaves quadratic forms of the responses: where all pixels have the same R they are determined by the
second moment ``sum vec(Y_i) vec(Y_i)^H``, as if there were four pixels, its principal axes. Everything else has no
statistic of fixed size, and sums over the pixels of the window.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .box_sums import run_sums
from .checks import integer
from .gain import ComplexGain, Gain, UnitGain
from .noise import Noise
from .statistics import TRAILING, Statistics, Summary, least_squares_jones

__all__ = ["Pooled", "Window", "Windowed", "box_mean", "box_sum", "pool"]


@dataclass(frozen=True)
class Window:
    """The pixels of a window around each pixel share the five parameters; it is cut off at the edges of the frame.

    Parameters
    ----------
    rows, columns: odd integers >= 1, in pixels. The last two axes of P are rows and columns; if P has one axis only,
        it is a row.

    Raises
    ------
    ValueError, TypeError: even, not positive, no integers.

    >>> Window(3, 5)
    Window(rows=3, columns=5)
    """

    rows: int
    columns: int

    def __post_init__(self) -> None:
        for name in ("rows", "columns"):
            value = integer(name, getattr(self, name), low=1)
            if value % 2 == 0:
                raise ValueError(f"{name} must be odd, so that the window has a centre, got {value}.")
            object.__setattr__(self, name, value)

    def offsets(self, shape: tuple[int, ...]) -> list[tuple[int, int]]:
        """(row, column) of every pixel of the window relative to its centre; the centre is the middle one."""
        rows, columns = (min(n, 2 * size - 1) for n, size in zip((self.rows, self.columns), plane(shape), strict=True))
        return [(y, x) for y in range(-(rows // 2), rows // 2 + 1) for x in range(-(columns // 2), columns // 2 + 1)]


def plane(shape: tuple[int, ...]) -> tuple[int, int]:
    """Rows and columns of a pixel shape; axes that are missing have length 1."""
    rows, columns = (1, 1, *shape)[-2:]
    return rows, columns


def _along(values: np.ndarray, length: int) -> np.ndarray:
    """Sums of ``length`` (odd) neighbours along axis 1 of ``(frames, n, ...)``, cut off at the ends."""
    n = values.shape[1]
    length = min(length, 2 * n - 1)
    if length == 1:
        return values
    # zeros on both sides: a window that leaves one line ends in them, before the next one begins
    padded = np.zeros((values.shape[0], n + length - 1, *values.shape[2:]), values.dtype)
    padded[:, length // 2 : length // 2 + n] = values
    flat = padded.reshape(-1)
    step = int(np.prod(values.shape[2:], dtype=np.int64))
    spare = np.empty((3, flat.size), flat.dtype)
    run_sums(flat, length, step, spare)
    return spare[0].reshape(padded.shape)[:, :n]


def box_sum(values: np.ndarray, window: Window, trailing: int = 0) -> np.ndarray:
    """Sum over the window around every pixel of ``(*P, ...)`` with ``trailing`` more axes; outside the frame is 0.

    The cost does not depend on the size of the window. float32 is summed in float64.

    >>> box_sum(np.array([1.0, 2.0, 4.0, 8.0]), Window(1, 3)).tolist()
    [3.0, 7.0, 14.0, 12.0]
    """
    values = np.asarray(values)
    shape = values.shape[: values.ndim - trailing]
    tail = values.shape[values.ndim - trailing :]
    kind = np.result_type(values.dtype, np.float64) if values.dtype.kind in "fc" else np.int64
    rows, columns = plane(shape)
    frame = values.astype(kind, copy=False).reshape(-1, rows, columns, *tail)
    frame = _along(frame, window.rows)
    frame = np.moveaxis(_along(np.moveaxis(frame, 2, 1), window.columns), 1, 2)
    return frame.reshape(values.shape)


def box_mean(values: np.ndarray, window: Window, trailing: int = 0) -> np.ndarray:
    """Mean over the finite pixels of the window; NaN where the pixel itself is not finite.

    >>> box_mean(np.array([1.0, np.nan, 4.0, 8.0]), Window(1, 3)).tolist()
    [1.0, nan, 6.0, 6.0]
    """
    values = np.asarray(values)
    axes = tuple(range(values.ndim - trailing, values.ndim))
    finite = np.asarray(np.isfinite(values).all(axis=axes))
    spread = finite.reshape(finite.shape + (1,) * trailing)
    count = box_sum(finite.astype(np.int64), window).reshape(spread.shape)
    return np.where(spread, box_sum(np.where(spread, values, 0), window, trailing) / np.maximum(count, 1), np.nan)


class Windowed(NamedTuple):
    """Statistics of the pixels of a window, which have one more pixel axis; their log densities are added up.

    ``dark`` is the number of further pixels with the illumination of the first one and a response of 0, ``(*P)``.
    """

    statistics: Statistics
    dark: Any

    @property
    def residual(self) -> Any:
        """E of the pixels; its type is the precision."""
        return self.statistics.residual


class Pooled(NamedTuple):
    """What the windows of a frame hold.

    ``take(pixels)`` gives :class:`Statistics` or :class:`Windowed` of pixels, flat indices; ``own`` are those of the
    pixels alone, zero where they cannot be used. ``pixels`` is the number of usable pixels of the window, ``data`` that
    of their complex data, ``rank`` the sum of their ranks, ``(*P)``.
    """

    take: Callable[[np.ndarray], Statistics | Windowed]
    own: Statistics
    pixels: np.ndarray
    data: np.ndarray
    rank: np.ndarray


def rows_of(statistics: Statistics, shape: tuple[int, ...]) -> Statistics:
    """Statistics with one pixel axis."""
    flat = []
    for values, trailing in zip(statistics, TRAILING, strict=True):
        tail = values.shape[values.ndim - trailing :]
        flat.append(np.broadcast_to(values, shape + tail).reshape(-1, *tail))
    return Statistics(*flat)


def _is_shared(values: np.ndarray, trailing: int) -> bool:
    lead = values.ndim - trailing
    return all(n == 1 or step == 0 for n, step in zip(values.shape[:lead], values.strides[:lead], strict=True))


def pool(summary: Summary, window: Window | None, gain: Gain, noise: Noise) -> Pooled:
    """Statistics of the window around every pixel; of the pixels themselves where there is no window.

    Pixels that are masked, not finite or without weight add nothing; a window without a usable pixel has statistics
    of 0.

    Notes
    -----
    The residual of a window is a difference of sums in float64, ``sum |Y_i|^2 - |Y|^2``, as long as this keeps 1e-3 nat
    (signal-to-noise ratios up to about 3e4, less in large windows). Beyond, the pixels of the window are added up one
    by one, which takes as long as the window is large.
    """
    shape = summary.masked.shape
    usable = ~(summary.masked | summary.non_finite)
    shared = _is_shared(summary.statistics.illumination, 2)
    flat = rows_of(summary.statistics, shape)
    if window is None:
        return Pooled(
            lambda pixels: Statistics(*(x[pixels] for x in flat)),
            flat,
            usable.astype(np.int64),
            2 * summary.states,
            summary.rank,
        )
    used = usable.reshape(-1) & (flat.count > 0)
    own = Statistics(
        *(
            x if used.all() else np.where(used.reshape(-1, *(1,) * t), x, 0).astype(x.dtype)
            for x, t in zip(flat, TRAILING, strict=True)
        )
    )
    counts = np.stack([np.ones(shape, np.int64), 2 * summary.states, summary.rank], axis=-1)
    pixels, data, rank = np.moveaxis(box_sum(counts * used.reshape(shape)[..., None], window, 1), -1, 0)
    known = not noise.integrated
    root = flat.illumination[0].astype(np.complex128) if shared and len(used) else None
    if known and isinstance(gain, UnitGain):
        total = _sums(own, window, shape, pixels, root)
        return Pooled(lambda chosen: Statistics(*(x[chosen] for x in total)), own, pixels, data, rank)
    summable = known and isinstance(gain, ComplexGain) and window.rows * window.columns > 4
    if summable and root is not None and not _loses_digits(_frame(_power(own.response), shape, window, 0)):
        take = _moments(own, window, shape, pixels, root)
    else:
        take = _members(own, window, shape)
    return Pooled(take, own, pixels, data, rank)


def _frame(values: np.ndarray, shape: tuple[int, ...], window: Window, trailing: int) -> np.ndarray:
    tail = values.shape[1:]
    return box_sum(values.reshape(shape + tail), window, trailing).reshape(-1, *tail)


def _loses_digits(power: np.ndarray) -> bool:
    """Whether differences of the sums ``power`` of squares lose more than about 1e-4 nat to rounding."""
    return bool(np.max(power, initial=0) * np.finfo(float).eps > 1e-5)


def _power(values: np.ndarray) -> np.ndarray:
    return np.sum(values.real.astype(float) ** 2 + values.imag.astype(float) ** 2, axis=(-1, -2))


def _sums(
    own: Statistics, window: Window, shape: tuple[int, ...], pixels: np.ndarray, root: np.ndarray | None
) -> Statistics:
    """Statistics of a window of pixels that share J, gain 1."""
    complex_type, real_type = own.response.dtype, own.residual.dtype
    scalars = [_power(own.response), own.residual, own.constant, own.count]
    # all sums in one go: for small frames it is the calls that take time
    if root is not None:
        parts = own.response.astype(np.complex128, copy=False).reshape(-1, 4)
        columns = np.concatenate([np.stack(scalars, axis=-1), parts.real, parts.imag], axis=-1)
        total = _frame(columns, shape, window, 1).T
        power, residual, constant, count = total[:4]
        number = np.sqrt(pixels.reshape(-1))[:, None, None]
        response = (total[4:8] + 1j * total[8:]).T.reshape(-1, 2, 2) / np.where(number > 0, number, 1)
        illumination = number * root
    else:
        power, residual, constant, count = _frame(np.stack(scalars, axis=-1), shape, window, 1).T
        adjoint = np.conj(np.swapaxes(own.illumination, -1, -2)).astype(np.complex128)
        gram = _frame(own.illumination.astype(np.complex128) @ adjoint, shape, window, 2)
        cross = _frame(own.response.astype(np.complex128) @ adjoint, shape, window, 2)
        illumination, response = _solve(gram, cross)
    if _loses_digits(power):
        spread = _spread(own, window, shape, Statistics(illumination, response, residual, constant, count))
    else:
        spread = np.maximum(power - _power(response), 0)
    return Statistics(
        illumination.astype(complex_type),
        response.astype(complex_type),
        (residual + spread).astype(real_type),
        (constant - spread).astype(real_type),
        count.astype(real_type),
    )


def _spread(own: Statistics, window: Window, shape: tuple[int, ...], total: Statistics) -> np.ndarray:
    """``sum |Y_i - Jhat R_i|^2`` over every window, formed directly."""
    rows, columns = plane(shape)
    matrices = least_squares_jones(total).reshape(-1, rows, columns, 2, 2)
    response, illumination = (x.reshape(-1, rows, columns, 2, 2) for x in (own.response, own.illumination))
    spread = np.zeros(matrices.shape[:3])
    for y, x in window.offsets(shape):
        here = (slice(None), slice(max(-y, 0), rows - max(y, 0)), slice(max(-x, 0), columns - max(x, 0)))
        there = (slice(None), slice(max(y, 0), rows - max(-y, 0)), slice(max(x, 0), columns - max(-x, 0)))
        spread[here] += _power(response[there] - matrices[here] @ illumination[there])
    return spread.reshape(-1)


def _solve(gram: np.ndarray, cross: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R and Y with ``R R^H = gram`` and ``Y R^H = cross``: a Cholesky factor, the larger diagonal element first."""
    swap = (gram[:, 1, 1].real > gram[:, 0, 0].real)[:, None, None]
    gram = np.where(swap, gram[:, ::-1, ::-1], gram)
    cross = np.where(swap, cross[:, :, ::-1], cross)
    first = np.sqrt(np.maximum(gram[:, 0, 0].real, 0))
    safe = np.where(first > 0, first, 1)
    below = gram[:, 1, 0] / safe
    rest = gram[:, 1, 1].real - np.abs(below) ** 2
    # what rounding leaves of a matrix of rank 1 is no direction
    second = np.sqrt(np.where(rest > 1e-14 * gram[:, 0, 0].real, rest, 0))
    root = np.zeros_like(gram)
    root[:, 0, 0], root[:, 1, 0], root[:, 1, 1] = first, below, second
    response = np.empty_like(cross)
    response[:, :, 0] = cross[:, :, 0] / safe[:, None]
    left = cross[:, :, 1] - response[:, :, 0] * np.conj(below)[:, None]
    response[:, :, 1] = np.where(second[:, None] > 0, left / np.where(second > 0, second, 1)[:, None], 0)
    return np.where(swap, root[:, ::-1, :], root), response


def _moments(
    own: Statistics, window: Window, shape: tuple[int, ...], pixels: np.ndarray, root: np.ndarray
) -> Callable[[np.ndarray], Windowed]:
    """Four pixels with the second moment of the responses of a window whose pixels have gains of their own."""
    vectors = own.response.reshape(-1, 4)
    moment = np.empty((len(vectors), 4, 4), np.complex128)
    for i in range(4):
        for j in range(i + 1):
            product = vectors[:, i].astype(np.complex128) * np.conj(vectors[:, j])
            moment[:, i, j] = _frame(product, shape, window, 0)
            moment[:, j, i] = np.conj(moment[:, i, j])
    scalars = [_frame(x, shape, window, 0) for x in (own.residual, own.constant, own.count)]
    dark = pixels.reshape(-1) - 4.0
    complex_type, real_type = own.response.dtype, own.residual.dtype

    def take(chosen: np.ndarray) -> Windowed:
        values, axes = np.linalg.eigh(moment[chosen])
        parts = np.sqrt(np.maximum(values, 0))[:, None, :] * axes
        response = np.swapaxes(parts, -1, -2).reshape(-1, 4, 2, 2).astype(complex_type)
        illumination = np.broadcast_to(root.astype(complex_type), (len(chosen), 4, 2, 2))
        columns = np.zeros((3, len(chosen), 4), real_type)
        columns[:, :, 0] = [x[chosen] for x in scalars]  # once for all four
        return Windowed(Statistics(illumination, response, *columns), dark[chosen].astype(real_type))

    return take


def _members(own: Statistics, window: Window, shape: tuple[int, ...]) -> Callable[[np.ndarray], Windowed]:
    """The pixels of a window one by one."""
    rows, columns = plane(shape)
    offsets = np.array(window.offsets(shape)).T
    # one more pixel, of zeros, stands for all outside the frame
    padded = Statistics(*(np.concatenate([x, np.zeros_like(x[:1])]) for x in own)) if len(own.count) else own

    def take(chosen: np.ndarray) -> Windowed:
        frame, place = np.divmod(chosen[:, None], rows * columns)
        y, x = place // columns + offsets[0], place % columns + offsets[1]
        inside = (y >= 0) & (y < rows) & (x >= 0) & (x < columns)
        index = np.where(inside, (frame * rows + y) * columns + x, len(own.count))
        members = Statistics(*(values[index] for values in padded))
        return Windowed(members, np.zeros(len(chosen), own.residual.dtype))

    return take


def mean_jones(statistics: Statistics | Windowed, aligned: bool) -> np.ndarray:
    """The matrix that the data suggest, ``(pixels, 2, 2)``, up to a factor; ``aligned``: the gains are alike."""
    if isinstance(statistics, Statistics):
        return least_squares_jones(statistics)
    matrices = least_squares_jones(statistics.statistics)
    size = np.sum(np.abs(statistics.statistics.illumination) ** 2, axis=(-1, -2))
    if aligned:
        return np.sum(size[..., None, None] * matrices, axis=-3)
    vectors = np.sqrt(size)[..., None] * matrices.reshape(*matrices.shape[:-2], 4)
    moment = np.swapaxes(vectors, -1, -2) @ np.conj(vectors)
    return np.linalg.eigh(moment)[1][..., -1].reshape(*moment.shape[:-2], 2, 2)
