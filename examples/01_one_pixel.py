"""One pixel: from three measured fields to five parameters with their uncertainty.

Run: python examples/01_one_pixel.py [folder for the results; a temporary one by default]
"""

import sys
import tempfile
from pathlib import Path

import jax
import numpy as np

import polinfer

jax.config.update("jax_enable_x64", True)

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
folder.mkdir(parents=True, exist_ok=True)

# The scene: light meets the retarder first, |g| = 1 with unknown phase, everything else as by default.
model = polinfer.Model(ordering=polinfer.RetarderFirst(), gain=polinfer.PhaseGain())

# Three elliptical states, each (horizontal, vertical) in a column; balanced: every direction is lit equally.
states = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / np.sqrt(2)

truth = polinfer.Parameters(
    diattenuation=0.2, diattenuation_angle=0.4, retardance=1.3, retardance_angle=0.6, circularity=0.1
)
measurement = polinfer.simulate(model, truth, states, sigma=0.02, rng=1)
result = polinfer.fit(model, measurement)
low, high = result.interval(0.95)

print(f"status {polinfer.Status(int(result.status))!r}, log evidence {float(result.log_evidence):.2f} nat")
print(f"{'parameter':22}{'truth':>9}{'found':>9}{'std':>9}   95 % interval")
for name in polinfer.Parameters._fields:
    columns = (getattr(p, name) for p in (truth, result.parameters, result.std))
    print(f"{name:22}" + "".join(f"{float(x):9.4f}" for x in columns),
          f"  {float(getattr(low, name)):.4f} to {float(getattr(high, name)):.4f}")  # fmt: skip

# How much more probable this order of the elements makes these data than the reverse one, in nats.
reverse = polinfer.fit(polinfer.Model(ordering=polinfer.PolariserFirst(), gain=polinfer.PhaseGain()), measurement)
print(f"log evidence for retarder first over polariser first: {float(result.log_evidence - reverse.log_evidence):.2f}")

path = polinfer.save(result, folder / "one_pixel.nc", overwrite=True)
again = polinfer.load(path)
assert again.parameters.retardance == result.parameters.retardance
print(f"saved to {path}")
