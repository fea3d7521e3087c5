"""Pictures of comparisons."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .records import Comparison

__all__ = ["plot_comparison"]


def plot_comparison(comparison: Comparison) -> Figure:
    """Pooled log evidence below the best model with its scatter, and a map of every model's probability in a pixel.

    Hatched pixels have no answer. A single pixel or a row is shown as an image, frames stand below each other.
    """
    import matplotlib
    from matplotlib.figure import Figure

    models, scene = comparison.models, comparison.scene
    shape = comparison.probabilities.shape[1:]
    maps = comparison.probabilities.reshape(len(models), -1, shape[-1] if shape else 1)
    figure = Figure(figsize=(3.4 + 2.6 * len(models), 2.8), layout="constrained")
    axes = figure.subplots(1, 1 + len(models), squeeze=False, width_ratios=[1.3] + [1.0] * len(models))[0]
    below = scene.log_evidence - scene.log_evidence.max()
    place = np.arange(len(models))
    axes[0].barh(place, below, xerr=np.nan_to_num(scene.scatter), color="0.6", ecolor="0.2")
    axes[0].set_yticks(place, models)
    axes[0].invert_yaxis()
    axes[0].set_xlabel("log evidence below the best ± scatter (nat)")
    axes[0].set_title(f"scene of {scene.units}: {comparison.verdict}", fontsize=9)
    for ax, name, values in zip(axes[1:], models, maps, strict=True):
        ax.set_facecolor("0.93")
        ax.patch.set(hatch="//////", edgecolor="0.45", linewidth=0)
        long = max(values.shape) > 6 * min(values.shape)
        image = ax.imshow(
            np.ma.masked_invalid(values), vmin=0, vmax=1, cmap=matplotlib.colormaps["viridis"],
            interpolation="nearest", aspect="auto" if long else "equal",
        )  # fmt: skip
        ax.set_title(f"probability of {name}", fontsize=9)
        ax.set_xticks([])
        ax.set_yticks([])
        figure.colorbar(image, ax=ax, fraction=0.046, pad=0.03)
    return figure
