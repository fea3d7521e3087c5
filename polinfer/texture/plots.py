"""Pictures of textures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..checks import real_number
from ..plots import draw_map, explain, map_grid
from .angles import Angle

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .records import Texture

__all__ = ["plot_texture"]


def plot_texture(textures: dict[str, Texture], pixel_size: float | None = None) -> Figure:
    """Maps of the expectation of every quantity above its entropy.

    Expectations of angles are in degrees, in colours that close on themselves over their period. Entropies have a scale
    of their own each; minus infinity, where noise explains all of the dispersion, has the colour of the lowest.
    Hatched windows have too few pixels.

    Parameters
    ----------
    textures: by the name that is written above the maps, which may be empty. pixel_size: side of a pixel, metres, > 0,
        for a scale bar.

    Raises
    ------
    ValueError, TypeError: nothing to draw, a pixel size out of range.

    >>> from polinfer.texture import describe
    >>> figure = plot_texture({"phase": describe(np.zeros((8, 9)), 5)}, pixel_size=9e-6)
    >>> [axes.get_title() for axes in figure.axes][:2]
    ['E(phase) (°)', 'H(phase) (nat)']
    """
    if not textures:
        raise ValueError("textures is empty; pass at least one.")
    if pixel_size is not None:
        pixel_size = real_number("pixel_size", pixel_size, above=0)
    figure, axes = map_grid(next(iter(textures.values())).entropy, 2, len(textures), pixel_size)
    hatched = False
    for (name, texture), (above, below) in zip(textures.items(), axes.T, strict=True):
        words = name.replace("_", " ")
        mean_title, entropy_title = (f"E({words})", f"H({words})") if words else ("expectation", "entropy")
        lost = np.isnan(texture.entropy)
        hatched = hatched or bool(lost.any())
        angle = texture.distribution if isinstance(texture.distribution, Angle) else None
        mean = texture.expectation if angle is None else np.degrees(texture.expectation)
        unit, period = ("", None) if angle is None else (" (°)", float(np.degrees(angle.period)))
        draw_map(above, mean_title + unit, mean, lost | np.isnan(mean), period, pixel_size=pixel_size)
        entropy = texture.entropy
        finite = np.isfinite(entropy)
        lowest = entropy[finite].min() if finite.any() else 0.0
        draw_map(below, f"{entropy_title} (nat)", np.where(lost, lowest, np.maximum(entropy, lowest)), lost,
                 pixel_size=pixel_size)  # fmt: skip
    explain(figure, False, hatched, False)
    return figure
