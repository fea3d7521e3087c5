"""How many images a field needs: error against their number, for H from defocus and for V from phase steps.

H: the scenes of the benchmark ``retrieval`` (241 fibrelets, 10^4 photons at the peak of each image), images evenly
spaced over the span that is best for their number; three seeds, the worst of which is shown. V: conj(H) V of fields of
unit strength from k evenly spaced steps of the same noise, against the formula 2 s / sqrt(k).
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from benchmarks.results import Results
from benchmarks.retrieval import error, scene
from fibre import Accelerated, Modal, relative_phase, retrieve

SIDE, PHOTONS, SEEDS = 240, 1e4, 3
SPANS = (16e-6, 32e-6, 50e-6)
NOISE = 0.05


def main() -> None:
    """Print the table and draw."""
    results = Results("images")
    for count in (2, 3, 4, 5, 7):
        for name in ("Modal", "Accelerated"):
            found = {}
            for span in SPANS:
                errors = []
                for seed in range(SEEDS):
                    _, known, stack, truth = scene(SIDE, PHOTONS, seed, np.linspace(-span / 2, span / 2, count))
                    method = Modal(known) if name == "Modal" else Accelerated(tolerance=0.0)
                    errors.append(error(retrieve(stack, method).field, truth))
                found[span] = max(errors)
            best = min(found, key=lambda span: found[span])
            results.add(of="H", images=count, method=name, best_span=best, worst_error=found[best])
    for count in (3, 4, 5, 6, 8):
        off, expected = _steps(count)
        results.add(of="V", images=count, method="evenly spaced steps", error=off, expected=expected)
        results.bar(f"{count} phase steps: error over the formula's", off / expected, 1.02)
    three = next(r["worst_error"] for r in results.rows if (r["images"], r["method"]) == (3, "Modal"))
    seven = next(r["worst_error"] for r in results.rows if (r["images"], r["method"]) == (7, "Modal"))
    results.bar("three defocused images: worst error over that of seven", three / seven, 1.5)
    results.save(_picture(results))


def _steps(count: int) -> tuple[float, float]:
    """Root mean square error of conj(H) V of unit fields, and the formula's."""
    rng = np.random.default_rng(count)
    phase = 2 * np.pi * rng.random((300, 300))
    steps = 2 * np.pi * np.arange(count) / count
    clean = 0.5 * np.abs(1 + np.exp(1j * (phase + steps[:, None, None]))) ** 2
    found = relative_phase(clean + NOISE * rng.standard_normal(clean.shape), steps, np.full(clean.shape, NOISE**-2))
    return float(np.sqrt(np.mean(np.abs(found.product - np.exp(1j * phase)) ** 2))), 2 * NOISE / np.sqrt(count)


def _picture(results: Results) -> Figure:
    figure = Figure(figsize=(8, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name in ("Modal", "Accelerated"):
        rows = [row for row in results.rows if row["method"] == name]
        left.semilogy([r["images"] for r in rows], [r["worst_error"] for r in rows], "o-", label=name)
    left.set(xlabel="defocused images", ylabel="relative error of H (worst of three)", title="field")
    rows = [row for row in results.rows if row["of"] == "V"]
    right.plot([r["images"] for r in rows], [r["error"] for r in rows], "o", label="measured")
    right.plot([r["images"] for r in rows], [r["expected"] for r in rows], "k-", lw=1, label=r"$2s/\sqrt{k}$")
    right.set(
        xlabel="phase-stepped images k", ylabel=f"error of $H^*V$, noise s = {NOISE}", title="phase between H and V"
    )
    for axes in (left, right):
        axes.legend(fontsize=8)
        axes.grid(alpha=0.3)
    return figure


if __name__ == "__main__":
    main()
