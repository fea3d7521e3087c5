"""Contrast of lesions: simulated samples through noise and fit, then CNR and gCNR of every map with intervals.

Nine samples, six of them with a lesion. The contrast of a map is that of its pixels in the lesions and in healthy
tissue, all samples together, and its interval says what nine other samples might have shown.

Run: python examples/06_contrast.py [folder for the results; a temporary one by default]
"""

import sys
import tempfile
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

import polinfer
from polinfer import contrast, phantoms
from polinfer.records import PERIODS

jax.config.update("jax_enable_x64", True)

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
folder.mkdir(parents=True, exist_ok=True)

cohort = phantoms.cohort((48, 48), rng=1)
number = np.arange(len(cohort))[:, None, None]
model = polinfer.Model(gain=polinfer.ComplexGain(scale=1.0))
data = polinfer.simulate(model, cohort.parameters, np.eye(2), sigma=0.05, rng=2, gain=cohort.gain)
result = polinfer.fit(model, data)
polinfer.save(cohort, folder / "cohort.nc", overwrite=True)

# A map, and its period if it is one of angles. Where a parameter is not identified it says nothing: NaN, left out.
maps = {"amplitude": (np.abs(result.gain), None), "phase": (np.angle(result.gain), 2 * np.pi)}
for name in polinfer.Parameters._fields:
    unknown = (result.status & int(polinfer.Status.unidentified(name))) != 0
    values = np.where(unknown, np.nan, getattr(result.parameters, name))
    maps[name] = (values, None if name == "diattenuation" else getattr(PERIODS, name))

measures = {"CNR": contrast.cnr, "gCNR": contrast.gcnr}
found = {
    title: {
        name: measure(values, cohort.labels, samples=number, period=period, resamples=400, rng=3)
        for name, (values, period) in maps.items()
    }
    for title, measure in measures.items()
}
print(f"{'map':22}{'CNR':>28}{'gCNR':>32}")
for name in maps:
    print(f"{name:22}" + "".join(f"{found[title][name]!s:>30}" for title in measures))

# What pixels would say if they were independent, which those of one sample are not.
naive = contrast.cnr(maps["retardance"][0], cohort.labels, period=2 * np.pi, rng=3)
print(f"retardance, pixels taken as independent: {naive}")

figure = Figure(figsize=(8, 3), layout="constrained")
for axes, (title, values) in zip(figure.subplots(1, 2, sharey=True), found.items(), strict=True):
    for row, one in enumerate(values.values()):
        axes.plot([one.low, one.high], [row, row], color="0.6", lw=5, solid_capstyle="butt")
        axes.plot(one.value, row, "k|", ms=10)
    axes.set_yticks(range(len(values)), [name.replace("_", " ") for name in values])
    axes.set_ylim(len(values) - 0.5, -0.5)
    axes.set_xlim(left=0)
    axes.set_xlabel(f"{title}, 95 % interval")
figure.suptitle("contrast of lesion and healthy tissue", fontsize=10)
figure.savefig(folder / "contrast.png", dpi=110)
print(f"saved to {folder}")
