"""Does a part that a scene does not have cost nothing? ``fit`` with the part switched off, against code without it.

Each pair takes turns in one process; the ratio is the median over the rounds. Three balanced states, sigma 0.02, one
sigma for all, truths from the priors. Three kinds of pairs:

*Written without.* ``fit(Model(), measurement)`` has a gain, weights, a map of the noise, a mask, a window, missing
states and an earlier fit switched off. Against it stand the same blocks, Newton steps and summary with code from
:mod:`benchmarks.minimal_fits`, in which a part does not exist: a likelihood that knows no gain; a kernel without
weights; one with sigma as a number in the compiled code; a verb that never looks for a mask, a window, a missing state,
illumination of its own in a pixel or an earlier fit; and all of these at once. ``fixed={"diattenuation": 0}`` stands
against a matrix, its derivatives and a closed form of the retarder alone, ``fixed={"retardance": 0}`` against those of
the diattenuator alone, both in a verb without any of the parts. Both sides of a pair must find the same log posterior.

*Absent or neutral.* The same data with the part present but idle: ``Window(1, 1)``, weights of 1, a mask of True, sigma
as a map, three further states of weight 0 whose responses are NaN. Absent must not cost more than neutral; how much
less says what the part costs who has it.

*Fewer parameters.* The fit of a pure retarder may not be slower than that with all parameters, be it of the same data
or of the default scene, which is less ambiguous for the full model.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

import polinfer
from benchmarks import minimal_fits, scenes
from benchmarks.results import Results, alternating_seconds, in_fresh_process
from polinfer import ComplexGain, Fit, Measurement, Model, Window

SIZE, SIGMA, REPEATS = 1_000_000, 0.02, 9
DTYPES = {"single": "complex64", "double": "complex128"}
BAR = 1.05
# nat: rounding of the log posterior at this signal-to-noise ratio
SAME = {"complex64": 0.05, "complex128": 1e-6}
RETARDER, POLARISER = Model(fixed={"diattenuation": 0.0}), Model(fixed={"retardance": 0.0})


def _pair(off: Callable[[], Fit], other: Callable[[], Fit], repeats: int) -> dict[str, float]:
    """Seconds of both, the ratio, and how far the log posteriors are apart."""
    first, second = off(), other()
    apart = np.abs(first.log_posterior - second.log_posterior)
    times = alternating_seconds({"off": off, "other": other}, repeats)
    ratio = times["off"] / times["other"]
    low, high = np.quantile(ratio, [0.25, 0.75])
    return {
        "off": float(np.median(times["off"])),
        "other": float(np.median(times["other"])),
        "ratio": float(np.median(ratio)),
        "low": float(low),
        "high": float(high),
        "apart": float(np.max(np.where(np.isnan(apart), np.inf, apart))),
    }


def _data(model: Model, dtype: str, size: int) -> Measurement:
    """The scene of a model, one sigma for all pixels."""
    truth = scenes.from_priors(model, size, np.random.default_rng(1))
    return scenes.measure(Model(model.ordering), truth, scenes.balanced_states(), SIGMA, dtype)


def written_without(dtype: str, size: int, repeats: int) -> dict[str, Any]:
    """Pairs of the first kind."""
    full, rows = Model(), {}
    data = {model: _data(model, dtype, size) for model in (full, RETARDER, POLARISER)}
    pairs = {
        "gain": (full, minimal_fits.Leave(gain=True)),
        "weights": (full, minimal_fits.Leave(weights=True)),
        "noise map": (full, minimal_fits.Leave(noise_map=True)),
        "mask, window, missing states, start": (full, minimal_fits.Leave()),
        "all of these": (full, minimal_fits.Leave(gain=True, weights=True, noise_map=True)),
        "diattenuation, and all of these": (RETARDER, minimal_fits.Leave(True, True, True, element="retarder")),
        "retardance, and all of these": (POLARISER, minimal_fits.Leave(True, True, True, element="polariser")),
    }
    for name, (model, leave) in pairs.items():
        given = data[model]
        rows[name] = _pair(partial(polinfer.fit, model, given), partial(minimal_fits.fit, model, given, leave), repeats)
    return rows


def neutral(dtype: str, size: int, repeats: int) -> dict[str, Any]:
    """Pairs of the second kind, and a complex gain, which is not neutral."""
    model, data = Model(), _data(Model(), dtype, size)
    side = np.ones(size)
    spare = np.full((size, 2, 3), np.nan, dtype)
    longer = Measurement(
        np.concatenate([data.illumination, data.illumination], axis=-1),
        np.concatenate([data.response, spare], axis=-1),
        data.sigma,
        weight=np.array([1.0, 1, 1, 0, 0, 0]),
    )

    def other(**parts: Any) -> Measurement:
        return Measurement(data.illumination, data.response, **({"sigma": data.sigma} | parts))

    cases = {
        "window: Window(1, 1)": (Model(neighbours=Window(1, 1)), data),
        "weights: ones": (model, other(weight=np.ones(3))),
        "weights: ones in every pixel": (model, other(weight=np.ones((size, 3)))),
        "mask: all True": (model, other(mask=side > 0)),
        "noise: sigma as a map": (model, other(sigma=SIGMA * side)),
        "missing states: three of weight 0, NaN": (model, longer),
        "gain: ComplexGain(1)": (Model(gain=ComplexGain(1.0)), data),
    }
    return {
        name: _pair(partial(polinfer.fit, model, data), partial(polinfer.fit, m, d), repeats)
        for name, (m, d) in cases.items()
    }


def fewer(dtype: str, size: int, repeats: int) -> dict[str, Any]:
    """Pairs of the third kind."""
    found = {}
    for name, model in {"pure retarder": RETARDER, "pure polariser": POLARISER}.items():
        data = _data(model, dtype, size)
        for scene, given in {"the same data": data, "the default scene": _data(Model(), dtype, size)}.items():
            found[f"{name} over full, {scene}"] = _pair(
                partial(polinfer.fit, model, data), partial(polinfer.fit, Model(), given), repeats
            )
    return found


def _add(results: Results, kind: str, precision: str, size: int, found: dict[str, Any]) -> None:
    for name, row in found.items():
        results.add(
            precision=precision,
            kind=kind,
            part=name,
            off_us=1e6 * row["off"] / size,
            other_us=1e6 * row["other"] / size,
            ratio=row["ratio"],
            middle_half=f"{row['low']:.3f}-{row['high']:.3f}",
            apart=row["apart"],
        )


def main(size: int | None = None) -> None:
    """Print the table and the bars, save the picture."""
    from matplotlib.figure import Figure

    size = size or SIZE
    results = Results("parts")
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    for offset, (precision, dtype) in enumerate(DTYPES.items()):
        double = precision == "double"
        claim = f"{dtype}, {size} pixels: "
        found = in_fresh_process(written_without, dtype, size, REPEATS, double=double)
        _add(results, "written without", precision, size, found)
        for name, row in found.items():
            results.bar(claim + f"switched off over written without {name}", row["ratio"], BAR)
        worst = max(row["apart"] for row in found.values())
        results.bar(claim + "log posteriors of the two sides apart", worst, SAME[dtype], "nat")
        idle = in_fresh_process(neutral, dtype, size, REPEATS, double=double)
        _add(results, "absent or neutral", precision, size, idle)
        for name, row in idle.items():
            results.bar(claim + f"absent over present, {name}", row["ratio"], BAR)
        fewest = in_fresh_process(fewer, dtype, size, REPEATS, double=double)
        _add(results, "fewer parameters", precision, size, fewest)
        retarder = max(row["ratio"] for name, row in fewest.items() if name.startswith("pure retarder"))
        results.bar(claim + "pure retarder over all parameters, the worse of two scenes", retarder, 1.0)
        shown = found | idle | fewest
        places = np.arange(len(shown)) + 0.4 * offset
        axes.barh(places, [row["ratio"] for row in shown.values()], 0.38, label=precision)
        axes.set_yticks(places - 0.2 * offset, list(shown), fontsize=7)
    axes.axvline(BAR, color="k", lw=0.8)
    axes.invert_yaxis()
    axes.set_xlabel("time switched off over the other")
    axes.legend(fontsize=8)
    results.save(figure)


if __name__ == "__main__":
    main()
