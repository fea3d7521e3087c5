"""What is pooled: every datum once, whether the models share parameters over a window or not."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..neighbours import Window, plane
from ..records import Status

__all__ = ["NO_ANSWER", "NO_DATA", "Units", "common_window", "tiles", "units_of"]

NO_DATA = int(Status.MASKED | Status.NON_FINITE)
NO_ANSWER = NO_DATA | int(Status.NOT_CONVERGED)


class Units(NamedTuple):
    """Pixels, or disjoint tiles of them.

    ``label`` (*P): the unit of every pixel; ``centre`` (units): the flat index of its centre; ``values``
    (model, units): log evidences of its data, and ``errors`` their standard errors; ``used`` (units): all models have
    an answer for all of its data.
    """

    label: np.ndarray
    centre: np.ndarray
    values: np.ndarray
    errors: np.ndarray
    used: np.ndarray


def _line(size: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Tile of every position of a line, and the centres of the tiles; those at the ends may be cut off."""
    half, count = width // 2, -(-size // width)
    last = size - 1 - (count - 1) * width
    first = (max(0, last - half) + min(half, last) + 1) // 2
    centres = first + width * np.arange(count)
    return (np.arange(size) + half - first) // width, centres


def tiles(shape: tuple[int, ...], window: Window) -> tuple[np.ndarray, np.ndarray]:
    """Disjoint windows that cover a frame: the tile of every pixel ``(*P)``, and the flat indices of the centres.

    Centres are ``rows`` and ``columns`` apart, placed so that tiles cut off at the edges of the frame still hold their
    centres.

    >>> label, centre = tiles((7,), Window(1, 3))
    >>> label.tolist(), centre.tolist()
    ([0, 0, 1, 1, 1, 2, 2], [0, 3, 6])
    """
    rows, columns = plane(shape)
    frames = int(np.prod(shape)) // max(rows * columns, 1)
    (y, cy), (x, cx) = _line(rows, window.rows), _line(columns, window.columns)
    label = y[:, None] * len(cx) + x
    centre = (cy[:, None] * columns + cx).ravel()
    step = np.arange(frames)
    labels = (step[:, None, None] * len(centre) + label).reshape(shape)
    return labels, (step[:, None] * rows * columns + centre).ravel()


def common_window(models: list[Any]) -> Window | None:
    """The window that the models use; some may have none, but two different ones cannot be tiled alike."""
    windows = {m.neighbours for m in models if m.neighbours is not None and m.neighbours != Window(1, 1)}
    if len(windows) > 1:
        names = " and ".join(sorted(str(w) for w in windows))
        raise ValueError(f"results have {names}: no tiles are windows of both; compare one window at a time, or none.")
    return windows.pop() if windows else None


def units_of(models: list[Any], evidence: np.ndarray, error: np.ndarray, status: np.ndarray) -> Units:
    """Units of log evidences, their standard errors and status bits ``(model, *P)``."""
    shape = evidence.shape[1:]
    window = common_window(models)
    flat, bits = evidence.reshape(len(models), -1), status.reshape(len(models), -1)
    errors = error.reshape(len(models), -1)
    answered = (bits & NO_ANSWER == 0) & np.isfinite(flat)
    if window is None:
        used = answered.all(axis=0)
        index = np.arange(flat.shape[1])
        return Units(index.reshape(shape), index, np.where(used, flat, 0.0), errors, used)
    label, centre = tiles(shape, window)
    values, spread, used = np.zeros((len(models), len(centre))), errors[:, centre], np.ones(len(centre), bool)
    for i, model in enumerate(models):
        if model.neighbours == window:
            values[i], good = flat[i, centre], answered[i, centre]
        else:  # the sum over the pixels that the window of another model holds
            values[i] = np.bincount(label.ravel(), np.where(answered[i], flat[i], 0.0), len(centre))
            spread[i] = np.sqrt(np.bincount(label.ravel(), np.where(answered[i], errors[i], 0.0) ** 2, len(centre)))
            good = np.bincount(label.ravel(), ~answered[i] & (bits[i] & NO_DATA == 0), len(centre)) == 0
        used &= good
    return Units(label, centre, np.where(used, values, 0.0), spread, used)
