"""Which map shows a lesion best? The paper's figure of contrasts, and its sweep, on simulated samples.

Nine samples (six with a lesion) of :func:`polinfer.phantoms.cohort` are measured with noise and fitted. Amplitude,
phase and the five parameters are filtered in a window of 15 x 15 pixels: expectation E, entropy H, the same less the
noise (from the widths of the posteriors), and co-occurrence entropy H(x, x') with the offset (0, 4), half of it, so
that all have one scale. Contrast is that of lesion and healthy tissue; folds are neither, and what lies beyond the
edge of a sample is masked. 95 % intervals over samples.

The tissue is made so that lesions have other axes and more disorder, above all of phase. So the figure says how well
each metric sees what is there, through noise, with nine samples; it says nothing of mice.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

import polinfer
from benchmarks.results import FOLDER, Results
from polinfer import (
    AxialVonMises,
    ComplexGain,
    Model,
    Parameters,
    Status,
    TruncatedNormal,
    VonMises,
    contrast,
    phantoms,
)
from polinfer import texture as filters

SHAPE, SIGMA, SEED = (72, 72), 0.05, 1
SIZE, OFFSET = 15, (0, 4)
SIZES = (5, 9, 15, 21, 31)
LENGTHS = (1, 2, 4, 8)
DIRECTIONS = {"along": (0, 4), "down": (4, 0), "diagonal": (3, 3), "other diag.": (3, -3)}
DISTRIBUTIONS = {
    "amplitude": filters.Chi(1), "phase": VonMises, "diattenuation": TruncatedNormal,
    "diattenuation_angle": AxialVonMises, "retardance": VonMises, "retardance_angle": AxialVonMises,
    "circularity": VonMises,
}  # fmt: skip
PAIRS = {"amplitude": filters.Rescaled(0.8, 1.0), "diattenuation": filters.Rescaled(0.0, 1.0)}  # in joint distributions
PERIODS = {VonMises: 2 * np.pi, AxialVonMises: np.pi}
METRICS = ("E", "H", "H less noise", "H(x, x')")


@dataclass(frozen=True)
class Maps:
    """values, noise: of every quantity, (sample, y, x); mask: True = use; labels."""

    values: dict[str, np.ndarray]
    noise: dict[str, np.ndarray]
    mask: np.ndarray
    labels: np.ndarray


def measured(seed: int, sigma: float = SIGMA) -> Maps:
    """A cohort through noise and fit."""
    scene = phantoms.cohort(SHAPE, rng=seed)
    model = Model(gain=ComplexGain(scale=1.0))
    data = polinfer.simulate(model, scene.parameters, np.eye(2), sigma, rng=seed + 1, gain=scene.gain)
    found = polinfer.fit(model, data)
    assert found.gain is not None
    spread = sigma / 2  # of real and imaginary part of a gain, from two balanced states and a J of norm sqrt 2
    values = {"amplitude": np.abs(found.gain), "phase": np.angle(found.gain)}
    noise = {"amplitude": np.full(scene.labels.shape, spread), "phase": spread / np.abs(found.gain)}
    for name in Parameters._fields:
        values[name] = np.asarray(getattr(found.parameters, name))
        noise[name] = np.asarray(getattr(found.std, name))
    lost = int(Status.NOT_CONVERGED | Status.NON_FINITE | Status.MASKED)
    return Maps(values, noise, (scene.labels != 3) & ((found.status & lost) == 0), scene.labels)


def metric(maps: Maps, name: str, kind: str, size: int = SIZE, offset: tuple[int, int] = OFFSET) -> np.ndarray:
    """One filtered map."""
    image, family = maps.values[name], DISTRIBUTIONS[name]
    if kind == "E":
        return filters.expectation(image, size=size, distribution=family, mask=maps.mask)
    if kind == "H":
        return filters.entropy(image, size=size, distribution=family, mask=maps.mask)
    if kind == "H less noise":
        return filters.entropy(image, size=size, distribution=family, mask=maps.mask, std=maps.noise[name])
    family = PAIRS.get(name, family)
    return 0.5 * filters.cooccurrence_entropy(image, size=size, distribution=family, mask=maps.mask, offset=offset)


def contrasts(image: np.ndarray, maps: Maps, period: float | None, regions: tuple[int, int] = (0, 1)) -> dict[str, Any]:
    """CNR and gCNR of lesion and healthy tissue. An entropy of minus infinity counts as the least finite one."""
    number = np.arange(len(image))[:, None, None]
    finite = np.isfinite(image)
    image = np.where(np.isneginf(image), image[finite].min(), image)
    options: dict[str, Any] = {"regions": regions, "samples": number, "period": period, "mask": maps.mask, "rng": SEED}
    return {
        "cnr": contrast.cnr(image, maps.labels, **options), "gcnr": contrast.gcnr(image, maps.labels, **options)
    }  # fmt: skip


def figure_of_metrics(found: dict[tuple[str, str], dict[str, Any]]) -> Any:
    """Bars of every metric of every quantity, CNR above gCNR."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), layout="constrained")
    for axes, which in zip(figure.subplots(2, 1, sharex=True), ("cnr", "gcnr"), strict=True):
        for k, kind in enumerate(METRICS):
            for place, name in enumerate(DISTRIBUTIONS):
                one, x = found[name, kind][which], place + (k - 1.5) * 0.2
                axes.bar(x, one.value, 0.18, color=f"C{k}", label=kind if place == 1 else None)
                axes.plot([x, x], [one.low, one.high], color="0.2", lw=1)
        axes.set_ylabel({"cnr": "CNR", "gcnr": "gCNR"}[which])
        axes.grid(axis="y", alpha=0.3)
    axes.set_xticks(range(len(DISTRIBUTIONS)), [name.replace("_", "\n") for name in DISTRIBUTIONS])
    figure.axes[0].set_ylim(0, min(figure.axes[0].get_ylim()[1], 4))
    figure.axes[0].legend(ncols=4, fontsize=8)
    figure.suptitle("contrast of lesion and healthy tissue, nine simulated samples, 95 % intervals", fontsize=10)
    return figure


