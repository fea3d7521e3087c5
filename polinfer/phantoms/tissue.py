"""Tissue with a lesion, a fold and an edge."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np

from ..checks import as_generator, real_array, real_number
from ..records import Parameters
from .base import Phantom, frame_shape, phase_map, within_ranges
from .random_fields import smooth_field

__all__ = ["NAMES", "lesion"]

NAMES = ("healthy", "lesion", "fold", "outside")


def lesion(
    shape: tuple[int, int],
    rng: int | np.random.Generator | None = None,
    diattenuation: tuple[float, float] = (0.15, 0.35),
    diattenuation_angle: tuple[float, float] = (0.5, 0.9),
    retardance: tuple[float, float] = (1.8, 0.9),
    retardance_angle: tuple[float, float] = (0.6, 0.9),
    circularity: tuple[float, float] = (0.2, -0.2),
    variation: float = 0.1,
    smoothness: float = 5.0,
    disorder: float = 2.0,
    phase_disorder: float = 1.0,
    diameter: float | None = None,
    centre: tuple[float, float] = (0.5, 0.55),
    fold: float = 0.0,
    edge: float = 0.0,
    tilt: Any = None,
) -> Phantom:
    """Fibrous tissue with one round lesion, in which the fibres are less ordered; with a fold and an edge if wanted.

    All maps vary smoothly at random, by sums that wrap, so no direction is preferred.

    Parameters
    ----------
    shape: pixels (y, x), from 1 x 1. rng: seed, generator or None: a fresh seed, recorded.
    diattenuation ... circularity: (healthy, lesion) values, radians for angles.
    variation: standard deviation of the smooth variation around them, radians (of D: half as much), >= 0.
    smoothness: correlation length of the variation and of the lesion's border, pixels, > 0.
    disorder: how many times as much the parameters vary in the lesion, >= 0. phase_disorder: the same of the phase of
        the gain, whose standard deviation in healthy tissue is 1 rad.
    diameter: of the lesion, pixels, >= 0; 0: there is none. None: 0.6 of each side. centre: fractions of the frame.
    fold: width of a band across the frame in which the tissue lies double, pixels, >= 0; 0: none. There the retardance
        is up to 1.5 times and the amplitude 0.6 times as large, and the phase is up to 3 rad more, unevenly.
    edge: share of the frame beyond the edge of the sample, 0 to 1, where only light is: D = eta = 0, g = 1.
    tilt: phase of the second arm, radians, broadcasts to (y, x), or None.

    Returns
    -------
    Phantom: with a gain of amplitude 0.6 to 1 and a smooth phase, and labels 0 healthy, 1 lesion, 2 fold, 3 outside.

    Raises
    ------
    TypeError, ValueError: values out of range.

    >>> scene = lesion((18, 18), rng=3)
    >>> bool(scene.parameters.retardance[scene.labels == 1].mean() < scene.parameters.retardance[0].mean())
    True
    >>> whole = lesion((64, 64), rng=3, diameter=30, fold=6, edge=0.15)
    >>> np.unique(whole.labels).tolist(), whole.names
    ([0, 1, 2, 3], ('healthy', 'lesion', 'fold', 'outside'))
    """
    rows, columns = shape = frame_shape(shape)
    variation, disorder, phase_disorder, fold = (
        real_number(name, x, low=0)
        for name, x in (
            ("variation", variation), ("disorder", disorder), ("phase_disorder", phase_disorder), ("fold", fold),
        )
    )  # fmt: skip
    smoothness, edge = real_number("smoothness", smoothness, above=0), real_number("edge", edge, low=0, high=1)
    row, column = real_array("centre", centre, shape=(2,), finite=True)
    radii = (0.3 * rows, 0.3 * columns)
    if diameter is not None:
        radii = (0.5 * real_number("diameter", diameter, low=0),) * 2
    generator, seed = as_generator(rng)
    share = _lesion_share(generator, shape, (row, column), radii, smoothness)
    values = []
    pairs = (diattenuation, diattenuation_angle, retardance, retardance_angle, circularity)
    for name, pair in zip(Parameters._fields, pairs, strict=True):
        healthy, ill = real_array(name, pair, shape=(2,), finite=True)
        spread = variation * (0.5 if name == "diattenuation" else 1.0) * (1 + (disorder - 1) * share)
        field = smooth_field(generator, shape, smoothness)
        values.append(healthy + share * (ill - healthy) + spread * np.clip(field, -2, 2))
    amplitude = 0.8 + 0.1 * np.clip(smooth_field(generator, shape, smoothness), -2, 2)
    phase = smooth_field(generator, shape, smoothness) * (1 + (phase_disorder - 1) * share)
    labels = (share > 0.5).astype(np.int32)
    values[0] = np.clip(values[0], -1, 1)
    if fold:
        height, roughness = _fold_height(generator, shape, fold, smoothness), smooth_field(generator, shape, 1.0)
        values[2] = values[2] * (1 + 0.5 * height)
        amplitude, phase = amplitude * (1 - 0.4 * height), phase + height * (3 + roughness)
        labels[height > 0.5] = 2
    if edge:
        cover = _cover(generator, shape, edge, smoothness)
        values[0], values[2] = values[0] * cover, values[2] * cover
        amplitude, phase = 1 + cover * (amplitude - 1), cover * phase
        labels[cover < 0.5] = 3
    parameters, gain = within_ranges(Parameters(*values), amplitude * np.exp(1j * phase))
    return Phantom(parameters, gain, phase_map(tilt, shape), labels, NAMES, seed)


def _step(distance: np.ndarray) -> np.ndarray:
    """From 1 far below 0 to 0 far above."""
    return np.asarray(1 / (1 + np.exp(np.clip(distance, -60, 60))))


def _lesion_share(
    generator: np.random.Generator,
    shape: tuple[int, int],
    centre: tuple[float, float],
    radii: tuple[float, float],
    smoothness: float,
) -> np.ndarray:
    """How much of each pixel is lesion, 0 to 1."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    roughness = smooth_field(generator, shape, smoothness)  # drawn in any case: the same seed, the same tissue
    if not all(radii):
        return np.zeros(shape)
    radius = np.hypot((y - centre[0] * (shape[0] - 1)) / radii[0], (x - centre[1] * (shape[1] - 1)) / radii[1])
    return _step((radius + 0.1 * roughness - 1) / (0.2 * smoothness / max(radii)))


