"""Scenes with known truth: parameters, gain and labels of every pixel."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
from scipy.ndimage import gaussian_filter

from .checks import as_generator, integer, real_number
from .degeneracy import reduce_ranges
from .records import Parameters
from .storage import array

__all__ = ["Phantom", "lesion"]


@dataclass(frozen=True, eq=False)
class Phantom:
    """A scene: five parameters (radians), the complex gain, and labels (0 = background), each of shape (y, x).

    >>> lesion((18, 18), rng=1).labels.shape
    (18, 18)
    """

    parameters: Parameters = array(("*P",), "rad")
    gain: np.ndarray = array(("*P",), "1")
    labels: np.ndarray = array(("*P",), "1")
    seed: int | None = None


def _smooth_field(generator: np.random.Generator, shape: tuple[int, int], scale: float) -> np.ndarray:
    """Correlated field with standard deviation about 1; drawn larger than needed so that no edge shows."""
    margin = int(np.ceil(3 * scale))
    white = generator.normal(size=(shape[0] + 2 * margin, shape[1] + 2 * margin))
    field = gaussian_filter(white, scale, mode="wrap") * (2 * np.sqrt(pi) * scale)
    return np.asarray(field[margin : margin + shape[0], margin : margin + shape[1]])


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
) -> Phantom:
    """Fibrous tissue with one round lesion, in which the fibres are less ordered.

    Parameters
    ----------
    shape: pixels (y, x), from 1 x 1. rng: seed, generator or None: a fresh seed, recorded.
    diattenuation ... circularity: (background, lesion) values, radians for angles.
    variation: standard deviation of the smooth variation around them, radians (of D: half as much), >= 0; the lesion
        varies twice as much.
    smoothness: correlation length of the variation and of the lesion's border, pixels, > 0.

    Returns
    -------
    Phantom: with a gain of amplitude 0.6 to 1 and a smooth phase, and labels 0 = background, 1 = lesion.

    Raises
    ------
    ValueError: values out of range.

    >>> scene = lesion((18, 18), rng=3)
    >>> bool(scene.parameters.retardance[scene.labels == 1].mean() < scene.parameters.retardance[0].mean())
    True
    """
    rows, columns = (integer("shape", n, low=1) for n in shape)
    variation = real_number("variation", variation, low=0)
    smoothness = real_number("smoothness", smoothness, above=0)
    generator, seed = as_generator(rng)
    y, x = np.mgrid[:rows, :columns]
    radius = np.hypot((y - 0.5 * (rows - 1)) / (0.3 * rows), (x - 0.55 * (columns - 1)) / (0.3 * columns))
    ragged = radius + 0.1 * _smooth_field(generator, (rows, columns), smoothness)
    width = smoothness / (0.3 * max(rows, columns))
    share = 1 / (1 + np.exp(np.clip((ragged - 1) / (0.2 * width), -60, 60)))
    values = []
    pairs = (diattenuation, diattenuation_angle, retardance, retardance_angle, circularity)
    for name, (healthy, ill) in zip(Parameters._fields, pairs, strict=True):
        spread = variation * (0.5 if name == "diattenuation" else 1.0) * (1 + share)
        field = _smooth_field(generator, (rows, columns), smoothness)
        middle = healthy + share * (real_number(name, ill) - real_number(name, healthy))
        values.append(middle + spread * np.clip(field, -2, 2))
    values[0] = np.clip(values[0], -1, 1)
    amplitude = 0.8 + 0.1 * np.clip(_smooth_field(generator, (rows, columns), smoothness), -2, 2)
    phase = _smooth_field(generator, (rows, columns), smoothness)
    labels = (share > 0.5).astype(np.int32)
    return Phantom(reduce_ranges(Parameters(*values)), amplitude * np.exp(1j * phase), labels, seed)
