"""Does ``fit`` reach the Cramer-Rao bound, and do its intervals hold what they say?

Three balanced states, both orderings, truths from the priors. First the regime in which the local Gaussian must be
right: all five bounds below 0.1. Then what it is worth outside. The picture shows the error of J of ``fit``, of the
closed form and of the plain pseudo-inverse against the bound.
"""

from __future__ import annotations

from itertools import product

import numpy as np

import polinfer
from benchmarks import scenes
from benchmarks.results import Results
from polinfer import ComplexGain, Model, Parameters, PolariserFirst, RetarderFirst
from polinfer.records import PERIODS

PIXELS = 40_000
GAINS = {"unit": None, "complex": ComplexGain(1.0)}


def _off(found: Parameters, truth: Parameters) -> tuple[np.ndarray, np.ndarray]:
    """Errors ``(5, pixels)`` from the nearest of the eight copies of the truth, and the sign of D and eta in it."""
    copies = np.stack(list(polinfer.orbit(truth)))  # (5, 8, pixels)
    error = np.stack([np.asarray(x, float) for x in found])[:, None] - copies
    for i, period in enumerate(PERIODS):
        if np.isfinite(period):
            error[i] -= period * np.round(error[i] / period)
    weight = np.array([1.0, 2.0, 1.0, 2.0, 1.0])[:, None, None]
    nearest = np.argmin(np.sum((weight * error) ** 2, axis=0), axis=0)
    return np.take_along_axis(error, nearest[None, None], axis=1)[:, 0], nearest


def _row(model: Model, truth: Parameters, sigma: float, seed: int) -> dict[str, np.ndarray]:
    states = scenes.balanced_states()
    data = scenes.measure(Model(model.ordering), truth, states, sigma, rng=seed)
    result = polinfer.fit(model, data)
    error = _off(result.parameters, truth)[0]
    bound = np.stack(list(polinfer.cramer_rao_bound(model, truth, states, sigma)))
    size = np.abs(error) / np.stack(list(result.std))
    return {"error": error, "bound": bound, "size": size, "status": result.status}


def main(size: int | None = None) -> None:
    """Print tables and bars, save the picture."""
    results, pixels = Results("accuracy"), size or PIXELS
    rng, states = np.random.default_rng(3), scenes.balanced_states()
    worst_ratio, cover = 0.0, {68: [], 95: []}
    for ordering, (name, gain), sigma in product(
        (RetarderFirst(), PolariserFirst()), GAINS.items(), (0.005, 0.02, 0.05)
    ):
        model = Model(ordering, gain=gain)
        truth = scenes.well_determined(model, pixels, states, sigma, rng)
        found = _row(model, truth, sigma, int(rng.integers(2**31)))
        # every parameter against its own bound, in root mean square over the pixels
        ratio = np.sqrt(np.mean((found["error"] / found["bound"]) ** 2, axis=1))
        inside = {level: np.mean(found["size"] < z, axis=1) for level, z in ((68, 0.99446), (95, 1.95996))}
        worst_ratio = max(worst_ratio, float(np.max(ratio)))
        for level, values in inside.items():
            cover[level] += list(100 * values)
        results.add(
            ordering=type(ordering).__name__,
            gain=name,
            sigma=sigma,
            **{f"rms_{p}": float(r) for p, r in zip(("D", "tD", "eta", "teta", "xi"), ratio, strict=True)},
            inside_68=f"{100 * inside[68].min():.1f}-{100 * inside[68].max():.1f}",
            inside_95=f"{100 * inside[95].min():.1f}-{100 * inside[95].max():.1f}",
        )
    print(f"  one standard error: rms {1 / np.sqrt(2 * pixels):.4f}, coverage {100 * np.sqrt(0.2176 / pixels):.2f} %")
    results.bar("rms error over bound, worst parameter of all rows", worst_ratio, 1.05)
    for level, (low, high) in {68: (66, 70), 95: (94, 96)}.items():
        results.bar(f"{level} % intervals, least coverage", min(cover[level]), low, "%", at_least=True)
        results.bar(f"{level} % intervals, most coverage", max(cover[level]), high, "%")

    for sigma in (0.02, 0.1, 0.2, 0.4):
        model = Model()
        truth = scenes.from_priors(model, 4 * pixels, rng)
        found = _row(model, truth, sigma, 5)
        worst = np.max(found["bound"], axis=0)
        for low, high in ((0.0, 0.1), (0.1, 0.3), (0.3, 1.0), (1.0, np.inf)):
            these = (worst >= low) & (worst < high)
            if np.sum(these) < 500:
                continue
            error, size, bound = (found[key][:, these] for key in ("error", "size", "bound"))
            results.add(
                sigma=sigma,
                largest_bound=f"{low:g}-{high:g}",
                share=float(np.mean(these)),
                ok_percent=float(100 * np.mean(found["status"][these] == 0)),
                rms_over_bound=float(np.sqrt(np.median(np.mean((error / bound) ** 2, axis=1)))),
                inside_68=f"{100 * (size < 0.99446).mean(1).min():.0f}-{100 * (size < 0.99446).mean(1).max():.0f}",
                inside_95=f"{100 * (size < 1.95996).mean(1).min():.0f}-{100 * (size < 1.95996).mean(1).max():.0f}",
            )

    model, truth = Model(), scenes.from_priors(Model(), pixels // 4, rng)
    true = scenes.jones(model, truth)
    for sigma in (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4):
        data = scenes.measure(model, truth, states, sigma, rng=7)
        plain = data.response @ np.linalg.pinv(states)
        estimates = {
            "fit": scenes.jones(model, polinfer.fit(model, data).parameters),
            "closed form": scenes.jones(model, polinfer.decompose(plain, model.ordering)),
            "pseudo-inverse": plain,
        }
        # the closed form leaves the phase open, and with it the sign of J
        estimates["closed form"] = (
            estimates["closed form"]
            * np.sign(np.sum((estimates["closed form"].conj() * plain).real, axis=(-1, -2)))[:, None, None]
        )
        for method, found_jones in estimates.items():
            error = float(np.sqrt(np.mean(scenes.squared_error(model, found_jones, true))))
            results.add(method=method, sigma=sigma, rms_error_of_J=error)
        bound = float(np.sqrt(np.mean(scenes.least_squared_error(model, truth, states, sigma))))
        results.add(method="Cramer-Rao bound", sigma=sigma, rms_error_of_J=bound)
    pictured = Results.__new__(Results)
    pictured.rows = [row for row in results.rows if "rms_error_of_J" in row]
    results.save(pictured.lines("sigma", "rms_error_of_J", "method"))
