"""Measured data: the focal lengths of microlenses, from two images a micrometre apart.

A microlens array in a microscope, in focus and 1 um out of it (Zhang et al., "On a universal solution to the
transport-of-intensity equation", 2020). The transport of intensity gives the phase, field stop included: nothing has
to be masked. A thin lens of focal length f turns the phase by

    phase = -k r^2 / 2f,    k = 2 pi / wavelength

at the distance r from its axis, so a quadratic fitted within each lens says f, and lenses of one array should agree.

Run: python examples/08_microlens.py [folder for the results; a temporary one by default]
The data are looked for in $POLINFER_DATA, folder tie_microlens.
"""

import sys
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
import skimage.io
from skimage.restoration import unwrap_phase

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from fibre import Defocus, TransportOfIntensity, retrieve
from polinfer import datasets

WAVELENGTH, PIXEL = 550e-9, 4.65e-6 / 20
# as published: the second image is nearer to the lamp, and darker where the lenses gather light behind it
DISTANCES = np.array([0, -1e-6])
# row and column of the middle of each whole lens, pixels, read off the image, and how much of it is fitted: all but
# the rim, whose light has left the aperture of the microscope
MIDDLES = np.array([(317, 331), (315, 655), (305, 983), (643, 336), (641, 663), (633, 990)])
RADIUS, FITTED = 155, 0.9


def read():
    """The two images, in focus and out of it."""
    folder = datasets.data_directory() / "tie_microlens"
    return np.stack([skimage.io.imread(folder / name).astype(float) for name in ("I0.tiff", "Iz.tiff")])


def lens(field, middle):
    """Focal length and the standard deviation of the phase about the fit, within one lens; and that phase."""
    reach = int(FITTED * RADIUS)
    row, column = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    phase = np.asarray(unwrap_phase(np.angle(field[middle[0] + row, middle[1] + column])))
    y, x, values = (a[np.hypot(row, column) < reach] for a in (row * PIXEL, column * PIXEL, phase))
    # the linear terms take a lens whose axis is not quite where it was read
    columns = np.stack([np.ones_like(x), x, y, x**2 + y**2], 1)
    used = np.ones(len(x), bool)
    for _ in range(5):  # without the debris on top
        fit = np.linalg.lstsq(columns[used], values[used], rcond=None)[0]
        left = values - columns @ fit
        used = np.abs(left) < 3 * 1.4826 * np.median(np.abs(left[used]))
    return -np.pi / WAVELENGTH / fit[3], left[used].std(), phase - fit[0]


def focal_lengths(images, method):
    """Of all lenses, metres."""
    found = retrieve(Defocus(images, DISTANCES, WAVELENGTH, PIXEL), method)
    return found.field, [lens(found.field, middle) for middle in MIDDLES]


def main():
    """Retrieve, fit, vary the regularisation, draw."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    images = read()
    field, lenses = focal_lengths(images, TransportOfIntensity())
    lengths = np.array([length for length, _, _ in lenses])
    for k, (length, spread, _) in enumerate(lenses, 1):
        print(f"lens {k}: f = {length * 1e6:.2f} um, phase within {spread:.2f} rad of the quadratic")
    off = lengths / lengths.mean() - 1
    print(f"mean {lengths.mean() * 1e6:.2f} um; lenses off by {off.min():+.1%} to {off.max():+.1%}")
    for regularisation in (0.01, 0.1):
        other = np.array([f for f, *_ in focal_lengths(images, TransportOfIntensity(regularisation=regularisation))[1]])
        print(f"regularisation {regularisation}: lengths change by {np.abs(other / lengths - 1).max():.2%} at most")

    figure, panels = plt.subplot_mosaic("aaab;aaac", figsize=(13, 6.6), layout="constrained")
    extent = np.array([-0.5, images.shape[2] - 0.5, images.shape[1] - 0.5, -0.5]) * PIXEL * 1e6
    panels["a"].imshow(np.angle(field), cmap="twilight", extent=extent, interpolation="none")
    panels["a"].set(title="phase (one turn a colour cycle)", xlabel="x / um", ylabel="y / um")
    angle = np.linspace(0, 2 * np.pi, 200)
    box = {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 2}
    for k, (middle, (length, _, phase)) in enumerate(zip(MIDDLES, lenses, strict=True), 1):
        y, x = middle * PIXEL * 1e6
        reach = FITTED * RADIUS * PIXEL * 1e6
        panels["a"].plot(x + reach * np.cos(angle), y + reach * np.sin(angle), color="tab:green", lw=1.5)
        panels["a"].text(x, y, f"{k}: {length * 1e6:.1f} um", ha="center", va="center", bbox=box)
        r = (np.arange(len(phase)) - len(phase) // 2) * PIXEL * 1e6
        panels["b"].plot(r, phase[len(phase) // 2], lw=1, label=str(k))
        panels["c"].errorbar(k, length * 1e6, fmt="o", color=f"C{k - 1}")
    panels["b"].plot(r, -np.pi / WAVELENGTH * (r * 1e-6) ** 2 / lengths.mean(), "k--", lw=1, label="mean f")
    panels["b"].set(title="across each lens", xlabel="r / um", ylabel="phase / rad")
    panels["b"].legend(ncols=2, fontsize="small")
    mean = lengths.mean() * 1e6
    panels["c"].axhspan(0.97 * mean, 1.03 * mean, color="0.9")
    panels["c"].axhline(mean, color="k", lw=1)
    panels["c"].set(title="focal length, mean and 3 %", xlabel="lens", ylabel="f / um")
    figure.savefig(folder / "microlens.png", dpi=110)
    print(f"wrote {folder / 'microlens.png'}")


if __name__ == "__main__":
    main()
