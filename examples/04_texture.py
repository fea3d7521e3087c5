"""Texture: where is tissue disordered, and how much of it is only noise?

A simulated lesion is measured with noise and fitted. Sliding windows then show the mean and the disorder (differential
entropy) of every parameter, with the widths of the posteriors taken out, and the entropy of two parameters together.

Run: python examples/04_texture.py [folder for the results; a temporary one by default]
"""

import sys
import tempfile
from pathlib import Path

import jax
import numpy as np

import polinfer
from polinfer import AxialVonMises, ComplexGain, Measurement, Model, VonMises, texture

jax.config.update("jax_enable_x64", True)

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
folder.mkdir(parents=True, exist_ok=True)

# tissue whose lesion varies more from pixel to pixel, seen at two noise levels
scene = polinfer.phantoms.lesion((48, 64), rng=1, smoothness=3.0)
jones = scene.gain[..., None, None] * np.asarray(polinfer.RetarderFirst().jones(scene.parameters))
model = Model(gain=ComplexGain(1.0))
lesion = scene.labels == 1
rng = np.random.default_rng(2)

truth = texture.entropy(scene.parameters.retardance, size=9)
print("entropy of the retardance in windows of 9 x 9 pixels, nat: median of healthy tissue, of the lesion")
print(f"  the scene itself:                {np.median(truth[~lesion]):6.2f} {np.median(truth[lesion]):6.2f}")
for sigma in (0.02, 0.1):
    noise = sigma / 2**0.5 * (rng.normal(size=jones.shape) + 1j * rng.normal(size=jones.shape))
    fit = polinfer.fit(model, Measurement.from_jones(jones + noise, sigma))
    for words, subtract in (("noise included", False), ("noise taken out", True)):
        found = texture.of_fit(fit, size=9, subtract_noise=subtract)
        middle = [np.nanmedian(found.retardance.entropy[group]) for group in (~lesion, lesion)]
        print(f"  measured, sigma {sigma:4}, {words:15}: {middle[0]:6.2f} {middle[1]:6.2f}")

found.plot(pixel_size=9e-6).savefig(folder / "texture.png", dpi=110)
polinfer.save(found, folder / "texture.nc", overwrite=True)

# two parameters together: less than the sum of their entropies as far as they know of each other
images = [fit.parameters.retardance, fit.parameters.retardance_angle]
kinds = [VonMises, AxialVonMises]
together = texture.entropy(images, 9, kinds, stride=2)
apart = sum(texture.entropy(x, 9, kind, stride=2) for x, kind in zip(images, kinds, strict=True))
print(f"retardance and its axis: common information, median {np.nanmedian(apart - together):.2f} nat")
pair = texture.cooccurrence_entropy(fit.parameters.retardance, 9, offset=(0, 4), stride=2)
single = texture.entropy(fit.parameters.retardance, 9, stride=2)
print(f"pixels four columns apart: common information, median {np.nanmedian(2 * single - pair):.2f} nat")
print(f"saved to {folder}")
