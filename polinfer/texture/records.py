"""What the filters return."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..records import Parameters
from ..storage import array, setting
from .base import Distribution

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["FitTexture", "Texture"]


@dataclass(frozen=True, eq=False)
class Texture:
    """What :func:`describe` found in the window around each pixel, shape P. NaN where the window has too few pixels.

    Attributes
    ----------
    expectation: mean of the fitted distribution, in the unit of the image.
    entropy: its differential entropy, nats; that of the tissue alone where the noise was given.
    noise_entropy: entropy of the noise in the window, nats; None where no noise was given.
    count: pixels in the window; where noise was given for angles, the number without noise that they are worth.
    size: side of the window, pixels. distribution: what was fitted.
    """

    expectation: np.ndarray = array(("*P",), "unit of the image")
    entropy: np.ndarray = array(("*P",), "nat")
    noise_entropy: np.ndarray | None = array(("*P",), "nat")
    count: np.ndarray = array(("*P",), "1")
    size: int = setting()
    distribution: Distribution = setting()

    def plot(self, pixel_size: float | None = None) -> Figure:
        """Maps of expectation and entropy, see :func:`polinfer.texture.plots.plot_texture`."""
        from .plots import plot_texture

        return plot_texture({"": self}, pixel_size)


@dataclass(frozen=True, eq=False)
class FitTexture:
    """Texture of the maps of a fit, see :func:`of_fit`; None for what was not inferred.

    ``amplitude`` and ``phase`` are those of the complex gain.
    """

    diattenuation: Texture | None = array(("*P",), "1")
    diattenuation_angle: Texture | None = array(("*P",), "1")
    retardance: Texture | None = array(("*P",), "1")
    retardance_angle: Texture | None = array(("*P",), "1")
    circularity: Texture | None = array(("*P",), "1")
    amplitude: Texture | None = array(("*P",), "1")
    phase: Texture | None = array(("*P",), "1")
    noise_subtracted: bool = setting()

    @property
    def maps(self) -> dict[str, Texture]:
        """The textures that there are, by name."""
        found = {name: getattr(self, name) for name in QUANTITIES}
        return {name: texture for name, texture in found.items() if texture is not None}

    def plot(self, pixel_size: float | None = None) -> Figure:
        """Maps of expectation and entropy of every quantity, see :func:`polinfer.texture.plots.plot_texture`."""
        from .plots import plot_texture

        return plot_texture(self.maps, pixel_size)


QUANTITIES = (*Parameters._fields, "amplitude", "phase")
