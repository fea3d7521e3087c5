"""Holograms for a spatial light modulator in front of a lens: spots, lenses, and both at once.

In: where light should go. Out: phase patterns (y, x) in radians. Called by users of a bench with modulators, and by
those who simulate one. Coordinates are (row, column) in metres from the middle of the modulator, or of the lens's focal
plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from polinfer.checks import complex_array, integer, one_of_types, real_array, real_number

__all__ = [
    "Modulator",
    "SpotArray",
    "aperture",
    "fresnel_lens",
    "gaussian",
    "logo",
    "quantise",
    "spot_amplitudes",
    "spot_array",
    "superpose",
]

HALF = 0.5  # of the iterations, before the phases of the spots are held


@dataclass(frozen=True)
class Modulator:
    """A modulator of ``shape`` (y, x) pixels of ``pixel_size``, in the front focal plane of a lens of ``focal_length``,
    all in metres.

    >>> Modulator((512, 512), 12e-6, 850e-9, 0.2).reach        # metres: half the width of the first order
    0.00708...
    """

    shape: tuple[int, int]
    pixel_size: float
    wavelength: float
    focal_length: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "shape", tuple(integer("shape", n, low=2) for n in self.shape))
        for name in ("pixel_size", "wavelength", "focal_length"):
            real_number(name, getattr(self, name), above=0)

    @property
    def reach(self) -> float:
        """Distance from the axis at which the first order meets the next one, metres."""
        return self.wavelength * self.focal_length / (2 * self.pixel_size)

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Places of rows and of columns, metres from the middle."""
        rows, columns = ((np.arange(n) - (n - 1) / 2) * self.pixel_size for n in self.shape)
        return rows, columns

    def waves(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Plane waves that the lens focuses on points (s, 2): factors (s, y) and (s, x)."""
        turn = 2j * np.pi / (self.wavelength * self.focal_length)
        rows, columns = self.axes()
        return np.exp(turn * points[:, :1] * rows), np.exp(turn * points[:, 1:] * columns)


@dataclass(frozen=True)
class SpotArray:
    """phase: (y, x) radians. powers: (s,) of the spots, as shares of what one spot could have. uniformity: 1 - (max -
    min) / (max + min) of the powers over the wanted ones. efficiency: sum of the powers."""

    phase: np.ndarray
    powers: np.ndarray
    uniformity: float
    efficiency: float


def spot_amplitudes(modulator: Modulator, field: Any, points: Any) -> np.ndarray:
    r"""Complex amplitudes (s,) that a field on the modulator has at points of the focal plane.

    .. math:: a(u) = \frac{\sum_x E(x) e^{-2\pi i\, u \cdot x / \lambda f}}{\sum_x |E(x)|}

    so that :math:`|a|^2` is the share of what a single spot could have. ``field`` complex (y, x), ``points`` (s, 2)
    metres, anywhere: no grid is involved.

    >>> modulator = Modulator((64, 64), 10e-6, 850e-9, 0.1)
    >>> blazed = np.exp(2j * np.pi * modulator.axes()[1] * 1e-3 / (850e-9 * 0.1)) * np.ones((64, 1))
    >>> np.round(np.abs(spot_amplitudes(modulator, blazed, [[0.0, 1e-3], [0.0, 0.0]])) ** 2, 2).tolist()
    [1.0, 0.0]
    """
    _checked(modulator)
    field = complex_array("field", field, shape=modulator.shape, finite=True)
    rows, columns = modulator.waves(real_array("points", points, shape=(None, 2), finite=True))
    return np.asarray(np.einsum("sy,sy->s", rows.conj(), (field @ columns.conj().T).T) / np.abs(field).sum())


def spot_array(
    modulator: Modulator, points: Any, powers: Any = None, illumination: Any = None, iterations: int = 60,
    rng: int | np.random.Generator | None = 0,
) -> SpotArray:  # fmt: skip
    r"""A phase pattern that makes spots at ``points`` (s, 2) of the focal plane, metres.

    Weighted Gerchberg-Saxton: the pattern is the phase of :math:`\sum_s w_s e^{i\phi_s} e^{2\pi i\, u_s \cdot x /
    \lambda f}`; weights grow by the mean spot's amplitude over the own one; spots' phases are those that the pattern
    gives them, and are held after half of the iterations, when they hinder uniformity more than they help efficiency.
    Spots are computed by direct sums, not by a Fourier transform on a grid: they may lie anywhere.

    Parameters
    ----------
    points: within the modulator's ``reach``. powers: (s,) relative, > 0; None: equal. illumination: amplitude (y, x),
    >= 0; None: even. iterations: >= 1. rng: of the phases at the start.

    Raises
    ------
    ValueError: points out of reach, shapes, numbers out of range.

    Source: Di Leonardo, Ianni and Ruocco (2007); phases held, Kim et al., Opt. Lett. 44, 3178 (2019).

    >>> angle = 2 * np.pi * np.arange(12) / 12
    >>> circle = 1e-3 * np.stack([np.sin(angle), np.cos(angle)], axis=1)
    >>> found = spot_array(Modulator((128, 128), 12e-6, 850e-9, 0.2), circle)
    >>> found.uniformity > 0.99, found.efficiency > 0.8
    (True, True)
    """
    _checked(modulator)
    points = real_array("points", points, shape=(None, 2), finite=True)
    if len(points) == 0 or np.abs(points).max() > modulator.reach:
        raise ValueError(f"points must be at least one, and within the modulator's reach of {modulator.reach:g} m.")
    wanted = np.ones(len(points)) if powers is None else real_array("powers", powers, shape=(len(points),), above=0)
    light = _light(modulator, illumination)
    iterations = integer("iterations", iterations, low=1)
    target = np.sqrt(wanted / wanted.sum())
    turn = np.exp(2j * np.pi * np.random.default_rng(rng).random(len(points)))
    rows, columns = modulator.waves(points)
    weights = target.copy()
    for count in range(iterations):
        phase = np.angle(((weights * turn)[:, None] * rows).T @ columns)
        amplitude = spot_amplitudes(modulator, light * np.exp(1j * phase), points)
        size = np.maximum(np.abs(amplitude), 1e-12)
        weights = weights * (size / target).mean() * target / size
        weights /= np.linalg.norm(weights)
        if count < HALF * iterations:
            turn = amplitude / size
    phase = np.angle(((weights * turn)[:, None] * rows).T @ columns)
    power = np.abs(spot_amplitudes(modulator, light * np.exp(1j * phase), points)) ** 2
    share = power / target**2
    return SpotArray(phase, power, float(1 - np.ptp(share) / (share.max() + share.min())), float(power.sum()))


def fresnel_lens(modulator: Modulator, focal_length: float, centre: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    r"""Phase (y, x), radians, of a thin lens of ``focal_length`` metres (negative: diverging) on the modulator.

    .. math:: -\frac{\pi |x - x_0|^2}{\lambda f}

    ValueError where neighbouring pixels would differ by more than pi: the lens would make ghosts of itself.

    >>> lens = fresnel_lens(Modulator((64, 64), 10e-6, 850e-9, 0.1), 0.05)
    >>> bool(np.isclose(lens[0, 0] - lens[0, 32], -np.pi * (315e-6**2 - 5e-6**2) / (850e-9 * 0.05)))
    True
    """
    focal_length = real_number("focal_length", focal_length)
    rows, columns = _around(modulator, centre)
    furthest = max(np.abs(rows).max(), np.abs(columns).max())
    if focal_length == 0 or 2 * furthest * modulator.pixel_size > modulator.wavelength * abs(focal_length):
        least = 2 * furthest * modulator.pixel_size / modulator.wavelength
        raise ValueError(f"focal_length must be at least {least:.3g} m on this modulator, got {focal_length:g} m.")
    return np.asarray(-np.pi * (rows[:, None] ** 2 + columns**2) / (modulator.wavelength * focal_length))


def superpose(
    modulator: Modulator, phase: Any, reference: Any, share: float, illumination: Any = None, iterations: int = 30
) -> np.ndarray:
    r"""A phase pattern (y, x) that makes the light of ``phase`` and, beside it, a fixed reference spot.

    The phase of :math:`a\,e^{i\phi(x)} + w\,e^{2\pi i\, u \cdot x / \lambda f}`, with the complex w chosen so that the
    spot at ``reference`` (2,) metres has the ``share`` of the light, above 0 and at most 0.99, and phase 0, whatever
    ``phase`` is: an array that moves leaves it alone. A modulator that keeps only phases turns part of the sum into
    other orders, which takes some per cent of the light and some tenths of an array's evenness.

    Raises
    ------
    ValueError: shapes, share out of range, or a spot that cannot have that share beside this pattern.

    >>> modulator = Modulator((128, 128), 12e-6, 850e-9, 0.2)
    >>> array = spot_array(modulator, [[1e-3, 0.0], [-1e-3, 3e-4]]).phase
    >>> both = superpose(modulator, array, [2e-3, 2e-3], 0.1)
    >>> amplitude = spot_amplitudes(modulator, np.exp(1j * both), [[2e-3, 2e-3]])[0]
    >>> round(float(abs(amplitude) ** 2), 4), round(float(abs(np.angle(amplitude))), 4)
    (0.1, 0.0)
    """
    _checked(modulator)
    phase = real_array("phase", phase, shape=modulator.shape, finite=True)
    point = real_array("reference", reference, shape=(2,), finite=True)[None]
    share = real_number("share", share, above=0, high=0.99)
    light = _light(modulator, illumination)
    rows, columns = modulator.waves(point)
    wave = rows.T @ columns
    array = np.sqrt(1 - share) * np.exp(1j * phase)
    weight = complex(np.sqrt(share))
    for _ in range(integer("iterations", iterations, low=1)):
        pattern = np.angle(array + weight * wave)
        found = spot_amplitudes(modulator, light * np.exp(1j * pattern), point)[0]
        # more of the wave gives more of the spot: a secant whose slope is about one
        weight = weight + np.sqrt(share) - found
    pattern = np.angle(array + weight * wave)
    found = spot_amplitudes(modulator, light * np.exp(1j * pattern), point)[0]
    if abs(found - np.sqrt(share)) > 1e-3:
        raise ValueError(f"share of {share:g} cannot be reached beside this pattern, {abs(found) ** 2:.3g} is; "
                         "take a smaller one.")  # fmt: skip
    return np.asarray(pattern)


def gaussian(modulator: Modulator, radius: float, centre: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Amplitude (y, x) of a Gaussian beam of 1/e field ``radius`` on the modulator, 1 in the middle.

    >>> round(float(gaussian(Modulator((65, 65), 10e-6, 850e-9, 0.1), 320e-6)[32, 0]), 4)       # 1 / e
    0.3679
    """
    radius = real_number("radius", radius, above=0)
    rows, columns = _around(modulator, centre)
    return np.asarray(np.exp(-(rows[:, None] ** 2 + columns**2) / radius**2))


def aperture(modulator: Modulator, radius: float, centre: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """1 within ``radius`` metres of ``centre`` on the modulator, 0 outside, (y, x).

    >>> int(aperture(Modulator((65, 65), 10e-6, 850e-9, 0.1), 25e-6).sum())
    21
    """
    radius = real_number("radius", radius, above=0)
    rows, columns = _around(modulator, centre)
    return np.where(rows[:, None] ** 2 + columns**2 <= radius**2, 1.0, 0.0)


def quantise(phase: Any, levels: int, stroke: float = 2 * np.pi) -> np.ndarray:
    r"""The phase that a modulator of so many grey ``levels`` over ``stroke`` radians shows, in [0, stroke).

    A blazed grating keeps :math:`\mathrm{sinc}^2(1/n)` of its light with n levels over a full turn. A stroke below 2 pi
    leaves phases that it cannot reach at its nearer end.

    >>> quantise([0.1, 3.0, 6.2], 4).round(3).tolist()
    [0.0, 3.142, 0.0]
    """
    phase = real_array("phase", phase, finite=True)
    levels = integer("levels", levels, low=2)
    stroke = real_number("stroke", stroke, above=0, high=2 * np.pi)
    step = stroke / levels
    grey = np.rint(np.mod(phase, 2 * np.pi) / step)
    last = levels - 1 if stroke < 2 * np.pi else levels
    over = np.mod(phase, 2 * np.pi) > (last * step + 2 * np.pi) / 2
    grey = np.where(grey > last, np.where(over, 0, last), grey)
    return np.asarray(np.mod(grey, levels) * step)


def logo(modulator: Modulator, text: str, height: float, spacing: float) -> np.ndarray:
    """Points (s, 2), metres, that write ``text`` in the focal plane for :func:`spot_array`: capital letters, ``height``
    tall and centred on the axis, by spots ``spacing`` apart.

    >>> points = logo(Modulator((512, 512), 12e-6, 850e-9, 0.2), "HI", height=2e-3, spacing=2.5e-4)
    >>> points.shape[1], bool(np.ptp(points[:, 0]) <= 2e-3)
    (2, True)
    """
    from matplotlib.path import Path  # slow to import
    from matplotlib.textpath import TextPath

    _checked(modulator)
    one_of_types("text", text, (str,), "pass the letters.")
    height, spacing = real_number("height", height, above=0), real_number("spacing", spacing, above=0)
    if not text.strip():
        raise ValueError(f"text must have letters, got {text!r}.")
    path: Path = TextPath((0, 0), text, size=1)
    box = path.get_extents()
    scale = height / box.height
    down = np.arange(0, box.height + 1e-9, spacing / scale) + box.y0
    across = np.arange(0, box.width + 1e-9, spacing / scale) + box.x0
    grid = np.stack([a.ravel() for a in np.meshgrid(across, down)], axis=1)
    # a letter's hole is an outline inside of another: what lies in an odd number of them is ink
    outlines = [Path(corners) for corners in path.to_polygons()]
    ink = np.logical_xor.reduce([outline.contains_points(grid, radius=1e-9) for outline in outlines])
    inside = grid[ink]
    points = np.stack([box.y0 + box.height / 2 - inside[:, 1], inside[:, 0] - box.x0 - box.width / 2], axis=1) * scale
    if len(points) == 0 or np.abs(points).max() > modulator.reach:
        raise ValueError(
            f"text must fit the modulator's reach of {modulator.reach:g} m with spots {spacing:g} m apart."
        )
    return np.asarray(points)


def _light(modulator: Modulator, illumination: Any) -> np.ndarray:
    if illumination is None:
        return np.ones(modulator.shape)
    light = real_array("illumination", illumination, shape=modulator.shape, low=0, finite=True)
    if not light.sum() > 0:
        raise ValueError("illumination is dark everywhere; pass the amplitude on the modulator.")
    return np.asarray(light)


def _checked(modulator: Modulator) -> None:
    one_of_types("modulator", modulator, (Modulator,), "pass Modulator(shape, pixel_size, wavelength, focal_length).")


def _around(modulator: Modulator, centre: Any) -> tuple[np.ndarray, np.ndarray]:
    """Rows (y,) and columns (x,) of the pixels, metres from ``centre``."""
    _checked(modulator)
    rows, columns = modulator.axes()
    row, column = real_array("centre", centre, shape=(2,), finite=True)
    return rows - row, columns - column