def figure_of_sweeps(rows: list[dict[str, Any]]) -> Any:
    """CNR of the phase's co-occurrence entropy against each setting, the others as in the paper."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3), layout="constrained")
    for axes, swept in zip(figure.subplots(1, 3, sharey=True), ("window", "length", "direction"), strict=True):
        points = [row for row in rows if row["swept"] == swept]
        x = range(len(points)) if swept == "direction" else [row["setting"] for row in points]
        axes.fill_between(x, [p["low"] for p in points], [p["high"] for p in points], color="0.85")
        axes.plot(x, [p["cnr"] for p in points], "ko-")
        if swept == "direction":
            axes.set_xticks(x, [str(p["setting"]) for p in points], fontsize=7)
        axes.set_xlabel({"window": "side of the window (pixels)", "length": "offset length (pixels)",
                         "direction": "direction of the offset"}[swept])  # fmt: skip
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylim(bottom=0)
    figure.axes[0].set_ylabel("CNR of H(φ, φ')")
    return figure


def main() -> None:
    """Print the tables, draw the two figures."""
    results = Results("cohort_contrast")
    maps = measured(SEED)
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for name, family in DISTRIBUTIONS.items():
        for kind in METRICS:
            image = metric(maps, name, kind)
            period = PERIODS.get(family) if kind == "E" else None  # type: ignore[call-overload]
            found[name, kind] = contrasts(image, maps, period)
            cnr, gcnr = found[name, kind]["cnr"], found[name, kind]["gcnr"]
            results.add(quantity=name, metric=kind, cnr=cnr.value, low=cnr.low, high=cnr.high, gcnr=gcnr.value,
                        gcnr_low=gcnr.low, gcnr_high=gcnr.high)  # fmt: skip
    fold = contrasts(metric(maps, "phase", "H"), maps, None, (0, 2))
    print(f"phase entropy of folds against healthy tissue: CNR {fold['cnr']}, gCNR {fold['gcnr']}")
    settings = [("window", n, n, OFFSET) for n in SIZES]
    settings += [("length", n, SIZE, (0, n)) for n in LENGTHS]
    settings += [("direction", name, SIZE, offset) for name, offset in DIRECTIONS.items()]  # type: ignore[misc]
    rows = []
    for swept, setting, size, offset in settings:
        one = contrasts(metric(maps, "phase", "H(x, x')", size, offset), maps, None)["cnr"]
        rows.append({"swept": swept, "setting": setting, "cnr": one.value, "low": one.low, "high": one.high})
        results.add(**rows[-1])
    for swept in ("window", "length", "direction"):
        values = [row["cnr"] for row in rows if row["swept"] == swept]
        print(f"{swept}: CNR of H(phase, phase') from {min(values):.2f} to {max(values):.2f}")
    results.save(figure_of_metrics(found))
    figure_of_sweeps(rows).savefig(FOLDER / "cohort_contrast_sweep.png", dpi=120)


if __name__ == "__main__":
    import jax

    jax.config.update("jax_enable_x64", True)
    main()
