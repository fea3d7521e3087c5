"""Measured data: the Jones matrices between the modes of a multimode fibre.

Every pair of modes of a 0.365 m graded-index fibre has a measured Jones matrix (Matthes et al., Phys. Rev. X 11,
021060, 2021). Which of them are a linear polariser behind a retarder, up to a complex factor? A complex 2 x 2 matrix
holds eight real numbers, the model has five parameters and a complex gain: one number is left to say no.

Run: python examples/02_measured_fibre.py [folder for the results; a temporary one by default]
The data are looked for in $POLINFER_DATA.
"""

import sys
import tempfile
from pathlib import Path

import jax
import numpy as np

import polinfer
from polinfer import Status, datasets

jax.config.update("jax_enable_x64", True)

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
folder.mkdir(parents=True, exist_ok=True)

fibre, pressed = datasets.multimode_fibre("5.04"), datasets.multimode_fibre("5.044")
near = fibre.near_degenerate
groups = {"nearly degenerate pairs": near, "all other pairs": ~near}


def size(values):
    """Root mean square of complex values."""
    return float(np.sqrt(np.mean(np.abs(values) ** 2)))


# Neighbouring states of deformation are no repeats: what differs is noise and bending, an upper bound on the noise.
sigma, per_pair = datasets.noise_upper_bound(fibre, pressed)
print(f"states 5.04 and 5.044 differ by {np.sqrt(2) * sigma / size(fibre.jones):.1%} after the best complex factor:")
print(f"the noise is at most {sigma:.3g} per complex element ({sigma / size(fibre.jones):.1%} of the signal)")
for name, group in groups.items():
    share = np.sum(per_pair[group] ** 2) / np.sum(per_pair**2)
    print(f"  {name}: {group.mean():.1%} of the pairs, signal {size(fibre.jones[group]):.3g}, "
          f"difference {size(per_pair[group]):.3g}, {share:.0%} of the difference's energy")  # fmt: skip
print("The difference follows the signal: it is hardly the camera's noise alone.")

model = polinfer.Model(gain=polinfer.ComplexGain(size(fibre.jones)))
unidentified = sum(int(Status.unidentified(name)) for name in polinfer.Parameters._fields)
for assumed in (sigma, sigma / 3):
    result = polinfer.fit(model, polinfer.Measurement.from_jones(fibre.jones, assumed))
    print(f"\nsigma = {assumed:.3g}")
    for name, group in groups.items():
        status = result.status[group]
        counts = {
            "OK": status == 0,
            "BAD_FIT": (status & int(Status.BAD_FIT)) != 0,
            "UNIDENTIFIED (any)": (status & unidentified) != 0,
            "AT_EDGE": (status & int(Status.AT_EDGE)) != 0,
            "NOT_CONVERGED": (status & int(Status.NOT_CONVERGED)) != 0,
        }
        print(f"  {name} ({group.sum()}): " + ", ".join(f"{k} {int(v.sum())}" for k, v in counts.items()))
    if assumed == sigma:
        kept = result
        polinfer.save(result, folder / "measured_fibre.nc", overwrite=True)
        result.plot().savefig(folder / "measured_fibre.png", dpi=110)

good = kept.status == 0
print(f"\nof the {int(good.sum())} pairs that are OK at the upper bound: median |D| "
      f"{np.median(np.abs(kept.parameters.diattenuation[good])):.2f}, median standard deviation of the retardance "
      f"{np.degrees(np.median(kept.std.retardance[good])):.1f} degrees")  # fmt: skip
print(f"saved to {folder}")