def _fold_height(generator: np.random.Generator, shape: tuple[int, int], width: float, smoothness: float) -> np.ndarray:
    """A band across the frame, 1 in its middle and 1/2 at its sides, along a line that misses the middle."""
    y, x = (axis - (n - 1) / 2 for axis, n in zip(np.mgrid[: shape[0], : shape[1]], shape, strict=True))
    direction, offset = generator.uniform(0, 2 * pi), generator.uniform(0.25, 0.4) * min(shape)
    distance = y * np.sin(direction) + x * np.cos(direction) - offset
    distance = distance + 0.3 * smoothness * smooth_field(generator, shape, smoothness)
    return np.exp(-np.log(2) * (distance / (0.5 * width)) ** 2)


def _cover(generator: np.random.Generator, shape: tuple[int, int], edge: float, smoothness: float) -> np.ndarray:
    """1 where there is tissue, 0 beyond its edge, which runs along one side of the frame."""
    side = int(generator.integers(4))
    axis = np.mgrid[: shape[0], : shape[1]][side // 2]
    length = shape[side // 2]
    inward = axis if side % 2 == 0 else length - 1 - axis
    ragged = inward + 0.5 * smoothness * smooth_field(generator, shape, 2 * smoothness)
    return _step((edge * length - 0.5 - ragged) / 0.5)
