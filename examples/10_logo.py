"""Letters behind a fibre: amplitude and phase images of a sample that no camera could see directly.

A plate with the letters PI, half as bright as the rest and a third of a wave thicker, lies behind a bundle of some 500
coupled fibrelets. Their fields, as a calibration and a recording would give them with 1 % of noise, are made from the
bundle; then the inverse matrix is recovered, and the plate is imaged through it.

Run: python examples/10_logo.py [folder for the results; a temporary one by default]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import scipy.sparse

from acquisition import CalibrationPlan
from fibre import (
    Bundle,
    CalibrationFields,
    Fibrelets,
    ForwardInverse,
    RecordingFields,
    holograms,
    reconstruct,
    recover,
    transmission_image,
)

NOISE = 0.01
GRID, PITCH, WAIST = (20, 20), 4e-6, 2.5e-6


def letters(text, grid, pitch):
    """Which points of a grid belong to letters three fifths as tall as the grid, bool (y, x)."""
    screen = holograms.Modulator((1024, 1024), 12e-6, 850e-9, 0.2)
    spots = holograms.logo(screen, text, height=0.6 * grid[0] * pitch, spacing=pitch / 2)
    index = np.rint(spots / pitch + (np.array(grid) - 1) / 2).astype(int)
    seen = np.zeros(grid, bool)
    seen[tuple(index.T)] = True
    return seen


def noisy(clean, rng):
    """Complex noise of 1 % of the mean field, and its variance."""
    level = NOISE * np.sqrt((np.abs(clean) ** 2).mean())
    noise = (rng.standard_normal(clean.shape) + 1j * rng.standard_normal(clean.shape)) / np.sqrt(2)
    return clean + level * noise, np.full(clean.shape, level**2)


def main(folder):
    rng = np.random.default_rng(0)
    bundle, plan = Bundle.hexagonal(radius=66e-6, rng=0), CalibrationPlan(GRID, pitch=PITCH, stride=5)
    launch = bundle.launch(plan.points, WAIST)
    matrix = bundle.columns(scipy.sparse.block_diag([launch, launch], format="csc"), faint=1e-7)
    fibrelets = Fibrelets(bundle.centres, bundle.mode_radius)

    seen, variance = noisy((matrix @ plan.inputs).toarray().T.reshape(-1, 2, bundle.cores), rng)
    spot = bundle.launch(np.array([[0.0, 62e-6]]), WAIST).toarray()[:, 0]
    calibration = CalibrationFields(
        seen, variance, bundle.transmit(np.stack([spot, spot]) / np.sqrt(2)), 1.0, 0.0, fibrelets,
        plan.inputs, plan.points, plan.grid, np.eye(2, 3),
    )  # fmt: skip
    inverse = recover(calibration, ForwardInverse())

    gain = np.where(letters("PI", GRID, PITCH), 0.5 * np.exp(2j * np.pi / 3), 1.0)
    lit = 0.5 * np.exp(-(plan.points**2).sum(1) / 50e-6**2)[:, None, None] * plan.illumination  # (p, 2, n)
    recorded = []
    for factor in (gain.reshape(-1, 1, 1), 1.0):
        field = (factor * lit).swapaxes(0, 1).reshape(2 * len(plan.points), -1)
        recorded += noisy((matrix @ field).T.reshape(-1, 2, bundle.cores), rng)
    recording = RecordingFields(*recorded, 1.0, 0.0, fibrelets, plan.illumination)

    image = transmission_image(reconstruct(inverse, recording))
    error = np.abs(image.amplitude * np.exp(1j * image.phase) - gain)
    print(f"amplitude of the letters {np.median(image.amplitude[gain != 1]):.3f} (true 0.5), "
          f"phase {np.degrees(np.median(image.phase[gain != 1])):.1f} degrees (true 120)")  # fmt: skip
    print(f"error of a point: median {np.median(error):.4f}, stated {np.median(np.sqrt(2) * image.amplitude_std):.4f}")
    image.plot(pixel_size=PITCH).savefig(folder / "logo.png", dpi=110)
    print(f"wrote {folder / 'logo.png'}")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as made:
            main(Path(made))
