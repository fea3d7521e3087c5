"""Measured data: the field behind a stack of defocused images, judged at distances that it has never seen.

A laser microscope's stack of a transparent flake (Mouthaan, 2024, holoscope data), 21 planes within 100 um of focus.
The field is retrieved from the four planes at -50, -10, 10 and 50 um. Propagated to -100, -20, 20 and 100 um it must
give the images there: their correlation with it is a score that no fit to the four can fake.

The objective lets through spatial frequencies up to NA / wavelength; an image holds twice as high ones. Where its power
spectrum ends in flat noise, at some 0.9 cycles a micrometre, the NA can be read off: 0.25. A common error of all
distances cannot be found from free-space images: the field would be that of another plane, and fit as well.

Run: python examples/09_defocus_stack.py [folder for the results; a temporary one by default]
The data are looked for in $POLINFER_DATA, folder dhm_defocus_stack.
"""

import sys
import tempfile
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from fibre import Accelerated, Defocus, GerchbergSaxton, angular_spectrum, retrieve
from polinfer import datasets

TRAINED, UNSEEN = (-50, -10, 10, 50), (-100, -20, 20, 100)
APERTURE = 0.25
METHODS = {
    "Gerchberg-Saxton, 100": GerchbergSaxton(iterations=100, averaging=0, restarts=0, tolerance=0.0, coarsening=1),
    "Accelerated, 100": Accelerated(iterations=100, tolerance=0.0, gain_spread=0.02),
}


def read():
    """Images over the empty microscope's, of mean 1, by their place in um; wavelength and pixel size, metres."""
    with np.load(datasets.data_directory() / "dhm_defocus_stack" / "stack_pm100um.npz", allow_pickle=False) as file:
        images = file["frames"] / file["reference"].astype(float)
        images /= images.mean((1, 2), keepdims=True)  # the lamp drifts
        planes = dict(zip(np.rint(file["z_um"]).astype(int).tolist(), images, strict=True))
        return planes, float(file["wavelength_nm"]) * 1e-9, float(file["pixel_um"]) * 1e-6


def predicted(field, place, wavelength, pixel):
    """The image at a place in um."""
    return np.abs(angular_spectrum(field, place * 1e-6, wavelength, pixel)) ** 2


def main():
    """Retrieve by two methods, with and without the pupil; score; draw."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    planes, wavelength, pixel = read()
    images, distances = np.stack([planes[z] for z in TRAINED]), 1e-6 * np.array(TRAINED)
    for aperture in (None, APERTURE):
        stack = Defocus(images, distances, wavelength, pixel, numerical_aperture=aperture)
        print("every frequency of the pixels" if aperture is None else f"numerical aperture {aperture}")
        for name, method in METHODS.items():
            field = retrieve(stack, method).field
            views = [predicted(field, z, wavelength, pixel) for z in UNSEEN]
            scores = [np.corrcoef(v.ravel(), planes[z].ravel())[0, 1] for z, v in zip(UNSEEN, views, strict=True)]
            print(f"  {name:22s}", *(f"{z:+4d} um: {s:.3f}" for z, s in zip(UNSEEN, scores, strict=True)), sep="  ")

    figure, axes = plt.subplots(2, 5, figsize=(15, 5.2), layout="constrained")
    extent = np.array([0, images.shape[2], images.shape[1], 0]) * pixel * 1e6
    for column, (z, view, score) in enumerate(zip(UNSEEN, views, scores, strict=True)):
        for row, (image, text) in enumerate(((planes[z], "measured"), (view, f"predicted, correlation {score:.2f}"))):
            axes[row, column].imshow(image, cmap="gray", vmin=0.4, vmax=1.6, extent=extent)
            axes[row, column].set_title(f"{z:+d} um, {text}", fontsize="medium")
    phase = np.angle(field * np.exp(-1j * np.angle(field.mean())))
    shown = axes[0, 4].imshow(np.abs(field), cmap="viridis", vmin=0.5, vmax=1.5, extent=extent)
    figure.colorbar(shown, ax=axes[0, 4], label="amplitude")
    shown = axes[1, 4].imshow(phase, cmap="twilight", vmin=-np.pi, vmax=np.pi, extent=extent)
    figure.colorbar(shown, ax=axes[1, 4], label="phase / rad")
    axes[0, 4].set_title("retrieved at 0 um", fontsize="medium")
    for panel in axes[:, 0]:
        panel.set_ylabel("y / um")
    for panel in axes[1]:
        panel.set_xlabel("x / um")
    figure.savefig(folder / "defocus-stack.png", dpi=110)
    print(f"wrote {folder / 'defocus-stack.png'}")


if __name__ == "__main__":
    main()
