"""Phantoms: what is known beforehand, measured with noise and found again.

A half-wave plate turned step by step, a gel stretched step by step, a chiral solution, a diattenuating film and a gel
that scatters. Each has something that the fit does not know of: a plate that is uneven, strain that is not the same
everywhere.

Run: python examples/05_phantoms.py [folder for the results; a temporary one by default]
"""

import sys
import tempfile
from pathlib import Path

import jax
import numpy as np

import polinfer
from polinfer import phantoms

jax.config.update("jax_enable_x64", True)

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
folder.mkdir(parents=True, exist_ok=True)

SHAPE, SIGMA = (18, 24), 0.02
model = polinfer.Model(gain=polinfer.ComplexGain(scale=1.0))


def measured(scene, rng):
    """The fit of noisy Jones matrices of a scene."""
    data = polinfer.simulate(model, scene.parameters, np.eye(2), SIGMA, rng=rng, gain=scene.gain)
    return polinfer.fit(model, data).parameters


def axis(angle):
    """Mean direction of axes in each frame, radians."""
    return 0.5 * np.angle(np.exp(2j * angle).mean(axis=(-2, -1)))


def same_axis(first, second):
    """Angle between two axes, degrees."""
    return np.degrees(0.5 * np.angle(np.exp(2j * (first - second))))


def slow_axis(found):
    """Of the equivalent sets those with eta >= 0: the angle is then that of the slow axis."""
    return np.abs(found.retardance), found.retardance_angle + np.where(found.retardance < 0, np.pi / 2, 0)


# Half-wave plate: the axis follows the mount, the retardance stays.
angles = np.radians([10, 30, 50, 70])
plate = phantoms.half_wave_plate(SHAPE, angles, rng=1, retardance=2.9, variation=0.05, smoothness=2.0, wedge=0.02)
retardance, direction = slow_axis(measured(plate, 2))
print("half-wave plate at another wavelength (2.9 rad)")
for set_to, eta, seen in zip(angles, retardance, axis(direction), strict=True):
    print(f"  at {np.degrees(set_to):4.0f} degrees: axis off by {same_axis(seen, set_to):+.2f} degrees, "
          f"retardance {eta.mean():.3f} +- {eta.std():.3f} rad")  # fmt: skip

# Gel: retardance over thickness, since at constant volume it gets thinner as it is stretched.
stretches = np.linspace(1.0, 1.5, 6)
gel = phantoms.stretched_gel(SHAPE, stretches, rng=3, variation=0.03, axis_variation=0.05, smoothness=2.0)
retardance, _ = slow_axis(measured(gel, 4))
birefringence = retardance.mean(axis=(-2, -1)) * 850e-9 / (2 * np.pi * phantoms.gel_thickness(stretches))
print("stretched gel\n  stretch  birefringence  law of rubber")
for stretch, found in zip(stretches, birefringence, strict=True):
    print(f"  {stretch:7.2f}  {found:13.3e}  {float(phantoms.gel_birefringence(stretch)):13.3e}")

# Chiral solution: a circular retarder, xi = -+pi/2 at theta_eta = pi/4.
found = measured(phantoms.chiral(SHAPE, 0.15, rng=5, variation=0.1, smoothness=2.0), 6)
rotation = -0.5 * found.retardance * np.sin(2 * found.retardance_angle) * np.sin(found.circularity)
print(f"chiral solution: rotation {rotation.mean():.3f} +- {rotation.std():.3f} rad, made with 0.15 +- 0.015")

# Film: D and its axis.
found = measured(phantoms.film(SHAPE, 0.4, rng=7, diattenuation=0.6, transmission=0.4), 8)
print(f"film: D {np.abs(found.diattenuation).mean():.3f}, made with 0.6")

# Scattering gel in time: how fast its speckle forgets.
moving = phantoms.scattering_gel((64, 64), rng=9, frames=6, memory=0.8)
speckle = moving.gain - moving.gain.mean(axis=(-2, -1), keepdims=True)
kept = np.abs((np.conj(speckle[0]) * speckle).mean(axis=(-2, -1))) / np.mean(np.abs(speckle[0]) ** 2)
print("scattering gel: correlation of the speckle with that of frame 0:", " ".join(f"{c:.2f}" for c in kept))

moving[0].plot(pixel_size=9e-6).savefig(folder / "speckle.png", dpi=80)
path = polinfer.save(plate, folder / "plate.nc", overwrite=True)
assert len(polinfer.load(path)) == len(angles)
print(f"saved to {folder}")
