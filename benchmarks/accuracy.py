"""Does ``fit`` reach the Cramer-Rao bound, and do its intervals hold what they say?

Three balanced states, both orderings, truths from the priors. First the regime in which the local Gaussian must be
right: all five bounds below 0.1. Then what it is worth outside. Of the eight equivalent truths the one nearest to the
fit counts, for errors and for the intervals of :meth:`polinfer.Fit.interval`. The picture shows the error of J of
``fit``, of the closed form and of the plain pseudo-inverse against the bound.
"""

from __future__ import annotations

from itertools import product

import numpy as np

import polinfer
from benchmarks import scenes
from benchmarks.results import Results
from polinfer import ComplexGain, Fit, Model, Parameters, PolariserFirst, RetarderFirst
from polinfer.records import PERIODS

PIXELS = 40_000
LEVELS = {68: (66, 70), 95: (94, 96)}  # percent: what the coverage must be between
GAINS = {"unit": None, "complex": ComplexGain(1.0)}


def _nearest(found: Parameters, truth: Parameters) -> tuple[np.ndarray, np.ndarray]:
    """The nearest of the eight copies of the truth, and the errors from it, both ``(5, pixels)``."""
    copies = np.stack(list(polinfer.orbit(truth)))  # (5, 8, pixels)
    error = np.stack([np.asarray(x, float) for x in found])[:, None] - copies
    for i, period in enumerate(PERIODS):
        if np.isfinite(period):
            error[i] -= period * np.round(error[i] / period)
    weight = np.array([1.0, 2.0, 1.0, 2.0, 1.0])[:, None, None]
    nearest = np.argmin(np.sum((weight * error) ** 2, axis=0), axis=0)[None, None]
    return np.take_along_axis(copies, nearest, axis=1)[:, 0], np.take_along_axis(error, nearest, axis=1)[:, 0]


def _inside(result: Fit, truth: np.ndarray, level: float) -> np.ndarray:
    """Whether the intervals hold the values ``(5, pixels)``: arcs of circles, segments where a parameter has bounds."""
    found = []
    for name, low, high, value in zip(Parameters._fields, *result.interval(level), truth, strict=True):
        if name in result.model.bounds:
            found.append((low <= value) & (value <= high))
            continue
        period = getattr(PERIODS, name)
        arc = np.mod(high - low, period)
        # ends that meet are those of the whole circle: no width is that small
        whole = np.minimum(arc, period - arc) < 1e-9
        found.append(whole | (np.mod(value - low, period) <= arc))
    return np.stack(found)


def _row(model: Model, truth: Parameters, sigma: float, seed: int) -> dict[str, np.ndarray]:
    states = scenes.balanced_states()
    data = scenes.measure(Model(model.ordering), truth, states, sigma, rng=seed)
    result = polinfer.fit(model, data)
    nearest, error = _nearest(result.parameters, truth)
    bound = np.stack(list(polinfer.cramer_rao_bound(model, truth, states, sigma)))
    inside = {f"inside {level}": _inside(result, nearest, level / 100) for level in LEVELS}
    return {"error": error, "bound": bound, "status": result.status, **inside}


def _range(inside: np.ndarray, digits: int) -> str:
    """Least and most percentage of the five parameters."""
    percent = 100 * inside.mean(axis=1)
    return f"{percent.min():.{digits}f}-{percent.max():.{digits}f}"


def main(size: int | None = None) -> None:
    """Print tables and bars, save the picture."""
    results, pixels = Results("accuracy"), size or PIXELS
    rng, states = np.random.default_rng(3), scenes.balanced_states()
    worst, cover = 0.0, {level: [] for level in LEVELS}
    for ordering, (name, gain), sigma in product(
        (RetarderFirst(), PolariserFirst()), GAINS.items(), (0.005, 0.02, 0.05)
    ):
        model = Model(ordering, gain=gain)
        truth = scenes.well_determined(model, pixels, states, sigma, rng)
        found = _row(model, truth, sigma, int(rng.integers(2**31)))
        # every parameter against its own bound, in root mean square over the pixels
        ratio = np.sqrt(np.mean((found["error"] / found["bound"]) ** 2, axis=1))
        worst = max(worst, float(np.max(np.abs(ratio - 1))))
        for level, values in cover.items():
            values += list(100 * found[f"inside {level}"].mean(axis=1))
        results.add(
            ordering=type(ordering).__name__,
            gain=name,
            sigma=sigma,
            **{f"rms_{p}": float(r) for p, r in zip(("D", "tD", "eta", "teta", "xi"), ratio, strict=True)},
            inside_68=_range(found["inside 68"], 1),
            inside_95=_range(found["inside 95"], 1),
        )
    print(f"  one standard error: rms {1 / np.sqrt(2 * pixels):.4f}, coverage {100 * np.sqrt(0.2176 / pixels):.2f} %")
    results.bar("rms error over bound, furthest from 1, worst parameter of all rows", worst, 0.05)
    for level, (low, high) in LEVELS.items():
        results.bar(f"{level} % intervals, least coverage", min(cover[level]), low, "%", at_least=True)
        results.bar(f"{level} % intervals, most coverage", max(cover[level]), high, "%")

    for sigma in (0.02, 0.1, 0.2, 0.4):
        model = Model()
        truth = scenes.from_priors(model, 4 * pixels, rng)
        found = _row(model, truth, sigma, 5)
        largest = np.max(found["bound"], axis=0)
        for low, high in ((0.0, 0.1), (0.1, 0.3), (0.3, 1.0), (1.0, np.inf)):
            these = (largest >= low) & (largest < high)
            if np.sum(these) < 500:
                continue
            error, bound = (found[key][:, these] for key in ("error", "bound"))
            results.add(
                sigma=sigma,
                largest_bound=f"{low:g}-{high:g}",
                share=float(np.mean(these)),
                ok_percent=float(100 * np.mean(found["status"][these] == 0)),
                rms_over_bound=float(np.sqrt(np.median(np.mean((error / bound) ** 2, axis=1)))),
                inside_68=_range(found["inside 68"][:, these], 0),
                inside_95=_range(found["inside 95"][:, these], 0),
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
        bound = float(np.sqrt(np.mean(scenes.least_squared_error(model, truth, states, sigma))))
        for method, found_jones in estimates.items():
            error = float(np.sqrt(np.mean(scenes.squared_error(model, found_jones, true))))
            results.add(method=method, sigma=sigma, rms_error_of_J=error, error_of_J_over_bound=error / bound)
    pictured = Results.__new__(Results)
    pictured.rows = [row for row in results.rows if "rms_error_of_J" in row]
    figure = pictured.lines("sigma", "error_of_J_over_bound", "method")
    figure.axes[0].set(yscale="linear", ylabel="rms error of J over its Cramér-Rao bound")
    figure.axes[0].axhline(1, color="0.3", lw=0.8)
    results.save(figure)
