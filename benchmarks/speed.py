"""How fast is ``fit``? In the same run as NumPy's singular value decomposition of as many 2 x 2 matrices.

Three balanced states, sigma 0.02, unit gain unless said otherwise; most probable parameters, covariance and evidence.
Every precision is measured in a process of its own; the first call, which compiles, apart. ``--full`` adds a frame of
16 megapixels and the memory it takes.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

import polinfer
from benchmarks import scenes
from benchmarks.results import Results, alternating_seconds, in_fresh_process, median_seconds, seconds
from polinfer import ComplexGain, Fit, Measurement, Model, PhaseGain, PolariserFirst, Window

SIZE, SIGMA, REPEATS = 1_000_000, 0.02, 5
FRAME = (27, 36)
CHECKED = 20_000  # pixels whose error is compared with the bound
DTYPES = {"single": "complex64", "double": "complex128"}


def _error(model: Model, data: Measurement, result: Fit, truth: Any, illumination: np.ndarray) -> float:
    part = slice(0, CHECKED)
    few = polinfer.Parameters(*(np.asarray(x)[part] for x in truth))
    found = polinfer.Parameters(*(np.asarray(x).reshape(-1)[part] for x in result.parameters))
    error = scenes.squared_error(model, scenes.jones(model, found), scenes.jones(model, few))
    bound = scenes.least_squared_error(model, few, illumination, float(data.sigma))
    return float(np.sqrt(error.mean() / bound.mean()))


def _copy_bandwidth() -> float:
    """Bytes a second that ``np.copyto`` reads and writes."""
    source = np.ones(2**25)
    target = np.empty_like(source)
    return 2 * source.nbytes / median_seconds(lambda: np.copyto(target, source), 7)


def _bytes(data: Measurement, result: Fit) -> int:
    """Bytes of input and output of a fit."""
    arrays = [data.response, *result.parameters, *result.std, result.covariance, result.log_posterior]
    arrays += [result.log_evidence, result.sigma, result.status, result.chi_square, result.degrees_of_freedom]
    return sum(np.asarray(x).nbytes for x in arrays)


def large(dtype: str, size: int) -> dict[str, Any]:
    """``fit`` of many pixels against the decomposition, and what it costs in other scenes."""
    rng, states, model = np.random.default_rng(1), scenes.balanced_states(), Model()
    truth = scenes.from_priors(model, size, rng)
    data = scenes.measure(model, truth, states, SIGMA, dtype)
    matrices = (data.response.astype(complex) @ np.linalg.pinv(states)).astype(dtype)
    first = seconds(lambda: polinfer.fit(model, data))
    times = alternating_seconds(
        {
            "svd": lambda: np.linalg.svd(matrices),
            "fit": lambda: polinfer.fit(model, data),
            "decompose": lambda: polinfer.decompose(matrices, model.ordering),
        },
        REPEATS,
    )
    result = polinfer.fit(model, data)
    per_pixel = {name: float(1e6 * np.median(t) / size) for name, t in times.items()}
    ratio = times["fit"] / times["svd"]
    rows = [{"scene": "from the priors", "microseconds": per_pixel["fit"],
             "error_over_bound": _error(model, data, result, truth, states)}]  # fmt: skip
    others = {
        "lesion": (model, scenes.lesion(size), states),
        "all identical": (model, scenes.identical(size), states),
        "polariser first": (Model(PolariserFirst()), truth, states),
        "phase gain": (Model(gain=PhaseGain()), truth, states),
        "complex gain": (Model(gain=ComplexGain(1.0)), truth, states),
    }
    others |= {f"{n} states": (model, truth, scenes.balanced_states(n)) for n in (2, 6, 12)}
    for name, (scene, parameters, illumination) in others.items():
        seen = scenes.measure(Model(scene.ordering), parameters, illumination, SIGMA, dtype)
        count = seen.response.shape[0]
        time = median_seconds(lambda m=scene, d=seen: polinfer.fit(m, d), 3)
        error = _error(scene, seen, polinfer.fit(scene, seen), parameters, illumination)
        rows.append({"scene": name, "microseconds": 1e6 * time / count, "error_over_bound": error})
    moved = _bytes(data, result) / size
    return {
        "per_pixel": per_pixel,
        "ratio": [float(x) for x in (np.median(ratio), ratio.min(), ratio.max())],
        "compile": first - float(np.median(times["fit"])),
        "bytes": moved,
        "floor": 1e6 * moved / _copy_bandwidth(),
        "rows": rows,
    }


def frame(dtype: str) -> dict[str, float]:
    """A frame of 972 pixels: first call in this process, then seconds with and without windows."""
    states, model = scenes.balanced_states(), Model()
    phantom = polinfer.phantoms.lesion(FRAME, rng=1)
    data = scenes.measure(model, phantom.parameters, states, SIGMA, dtype)
    found = {"first": seconds(lambda: polinfer.fit(model, data))}
    kinds = {"pixels": None, "Window(3, 5)": Window(3, 5), "Window(15, 15)": Window(15, 15)}
    calls = {name: (lambda w=window: polinfer.fit(Model(neighbours=w), data)) for name, window in kinds.items()}
    for call in calls.values():
        call()
    return found | {name: float(np.median(t)) for name, t in alternating_seconds(calls, 9).items()}


def megapixels(dtype: str, side: int) -> dict[str, float]:
    """Seconds of a large frame, and bytes of memory beyond input and output at the peak."""
    states, model = scenes.balanced_states().astype(dtype), Model()
    response = np.empty((side, side, 2, 3), dtype)
    rng = np.random.default_rng(1)
    for row in range(side):
        response[row] = scenes.measure(model, scenes.from_priors(model, side, rng), states, SIGMA, dtype, row).response
    data = Measurement(states, response, SIGMA)
    polinfer.fit(model, Measurement(states, response[: max(side // 16, 1)], SIGMA))
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts from here
    before = _memory("VmRSS")
    results: list[Fit] = []
    time = seconds(lambda: results.append(polinfer.fit(model, data)))
    output = _bytes(data, results[0]) - response.nbytes
    return {"seconds": time, "beyond": float(_memory("VmHWM") - before - output), "output": float(output)}


def _memory(name: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(name))


def _import_seconds() -> float:
    code = "import time; s = time.perf_counter(); import polinfer; print(time.perf_counter() - s)"
    run = [sys.executable, "-c", code]
    root = Path(__file__).parents[1]
    return float(np.median([float(subprocess.check_output(run, cwd=root)) for _ in range(5)]))


def main(size: int | None = None, full: bool = False) -> None:
    """Print the table."""
    from matplotlib.figure import Figure

    size = size or SIZE
    results = Results("speed")
    results.bar("import polinfer, fresh process, median of 5", _import_seconds(), 1.5, "s")
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for offset, (precision, dtype) in enumerate(DTYPES.items()):
        double = precision == "double"
        found = in_fresh_process(large, dtype, size, double=double)
        for row in found["rows"]:
            results.add(precision=precision, pixels=size, **row)
        per_pixel, (ratio, low, high) = found["per_pixel"], found["ratio"]
        print(f"  svd {per_pixel['svd']:.3g}, decompose {per_pixel['decompose']:.3g}, fit {per_pixel['fit']:.3g} us; "
              f"ratio fit / svd {low:.2f} to {high:.2f}")  # fmt: skip
        claim = f"{dtype}, {size} pixels: "
        results.bar(claim + f"fit over svd, median of {REPEATS}", ratio, 1.0 if double else 0.5)
        results.bar(claim + "fit, stretch", per_pixel["fit"], 0.5, "us a pixel")
        results.bar(claim + "first call less a later one", found["compile"], 5.0, "s")
        print(f"  floor: {found['bytes']:.0f} bytes a pixel at the speed of np.copyto take {found['floor']:.3g} us, "
              f"fit takes {per_pixel['fit'] / found['floor']:.1f} times as long")  # fmt: skip
        small = in_fresh_process(frame, dtype, double=double)
        for name, time in small.items():
            results.add(precision=precision, frame="27 x 36", call=name, milliseconds=1e3 * time)
        claim = f"{dtype}, 27 x 36 pixels: "
        results.bar(claim + "first call, compiling", small["first"], 5.0, "s")
        results.bar(claim + "Window(3, 5)", 1e3 * small["Window(3, 5)"], 5.0, "ms")
        results.bar(claim + "Window(15, 15) over Window(3, 5)", small["Window(15, 15)"] / small["Window(3, 5)"], 1.2)
        names = [row["scene"] for row in found["rows"]]
        places = np.arange(len(names)) + 0.4 * offset
        axes.barh(places, [row["microseconds"] for row in found["rows"]], 0.38, label=f"fit, {precision}")
        axes.axvline(per_pixel["svd"], color=f"C{offset}", ls="--", label=f"numpy.linalg.svd, {precision}")
        axes.set_yticks(places - 0.2 * offset, names)
    axes.invert_yaxis()
    axes.set_xlabel("microseconds a pixel")
    axes.legend(fontsize=8)
    if full:
        side = 4096 if size >= SIZE else round(size**0.5)
        found = in_fresh_process(megapixels, "complex64", side, double=False)
        results.add(frame=f"{side} x {side}", **found, microseconds=1e6 * found["seconds"] / side**2)
        results.bar(f"complex64, {side} x {side}: memory beyond input and output", found["beyond"] / 1e9, 1.0, "GB")
    results.save(figure)


if __name__ == "__main__":
    main()
