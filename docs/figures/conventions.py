"""Draw docs/figures/conventions.png: where an axis at an angle points, and the two orders of the elements.

Run: python docs/figures/conventions.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Arc, FancyArrowPatch, Rectangle

ANGLE = np.radians(30)


def arrow(axes, start, end, colour, width=1.4):
    axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=11, color=colour, lw=width))


def screen(axes):
    """Components on a screen whose rows run down."""
    arrow(axes, (0, 0), (1.25, 0), "0.25")
    arrow(axes, (0, 0), (0, 1.0), "0.25")
    axes.text(1.28, 0, "component 0\nhorizontal\n(columns)", va="center", fontsize=8)
    axes.text(0, 1.08, "component 1, vertical (rows)", ha="center", va="top", fontsize=8)
    tip = np.array([np.cos(ANGLE), -np.sin(ANGLE)])
    axes.plot(*np.stack([-0.55 * tip, 1.05 * tip], 1), color="C3", lw=2.4)
    axes.text(*(1.1 * tip), r"axis $(\cos\,t,\ -\sin\,t)$", color="C3", fontsize=9, va="bottom", ha="center")
    axes.add_patch(Arc((0, 0), 1.1, 1.1, theta1=-np.degrees(ANGLE), theta2=0, color="C3"))
    axes.text(0.62, -0.15, r"$t > 0$", color="C3", fontsize=9)
    axes.set(xlim=(-0.75, 2.0), ylim=(1.3, -0.95), aspect="equal", title="An axis at angle t")


def orders(axes):
    """Which element the light meets first."""
    rows = (("retarder_first", "retarder", "polariser", r"$J = A_{pol}\,A_{ret}$"),
            ("polariser_first", "polariser", "retarder", r"$J = A_{ret}\,A_{pol}$"))  # fmt: skip
    for row, (name, first, second, product) in enumerate(rows):
        y = 1.0 - row
        arrow(axes, (-0.4, y), (3.4, y), "0.6", 1.0)
        for x, element in ((0.3, first), (1.7, second)):
            colour = "C0" if element == "retarder" else "C1"
            axes.add_patch(Rectangle((x, y - 0.2), 1.0, 0.4, facecolor="white", edgecolor=colour, lw=1.6, zorder=3))
            axes.text(x + 0.5, y, element, ha="center", va="center", fontsize=9, color=colour, zorder=4)
        axes.text(1.5, y + 0.3, f"{name}:  {product}", ha="center", fontsize=9)
        axes.text(-0.4, y + 0.07, "light", fontsize=8, color="0.4")
    axes.set(xlim=(-0.5, 3.5), ylim=(-0.5, 1.7), title="The two orderings")


def main() -> None:
    figure = Figure(figsize=(7.2, 2.7), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes, draw in ((left, screen), (right, orders)):
        draw(axes)
        axes.title.set_fontsize(10)
        axes.axis("off")
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
