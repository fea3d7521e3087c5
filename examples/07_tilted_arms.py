"""Two illumination arms that are not parallel: is there a tilt, which, and what is below it?

A lesion is measured under a phase plane of 9 rad. The evidence says that there is a tilt; the fit finds it with the
parameters of all pixels, and the maps are those of the sample again.

Run: python examples/07_tilted_arms.py [folder for the results; a temporary one by default]
"""

import sys
import tempfile
from pathlib import Path

import jax
import numpy as np

import polinfer
from polinfer import Model, TiltPlane

jax.config.update("jax_enable_x64", True)

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
folder.mkdir(parents=True, exist_ok=True)

scene = polinfer.phantoms.lesion((24, 32), rng=1)
states = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / 2**0.5
ramp = TiltPlane().phase(np.array([0.2, -3.0, 9.0]), (24, 32))  # piston, rows, columns: radians from edge to edge
data = polinfer.simulate(Model(), scene.parameters, states, sigma=0.05, rng=2, tilt=ramp)

candidates = {"parallel": Model(), "tilted": Model(misalignment=TiltPlane())}
print("what the evidence says:", polinfer.select(candidates, data).verdict)

result = polinfer.fit(candidates["tilted"], data)
widths = np.sqrt(np.diag(result.tilt.covariance))
for name, value, width in zip(("piston", "rows", "columns"), result.tilt.coefficients, widths, strict=True):
    print(f"{name}: {value:.3f} +- {width:.3f} rad")
error = polinfer.fit(Model(), data).parameters.circularity - scene.parameters.circularity
print(f"circularity is off by {np.std(error):.2f} rad without the plane, "
      f"{np.std(result.parameters.circularity - scene.parameters.circularity):.2f} with it")  # fmt: skip
result.plot().savefig(folder / "tilted_arms.png")
polinfer.save(result, folder / "tilted_arms.nc")
print(f"wrote {folder}")
